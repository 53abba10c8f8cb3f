"""The same inputs give the same bytes, whatever the process, the machine's settings, or the order of the catalog."""

import hashlib
import os
import random
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.running import CATALOG, Shell, measure, project, shell, spec  # noqa: F401

PARTS = {
    "hardware": "{cpus: 2..32, gpus: [none, T4], spot: true}",
    "cloud": "[{cmd: [python3, work.py], env: {B: 'é', A: '1'}}]",
    "robot": "[{package: p, executable: e, remappings: {/b: /a, /a: /b}, parameters: {z: 1.0, a: {c: 1, b: true}}}]",
    "ros": "{distro: humble}",
}


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in (folder / "compiled").rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture
def once(shell: Shell) -> tuple[Shell, dict[str, str]]:
    """A measured application with everything compiled, and the digests of its files."""
    project(shell, **PARTS)
    measure(shell)
    shell("compile", "specs/demo.yaml", "--catalog", "offers.csv")
    found = digests(shell.folder)
    assert {"compiled/demo/manifest.yaml", "compiled/demo/menu.svg", "compiled/demo/robot.launch.py"} <= found.keys()
    return shell, found


def again(folder: Path, cwd: Path, *, spec: str, catalog: str, **environment: str) -> dict[str, str]:
    for path in sorted((folder / "compiled").rglob("*")):
        if path.is_file():
            path.unlink()
    ended = subprocess.run(
        [sys.executable, "-m", "fogspec", "compile", spec, "--catalog", catalog], cwd=cwd, capture_output=True, text=True,
        env=os.environ | environment,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    return digests(folder)


@pytest.mark.parametrize(
    "environment",
    [
        {"PYTHONHASHSEED": "0", "TZ": "Pacific/Kiritimati"},
        {"PYTHONHASHSEED": "1", "LC_ALL": "C", "TZ": "America/Los_Angeles", "PYTHONUTF8": "0"},
        {"PYTHONHASHSEED": "2", "LC_ALL": "tr_TR.UTF-8", "LANG": "tr_TR.UTF-8"},
    ],
)
def test_hash_seed_locale_and_time_zone(once: tuple[Shell, dict[str, str]], environment: dict[str, str]) -> None:
    shell, before = once
    assert again(shell.folder, shell.folder, spec="specs/demo.yaml", catalog="offers.csv", **environment) == before


def test_the_working_directory(once: tuple[Shell, dict[str, str]]) -> None:
    shell, before = once
    for cwd, where in ((shell.folder / "specs", "demo.yaml"), (Path("/"), str(shell.folder / "specs/demo.yaml"))):
        catalog = str(shell.folder / "offers.csv")
        assert again(shell.folder, cwd, spec=where, catalog=catalog) == before


def test_the_order_of_the_catalog_and_of_the_keys(once: tuple[Shell, dict[str, str]]) -> None:
    shell, before = once
    head, *rows = CATALOG.splitlines()
    lines = spec(**PARTS).splitlines()
    for seed in range(3):
        shuffle = random.Random(seed).shuffle
        shuffle(rows)
        body = lines[4:]
        shuffle(body)
        shell.write("offers.csv", "\n".join([head, *rows, ""]))
        shell.write("specs/demo.yaml", "\n".join([*lines[:4], *body, ""]))
        shell("compile", "specs/demo.yaml", "--catalog", "offers.csv")
        assert digests(shell.folder) == before


def test_files_are_lf_utf8_without_host_user_clock_or_absolute_path(once: tuple[Shell, dict[str, str]]) -> None:
    shell, before = once
    # The agent is a zip file, whose bytes tests/unit/compile/test_agent_archive.py compares.
    for name in before.keys() - {"compiled/agent.pyz"}:
        text = shell.read(name)
        assert "\r" not in text
        assert str(shell.folder) not in text
        assert os.uname().nodename not in text or len(os.uname().nodename) < 4
        assert text.endswith("\n")
