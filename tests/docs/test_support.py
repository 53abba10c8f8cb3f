"""The support matrix: what no report of `fogspec-lab conformance` shows stands in the table of what never ran."""

import re

from tests.conftest import ROOT
from tests.docs.reference import ENGINES

PAGE = ROOT / "docs/reference/support.md"
NAMED = {"AWS": "aws/", "Google Cloud": "gcp/", "Azure": "azure/", "Kubernetes": "kubernetes/"}


def test_what_was_never_exercised_has_a_command_and_a_cost() -> None:
    section = PAGE.read_text("utf-8").partition("\n## Never exercised\n")[2].partition("\n## ")[0]
    rows = [line.strip("|").split(" | ") for line in section.splitlines() if line.startswith("| ")][1:]
    assert rows
    assert [row for row in rows if len(row) != 3 or not re.search(r"`.+`|\]\(", row[1]) or not row[2].strip()] == []
    for name, title in ENGINES.items():
        if not (ROOT / "tests/data/conformance" / f"{name}.json").exists():
            assert any(title in what and NAMED[title] in command for what, command, _ in rows), title


def test_no_other_page_has_a_list_of_it() -> None:
    others = [path for path in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")] if path != PAGE]
    assert [path.name for path in others if re.search(r"[Nn]ever exercised\W*:", path.read_text("utf-8"))] == []
