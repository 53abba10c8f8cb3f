"""The recorded applications compile to the committed bytes on every processor; a chart is no link of the chain."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.running import Shell, measure, project, shell  # noqa: F401
from tests.tools.equal_bytes import CORES, kernel_of, settings

ROOT = Path(__file__).resolve().parents[2]
SPECS = [*sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("specs/*-recorded.yaml")), "specs/cubicles-planner"]
AT = ("--catalog", "offers.csv")
PICTURE = "compiled/demo/menu.svg"


def test_the_cores_compute_with_different_kernels() -> None:
    kernels = [kernel_of(sys.executable, core) for core in CORES]
    assert len(set(kernels)) == len(CORES), kernels


@pytest.mark.parametrize("core", CORES)
def test_recorded_applications_have_equal_bytes_on_another_processor(core: str) -> None:
    words = [sys.executable, "-m", "fogspec", "check", *SPECS, "-q"]
    ended = subprocess.run(words, cwd=ROOT, env=settings(core), capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "warning: " not in ended.stdout, "charts too, which are warnings where they differ"


def test_the_repository_passes_its_own_gate() -> None:
    words = [sys.executable, "-m", "fogspec", "check", *SPECS, "-o", "json"]
    ended = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    found = json.loads(ended.stdout)
    assert {one["name"]: one["problems"] for one in found["applications"] if one["problems"]} == {}
    assert ended.returncode == 0
    assert all(one["what"] == "manifest verified" for one in found["applications"])


@pytest.mark.parametrize("edit", ["edited", "removed"])
def test_a_differing_chart_is_a_warning(shell: Shell, edit: str) -> None:
    project(shell)
    shell("lock", *AT)
    shell("compile", *AT)
    measure(shell)
    shell("compile", *AT)
    path = shell.folder / PICTURE
    drawn = path.read_bytes()
    path.write_bytes(drawn + b"<!-- mine -->\n") if edit == "edited" else path.unlink()
    for words in (("check",), ("status",)):
        ended = shell(*words)
        assert f"warning: {PICTURE}" in ended.out + ended.err, words
    shell("apply", "demo", "--dry-run")
    shell("compile", *AT)
    assert path.read_bytes() == drawn
    assert "warning: compiled" not in shell("check").out
