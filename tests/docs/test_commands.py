"""Every command that README and docs show does what they show."""

import re
from pathlib import Path

import pytest

from tests.docs.blocks import ROOT, blocks, pages
from tests.docs.running import mistakes, run

FRESH = "make demo\nmake test"
WITH_ROS = (ROOT / "docs/tutorial-ros2.md",)  # tests/ros/test_tutorial.py runs it
RUN = [
    page
    for page in pages()
    if page not in WITH_ROS and any(block.run and block.text != FRESH for block in blocks(page))
]


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("page", RUN, ids=name)
def test_a_page_does_what_it_shows(page: Path, tmp_path: Path) -> None:
    wrong = mistakes(page, run(page, tmp_path))
    assert not wrong, "\n\n".join(wrong)
    # A quote that begins with a heading is of a comment, as GitHub renders it.
    if quoted := re.search(r"^> #(?:.*\n>)+.*$", page.read_text("utf-8"), re.MULTILINE):
        comment = re.sub(r"^> ?", "", quoted[0], flags=re.MULTILINE)
        assert comment in (tmp_path / "checkout/comment.md").read_text("utf-8")


def test_the_readme_begins_with_the_two_commands_that_ci_runs() -> None:
    assert blocks(ROOT / "README.md")[0].text == FRESH
    lines = (ROOT / ".ci/run").read_text("utf-8").splitlines()
    assert [line for line in lines if line in FRESH.splitlines()] == FRESH.splitlines()


def test_what_ci_does_not_run_is_little_and_says_why() -> None:
    unchecked = [block for page in pages() for block in blocks(page) if block.commands and not block.run]
    checked = [block for page in pages() for block in blocks(page) if block.run]
    assert all(len(block.not_run) > 10 for block in unchecked)
    # A reason may name the test that runs its commands elsewhere.
    elsewhere = {path for block in unchecked for path in re.findall(r"tests/[\w/]+(?:\.py)?", block.not_run)}
    assert all((ROOT / path).exists() for path in elsewhere)
    unchecked = [block for block in unchecked if "tests/" not in block.not_run]
    assert len(unchecked) * 4 <= len(checked), [f"{name(one.page)}:{one.line}" for one in unchecked]


def test_every_block_has_a_language_that_says_what_it_is() -> None:
    known = {"console", "sh", "yaml", "json", "python", "csv", "text", "toml", "ini", "dockerfile", "mermaid"}
    odd = [f"{name(b.page)}:{b.line}: {b.language!r}" for page in pages() for b in blocks(page)
           if b.language not in known and b.text != FRESH]  # fmt: skip
    assert not odd
