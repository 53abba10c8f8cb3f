"""`make seal` writes every file that code makes, and `make generated` compares the same ones."""

import subprocess
from pathlib import Path

from tests.conftest import ROOT

NOT_HERE = {"tests/tools/sparecores_suite.py"}  # made from a larger set that is not in this repository
PROGRAMS = {"lab/fogspec_lab/paper/page.py": "fogspec-lab paper"}


def recipe(target: str) -> list[str]:
    words = ["make", "--no-print-directory", "--dry-run", "--always-make", "--old-file=.venv/dev.stamp", target]
    done = subprocess.run(words, cwd=ROOT, check=True, capture_output=True, text=True)
    return [line.rstrip() for line in done.stdout.splitlines()]


def makers() -> dict[str, str]:
    """Return what runs each module that writes generated files."""
    paths = [path for folder in ("tests", "lab") for path in sorted((ROOT / folder).rglob("*.py"))]
    calling = [path for path in paths if "write_or_check(" in path.read_text("utf-8") and path != Path(__file__)]
    names = {path.relative_to(ROOT).as_posix() for path in calling} - {"lab/fogspec_lab/generated.py"} - NOT_HERE
    return {name: PROGRAMS.get(name, f"python -m {name.removesuffix('.py').replace('/', '.')}") for name in names}


def test_one_list_writes_and_compares_them() -> None:
    writing, comparing = recipe("seal"), recipe("generated")
    assert writing
    compiling = [".venv/bin/fogspec compile specs/*-recorded.yaml --catalog snapshot",
                 ".venv/bin/fogspec compile specs/cubicles-planner"]  # fmt: skip
    assert [line for line in writing if line in compiling] == compiling
    checking = ".venv/bin/fogspec check specs/*-recorded.yaml specs/cubicles-planner"
    assert [line for line in comparing if line == checking] == [checking]
    assert [f"{one} --check" for one in writing if one not in compiling] == [
        one for one in comparing if one != checking
    ]


def test_the_list_has_everything_that_writes_generated_files() -> None:
    found = makers()
    assert len(found) >= 5
    for name, program in found.items():
        assert any(line.endswith(program) for line in recipe("seal")), name
    assert any("fogspec compile specs/*-recorded.yaml" in line for line in recipe("seal"))
