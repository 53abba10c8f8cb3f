"""The site builds, asks nobody, and names only what is there."""

import re
from pathlib import Path

from fogspec.language.field_docs import pages as field_pages
from fogspec.language.schema import Application
from tests.docs import reference
from tests.docs.blocks import ROOT, pages
from tests.support.site import site  # noqa: F401

LOADS = re.compile(r"""<(?:script|link|img|iframe|source|use)\b[^>]*?(?:src|href|srcset)=["']?(?:https?:)?//[^"'> ]+""")
NOT_LOADED = re.compile(r"""<link\b[^>]*rel=["']?canonical""")
IN_CODE = re.compile(r"`((?:tests|fogspec|specs|templates|docs|results)/[\w./-]*\w\.\w+)`")


def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    found = [f"{page.name}: {tag}" for page in site.rglob("*.html")
             for tag in LOADS.findall(page.read_text("utf-8")) if not NOT_LOADED.match(tag)]  # fmt: skip
    assert not found
    styles = [f"{path.name}: {url}" for path in site.rglob("*.css")
              for url in re.findall(r"url\([\"']?(?:https?:)?//[^)]+\)|@import[^;]+", path.read_text("utf-8"))]  # fmt: skip
    assert not styles


def test_every_page_is_in_the_search(site: Path) -> None:
    index = (site / "search" / "search_index.json").read_text("utf-8")
    for name in ("tutorial.html", "howto/prices.html", "reference/verbs.html", "explanation/cost.html"):
        assert name in index


def test_generated_pages_are_what_the_code_writes() -> None:
    for path, text in reference.generated().items():
        assert path.read_text("utf-8") == text, f"{path.name}: python -m tests.docs.reference writes it anew"


def test_the_page_of_fields_says_what_explain_says() -> None:
    shown = (ROOT / "docs/reference/fields.md").read_text("utf-8")
    plain = shown.replace("\\", "").replace("&lt;", "<")
    rows = {
        found[1].replace("[]", ""): found[2] for found in re.finditer(r"^\| \**`(.+?)`\** \| (.*)", plain, re.MULTILINE)
    }
    same = [
        (path, found[1]) for path, row in rows.items() if (found := re.search(r"fields as in `(.+?)(?:\[\])?`", row))
    ]
    for page in field_pages(Application):
        name = page.path.replace("[]", "")
        [row] = {rows[path] for path in rows if path == name} or {
            rows[name.replace(path, first, 1)] for path, first in same if name.startswith(path)
        }
        for said in (
            page.meaning,
            page.type,
            page.limits,
            "" if page.default in ("not set", "{}", "[]") else page.default,
        ):
            assert said.replace("\\", "") in row, f"{page.path}: {said}"
        assert page.unit in plain


def test_files_that_pages_name_are_there() -> None:
    made = re.compile(r"^(specs/(NAME|places|tiny|lab|my-planner)|results/NAME|fogspec/backends/mine)")
    missing = [f"{page.name}: {name}" for page in pages() for name in IN_CODE.findall(page.read_text("utf-8"))
               if not made.match(name) and not (ROOT / name).exists()]  # fmt: skip
    assert not missing


def test_decisions_are_named_beside_code_only_and_are_there() -> None:
    there = {path.name[:4] for path in (ROOT / "docs/adr").glob("[0-9]*.md")}
    rooms = [path for room in ("fogspec", "lab", "probe", "tests") for path in (ROOT / room).rglob("*.py")]
    lost = [f"{path.relative_to(ROOT)}: {one}" for path in [ROOT / "CONTRIBUTING.md", *(ROOT / "docs/adr").glob("*.md"), *rooms]
            for one in re.findall(r"\bADR (\d{4})", path.read_text("utf-8")) if one not in there]  # fmt: skip
    assert not lost
    users = [page for page in pages() if page.is_relative_to(ROOT / "docs") or page.name == "README.md"]
    assert not [page.name for page in users if re.search(r"\bADR \d", page.read_text("utf-8"))]


def test_no_page_names_a_machine_of_ours() -> None:
    private = re.compile(r"/(?:work|root|tmp)/|localhost|127\.0\.0\.1:\d")
    wrong = [f"{page.name}: {found[0]}" for page in [*pages(), *(ROOT / "docs/adr").glob("*.md")]
             if (found := private.search(page.read_text("utf-8")))]  # fmt: skip
    assert not wrong
