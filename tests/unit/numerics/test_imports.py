"""Imports: numerics needs numpy and scipy only, and commands that only read and compile import neither scipy nor numpy.ma."""

import ast
import os
import subprocess
import sys

import pytest

from fogspec.base import child
from tests.conftest import ROOT


@pytest.mark.parametrize("module", sorted(path.name for path in (ROOT / "fogspec/numerics").glob("*.py")))
def test_numerics_imports_numpy_and_scipy_only(module):
    tree = ast.parse((ROOT / "fogspec/numerics" / module).read_text())
    names = [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    others = {name for name in names if name.partition(".")[0] not in {*sys.stdlib_module_names, "numpy", "scipy"}}
    assert all(name.startswith("fogspec.numerics") for name in others)
    assert not any(part.startswith("_") for name in names for part in name.split("."))


@pytest.mark.parametrize("words", [("validate",), ("check", "--resolve-image"), ("menu",)], ids=lambda words: words[0])
def test_neither_scipy_nor_masked_arrays_are_imported_to_compile(words):
    verb, *options = words
    ended = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "fogspec", verb, "specs/vslam-recorded.yaml", *options], cwd=ROOT,
        capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr[-2000:]
    assert "fogspec" in ended.stderr
    assert "scipy" not in ended.stderr
    assert "numpy.ma\n" not in ended.stderr


SAID = """
import atexit, runpy, sys
heavy = {"numpy", "scipy", "jinja2", "jsonschema", "referencing", "asyncio", "sqlite3", "yaml"}
atexit.register(lambda: print(*sorted(heavy & set(sys.modules)), file=sys.stderr))
sys.argv[1:] = ["validate", "specs/vslam-recorded.yaml"]
runpy.run_module("fogspec", run_name="__main__")
"""


def test_what_only_checks_a_spec_imports_nothing_that_it_does_not_use():
    ended = subprocess.run(
        [sys.executable, "-c", SAID], cwd=ROOT, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr[-2000:]
    assert "valid" in ended.stdout
    assert ended.stderr.split() == []


THREADS = """
import atexit, os, runpy, sys
from fogspec.base import child
told = lambda: (len(os.listdir("/proc/self/task")), "numpy" in sys.modules, child.environment().get(child.THREADS))
atexit.register(lambda: print(*told(), file=sys.stderr))
sys.argv[1:] = ["check", "--resolve-image", "specs/vslam-recorded.yaml"]
runpy.run_module("fogspec", run_name="__main__")
"""


@pytest.mark.parametrize(("given", "expected"), [(None, "None"), ("1", "1")], ids=["ours", "the-users"])
def test_numpy_has_one_thread_and_started_programs_the_users_number(given, expected):
    environment = {name: value for name, value in os.environ.items() if name != child.THREADS}
    ended = subprocess.run(
        [sys.executable, "-c", THREADS], cwd=ROOT, capture_output=True, text=True, timeout=600,
        env=environment | ({child.THREADS: given} if given else {}),
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr[-2000:]
    assert ended.stderr.splitlines()[-1] == f"1 True {expected}"
