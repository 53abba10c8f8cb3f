"""The data in a report's page, read as a browser reads HTML: by Python's own parser, not by ours."""

import json
from collections import Counter
from html.parser import HTMLParser

import pytest

from tests.support.running import CATALOG, Shell, measure, project, shell  # noqa: F401

AT = ("--catalog", "offers.csv")


class Page(HTMLParser):
    """The elements of a page, and the text of each script and of each heading of a table."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: Counter[str] = Counter()
        self.handlers: list[str] = []
        self.scripts: list[str] = []
        self.cells: list[str] = []
        self.inside = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements[tag] += 1
        self.handlers += [name for name, _ in attrs if name.startswith("on")]
        self.inside = tag
        if tag == "script":
            self.scripts.append("")
        if tag == "th":
            self.cells.append("")

    def handle_endtag(self, tag: str) -> None:
        self.inside = ""

    def handle_data(self, data: str) -> None:
        if self.inside == "script":
            self.scripts[-1] += data
        if self.inside == "th":
            self.cells[-1] += data


def page(shell: Shell, instance: str) -> tuple[str, Page]:
    shell.write("offers.csv", CATALOG.replace("a.large", instance))
    shell("compile", *AT)
    measure(shell)
    shell("compile", *AT)
    shell("report", "specs/demo.yaml")
    text = shell.read("compiled/demo/report.html")
    return text, Page(text)


@pytest.mark.parametrize("tail", ["</script><script>alert(1)</script>", "<!--<script>", "&lt;/script&gt;"])
def test_no_name_of_a_machine_ends_the_script_that_it_is_in(shell: Shell, tail: str) -> None:
    project(shell)
    _, plain = page(shell, "a.largex")
    text, hostile = page(shell, f"a.large{tail}")
    active = ("script", "style", "img", "svg", "iframe", "object", "link", "a", "form", "input")
    assert [hostile.elements[one] for one in active] == [plain.elements[one] for one in active]
    assert hostile.handlers == plain.handlers
    assert "a.largex" in plain.cells
    assert f"a.large{tail}" in hostile.cells, "and the names are what they were"
    assert len(json.loads(hostile.scripts[0])["machines"]) == len(json.loads(plain.scripts[0])["machines"]) > 1
    assert not set(hostile.scripts[0]) & set("<>&"), "nothing in it is markup to any reader"
    assert "alert(1)</script>" not in text
