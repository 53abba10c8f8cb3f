"""Commands that only compute import nothing that Linux alone has; those that rent, start and watch machines may."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

# Modules of the standard library that documentation lists for POSIX only.
POSIX = ("crypt", "fcntl", "grp", "nis", "ossaudiodev", "pty", "pwd", "resource", "spwd", "syslog", "termios", "tty")
WITHOUT = f"""
import sys
from fogspec.__main__ import main

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name in {POSIX}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

for name in {POSIX}:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Absent())
main()
"""
PURE = (
    ("validate", "vslam-recorded"),
    ("compile", "vslam-recorded"),
    ("menu", "vslam-recorded", "--alpha", "1"),
    ("explain", "vslam-recorded"),
    ("explain", "constraints.latency"),
    ("report", "vslam-recorded"),
    ("check", "vslam-recorded"),
    ("diff", "vslam-recorded"),
)


def without_posix(cwd: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", WITHOUT, *words], cwd=cwd, capture_output=True, text=True, timeout=1200, check=False
    )


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An application with its measurements and what was compiled of it."""
    here = tmp_path_factory.mktemp("project")
    (here / "specs").mkdir()
    shutil.copy(ROOT / "specs/vslam-recorded.yaml", here / "specs")
    shutil.copytree(ROOT / "results/vslam-recorded", here / "results/vslam-recorded")
    compiled = without_posix(here, "compile", "vslam-recorded")
    assert compiled.returncode == 0, compiled.stderr
    return here


@pytest.mark.slow
@pytest.mark.parametrize("words", PURE, ids=" ".join)
def test_a_command_that_computes_runs_without_the_modules_of_posix(project: Path, words: tuple[str, ...]) -> None:
    ended = without_posix(project, *words)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout


@pytest.mark.slow
def test_the_modules_are_indeed_absent_there(project: Path) -> None:
    ended = without_posix(project, "down", "vslam-recorded")
    assert ended.returncode == 70
    assert "No module named 'fcntl'" in ended.stderr or "ModuleNotFoundError" in ended.stderr
