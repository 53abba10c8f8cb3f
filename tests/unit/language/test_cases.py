"""Each code has a case that triggers exactly it, with the text that a user sees. FOGSPEC_REWRITE=1 writes the texts anew."""

import os
import re
import shutil
from pathlib import Path

import pytest

from fogspec.cli import main
from fogspec.language.codes import codes

CASES = Path(__file__).resolve().parents[2] / "cases" / "language"
ELSEWHERE = {
    "FS401": "tests/unit/language/test_loader.py",
    "FS402": "tests/unit/language/test_loader.py",
    "FS701": "tests/unit/language/test_loader.py",
    "FS801": "tests/unit/language/test_launch_import.py",
    "FS802": "tests/unit/language/test_launch_import.py",
    "FS901": "tests/unit/language/test_warned.py",
    "FS902": "tests/unit/language/test_warned.py",
    "FS903": "tests/unit/language/test_warned.py",
}

WARNINGS = {"FS523", "FS544", "FS546", "FS547", "FS560", "FS561", "FS563"}
# What the cases name, so that only what a case is about is wrong.
THERE = ("plan.py", "data/kitchen")


def said(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as end:
        main(arguments)
    out = capsys.readouterr()
    return int(end.value.code or 0), out.out, out.err


@pytest.mark.parametrize("case", sorted(path.name for path in CASES.iterdir() if path.name.startswith("FS")))
def test_each_case_triggers_exactly_its_code(
    case: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    here = shutil.copytree(CASES / case, tmp_path / case, symlinks=True)
    spec = "specs/spec.yaml" if (here / "specs").exists() else "spec.yaml"
    for name in THERE:
        path = (here / spec).parent / name
        path.parent.mkdir(exist_ok=True)
        path.touch()
    monkeypatch.chdir(here)
    code, out, err = said(["validate", spec], capsys)
    if os.environ.get("FOGSPEC_REWRITE"):
        (CASES / case / "expected.txt").write_text(err, "utf-8")
    warned = case in WARNINGS
    assert (code, out.partition("\n")[0]) == ((0, "1 application in 1 file valid: arm") if warned else (1, ""))
    assert err == (CASES / case / "expected.txt").read_text("utf-8")
    heads = [line for line in err.splitlines() if line.startswith(("error[", "warning["))]
    assert {head.partition("[")[2].partition("]")[0] for head in heads} == {case}


def test_every_code_has_a_case_and_every_case_a_code() -> None:
    cases = {path.name for path in CASES.iterdir() if path.name.startswith("FS")}
    assert cases | set(ELSEWHERE) == set(codes())
    root = CASES.parents[2]
    for code, test in ELSEWHERE.items():
        assert code in (root / test).read_text("utf-8")


def test_every_code_in_the_source_is_in_the_book() -> None:
    root = Path(__file__).resolve().parents[3]
    sources = [*(root / "fogspec").rglob("*.py"), *(root / "lab").rglob("*.py")]
    used = {code for path in sources for code in re.findall(r'["\[](FS\d{3})["\]]', path.read_text("utf-8"))}
    assert used == set(codes())


@pytest.mark.parametrize("code", codes())
def test_every_code_has_a_page(code: str, capsys: pytest.CaptureFixture[str]) -> None:
    exit_code, out, _ = said(["explain", code], capsys)
    assert exit_code == 0
    assert out.startswith(f"{code}: {codes()[code].title}")
    docs = (Path(__file__).resolve().parents[3] / "docs" / "reference" / "codes.md").read_text("utf-8")
    assert f"## {code}\n" in docs


def test_the_unchanged_spec_of_the_cases_is_valid(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    here = shutil.copytree(CASES / "valid", tmp_path / "valid")
    for name in THERE:
        (here / name).parent.mkdir(exist_ok=True)
        (here / name).touch()
    monkeypatch.chdir(here)
    assert said(["validate", "spec.yaml"], capsys) == (
        0,
        "1 application in 1 file valid: arm\nnext: fogspec compile spec.yaml\n",
        "",
    )
