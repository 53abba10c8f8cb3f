"""The agent is one file: the same bytes wherever it is built, and whole wherever it is started."""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from fogspec.compile import agent_archive as archive
from fogspec.language.probe import PACKAGE
from tests.conftest import ROOT
from tests.support.agent import AGENT
from tests.support.interpreters import python

BUILD = "import sys; from fogspec.compile.agent_archive import agent_archive; sys.stdout.buffer.write(agent_archive())"
# Builds it without installed packages: the modules that need any are replaced.
BUILD_ALONE = f"""
import sys, types
sys.modules["fogspec.language"] = types.ModuleType("fogspec.language")
sys.modules["fogspec.language.probe"] = types.ModuleType("fogspec.language.probe")
sys.modules["fogspec.language.probe"].PACKAGE = {PACKAGE!r}
{BUILD}
"""
PROGRAMS = ("sample", "supervisor", "declared", "topics", "preload", "bag", "player")


def run(folder: Path, *words: str | Path, **environment: str) -> "subprocess.CompletedProcess[str]":
    """Run this Python in a directory, without its installed packages."""
    bare = {"PATH": os.environ["PATH"], **environment}
    return subprocess.run([sys.executable, *words], cwd=folder, env=bare, capture_output=True, text=True, timeout=600)


def test_two_builds_give_the_same_bytes(tmp_path: Path) -> None:
    builds = []
    for hash_seed, umask in (("1", 0o022), ("2", 0o077)):
        copy = tmp_path / hash_seed
        shutil.copytree(ROOT / "fogspec", copy / "fogspec", copy_function=shutil.copyfile)  # with other times and modes
        words = [sys.executable, "-c", BUILD]
        environment = {**os.environ, "PYTHONHASHSEED": hash_seed, "PYTHONPATH": str(copy), "TZ": f"UTC{hash_seed}"}
        builds.append(
            subprocess.run(words, cwd=copy, env=environment, umask=umask, capture_output=True, check=True).stdout
        )
    assert builds[0] == builds[1] == archive.agent_archive()


OTHERS = [path for version in ("3.11", "3.12", "3.13", "3.14") if (path := python(version))] or [sys.executable]


@pytest.mark.parametrize("other", OTHERS)
def test_every_python_version_here_gives_the_same_bytes(tmp_path: Path, other: str) -> None:
    words = [other, "-B", "-S", "-c", BUILD_ALONE]
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT)}
    built = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, check=True).stdout
    assert built == archive.agent_archive()


def test_every_source_is_in_it_and_nothing_else() -> None:
    sources = {path.name for path in (ROOT / "fogspec" / "agent").iterdir() if path.is_file()}
    with zipfile.ZipFile(AGENT) as opened:
        assert opened.testzip() is None
        names = {name.removeprefix(f"{PACKAGE}/") for name in opened.namelist()}
        times = {member.date_time for member in opened.infolist()}
    assert names == sources
    assert times == {(1980, 1, 1, 0, 0, 0)}


@pytest.mark.parametrize("program", PROGRAMS)
def test_it_starts_by_hand_in_an_empty_directory(tmp_path: Path, program: str) -> None:
    ran = run(tmp_path, "-I", AGENT, program, "--help")
    assert (ran.returncode, ran.stderr) == (0, "")
    assert ran.stdout.startswith(f"usage: {program} ")
    module = run(tmp_path, "-m", f"{PACKAGE}.{program}", "--help", PYTHONPATH=str(AGENT))
    assert module.stdout == ran.stdout
    assert list(tmp_path.iterdir()) == []


def test_it_lists_its_programs_and_refuses_others(tmp_path: Path) -> None:
    ran = run(tmp_path, "-I", AGENT, "--help")
    assert all(f"  {program} " in ran.stdout for program in (*PROGRAMS, "redaction"))
    assert run(tmp_path, "-I", AGENT, "dance").returncode == 2


def test_a_sample_is_measured_by_the_file_alone(tmp_path: Path) -> None:
    shutil.copy(AGENT, tmp_path)
    work = "import fogspec_probe as p, os\nfor _ in range(3): p.start('plan'); p.stop('plan')\nprint(p.__file__)"
    limits = ["--after", "20", "--startup", "20", "--warmup", "0", "--steps", "3"]
    argv = json.dumps([sys.executable, "-c", work])
    ran = run(tmp_path, "-I", "agent.pyz", "sample", "--out", "out", *limits, "--process", argv)
    assert (ran.returncode, ran.stderr) == (0, "")
    extracted = tmp_path / "out" / "python"
    assert (tmp_path / "out" / "process-0.log").read_text() == f"{extracted}/fogspec_probe.py\n"
    assert (extracted / "fogspec_probe.hpp").read_bytes() == (ROOT / "fogspec/agent/fogspec_probe.hpp").read_bytes()


def test_user_code_imports_the_probe_from_the_file_itself(tmp_path: Path) -> None:
    ran = run(tmp_path, "-c", "import fogspec_probe; print(fogspec_probe.__file__)", PYTHONPATH=str(AGENT))
    assert ran.stdout == f"{AGENT}/fogspec_probe.py\n"


def test_the_timing_library_is_compiled_from_inside_the_file(tmp_path: Path) -> None:
    if shutil.which("cc") is None:
        pytest.skip("needs a C compiler: apt-get install gcc libc6-dev")
    timings = {"FOGSPEC_TIMINGS": str(tmp_path / "timings.jsonl")}
    ran = run(tmp_path, "-I", AGENT, "preload", "--service", "/plan", "--", "env", **timings)
    assert f"LD_PRELOAD={tmp_path}/libfogspec_preload.so\n" in ran.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["libfogspec_preload.so", "preload.lock"]
