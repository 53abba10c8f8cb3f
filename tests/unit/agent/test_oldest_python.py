"""The agent and the probe run on a robot's Python 3.10, Humble's, although fogspec itself needs a newer one."""

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

AGENT = ROOT / "fogspec" / "agent"
MODULES = sorted(path for path in AGENT.glob("*.py") if path.stem != "__main__")
IMPORTS = """
import importlib, sys, types
package = types.ModuleType("fogspec_agent")
package.__path__ = [sys.argv[1]]
sys.modules["fogspec_agent"] = package
for name in sys.argv[2:]:
    importlib.import_module(f"fogspec_agent.{name}")
"""
TIMED = """
import sys
sys.path.insert(0, sys.argv[1])
import fogspec_probe as probe
with probe.request("plan"):
    probe.start("track")
    probe.stop("track", ok=False, reason="lost", length_m=3)
"""


def oldest() -> str | None:
    """Return a Python 3.10 of this computer, of pyenv too, that runs; None without one."""
    kept = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    known = [shutil.which("python3.10"), *map(str, sorted(kept.glob("3.10.*/bin/python3.10")))]
    runs = (one for one in known if one and not subprocess.run([one, "-c", ""], capture_output=True).returncode)
    return next(runs, None)


@pytest.mark.parametrize("module", MODULES, ids=lambda path: path.stem)
def test_each_module_is_in_the_words_of_python_3_10(module: Path) -> None:
    ast.parse(module.read_text("utf-8"), feature_version=(3, 10))


@pytest.mark.parametrize("python", [*filter(None, (sys.executable, oldest()))], ids=lambda path: Path(path).name)
def test_each_module_can_be_imported_and_the_probe_times(python: str, tmp_path: Path) -> None:
    names = [path.stem for path in MODULES if path.stem != "__init__"]
    subprocess.run([python, "-I", "-c", IMPORTS, AGENT, *names], check=True, timeout=600)
    (tmp_path / "fogspec_probe.py").write_bytes((AGENT / "fogspec_probe.py").read_bytes())
    timings = tmp_path / "timings.jsonl"
    environment = {"PATH": "/usr/bin:/bin", "FOGSPEC_TIMINGS": str(timings)}
    subprocess.run([python, "-I", "-c", TIMED, tmp_path], check=True, timeout=600, env=environment)
    text = timings.read_text("utf-8")
    assert ('"name": "plan"' in text, '"reason": "lost"' in text) == (True, True)
