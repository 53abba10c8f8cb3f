"""YAML and Python that pages show in part are right: fields exist, values have their units, code parses."""

import ast
import re
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from fogspec.deploy.schema import Project
from fogspec.language.loader import check_file
from tests.docs.blocks import ROOT, Block, blocks, pages

REPLACED = (
    "probe",
    "cloud",
    "infra",
    "workload",
)  # these are of one kind: a part of another kind does not merge into them
INLINE = re.compile(r"`((?:probe|constraints|objective|hardware|infra|benchmark|connectivity): [\[{][^`]*)`")
SHOWN = [block for page in pages() for block in blocks(page)]


def data(block: Block) -> Any:
    return YAML(typ="safe", pure=True).load(block.text)


def fragments() -> list[Block]:
    """Parts of a spec: what editors, hooks and workflows read has other keys."""
    untitled = [
        block
        for block in SHOWN
        if block.language == "yaml" and not block.title + block.not_run and "reference" not in block.page.parts
    ]
    parts = [
        block
        for block in untitled
        if data(block)
        and not set(data(block)) & {"repos", "steps", "permissions"}
        and data(block).get("kind") != "Project"
    ]
    for page in pages():
        for number, line in enumerate(page.read_text("utf-8").splitlines(), 1):
            parts += [Block(page, number, "yaml", "", text) for text in INLINE.findall(line) if "…" not in text]
    return parts


def merged(base: Any, part: Any) -> Any:
    if not (isinstance(base, dict) and isinstance(part, dict)):
        return part
    kept = {key: value for key, value in base.items() if key not in part}
    return kept | {key: part[key] if key in REPLACED else merged(base.get(key), part[key]) for key in part}


@pytest.mark.parametrize("block", fragments(), ids=lambda block: f"{block.page.name}:{block.line}")
def test_a_part_of_a_spec_is_right_within_a_spec(block: Block, tmp_path: Path) -> None:
    base = YAML(typ="safe", pure=True).load(ROOT / "specs/grasp-planning-recorded.yaml")
    del base["spec"]["connectivity"]  # with it, a part that replaces the topics of the probe would let nothing pass
    shown = data(block)
    whole = merged(base, shown if "spec" in shown else {"spec": shown})
    path = tmp_path / "shown.yaml"
    YAML().dump(whole, path)
    wrong = [one for one in check_file([path])[1] if one.severity == "error" and not missing_file(one.message)]
    assert not wrong, [f"{one.code}: {one.message}" for one in wrong]


def test_the_project_file_that_is_shown_is_right() -> None:
    shown = [data(one) for one in SHOWN if one.language == "yaml" and "kind: Project" in one.text]
    assert {Project.model_validate(one).spec.state for one in shown} == {"git"}


def missing_file(message: str) -> bool:
    """Files of the reader's own are not here."""
    return "is not there" in message or "does not exist" in message


def test_the_readme_shows_the_spec_that_is_shipped() -> None:
    [block] = [one for one in SHOWN if one.page.name == "README.md" and one.language == "yaml"]
    shipped = YAML(typ="safe", pure=True).load(ROOT / "specs/grasp-planning-recorded.yaml")
    assert within(data(block), shipped)


def test_the_readme_shows_pictures_that_the_check_guards() -> None:
    """`make generated` makes them again and compares: a picture cannot differ from its data."""
    shown = re.findall(r"!\[[^]]+\]\(([^)]+)\)", (ROOT / "README.md").read_text("utf-8"))
    assert shown
    for path in shown:
        assert re.fullmatch(r"compiled/[\w-]+-recorded/\w+\.svg|docs/explanation/how-good\.svg", path)
        assert (ROOT / path).is_file()


def within(part: Any, whole: Any) -> bool:
    """Whether every value that is shown is that of the file; maps may show less."""
    if isinstance(part, dict) and isinstance(whole, dict):
        return all(key in whole and within(value, whole[key]) for key, value in part.items())
    return bool(part == whole)


def test_python_that_is_shown_parses() -> None:
    for block in SHOWN:
        if block.language == "python":
            ast.parse(block.text, f"{block.page}:{block.line}")
