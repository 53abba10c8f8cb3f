"""Hooks of the documentation site (`hooks` in mkdocs.yml): the weight of pages in the search, and their descriptions."""

import re
from typing import Any

# Decisions say why, for contributors: they come after the pages that a reader wants. Generated tables repeat every word.
WEIGHTS = {
    "adr/": 0.02,
    "reference/files.md": 0.3,
    "reference/fields.md": 0.6,
    "style.md": 0.3,
    "reference/limits.md": 0.5,
}
MARKS = re.compile(r"\[([^\]]*)\]\([^)]*\)|[*`_]")
LONGEST = 160


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Give a page its weight in the search and, from its first paragraph, a description; return it unchanged."""
    for place, weight in WEIGHTS.items():
        if page.file.src_uri.startswith(place):
            page.meta.setdefault("search", {"boost": weight})
    if text := _first_paragraph(markdown):
        page.meta.setdefault("description", text)
    return markdown


def _first_paragraph(markdown: str) -> str:
    for part in re.split(r"\n\s*\n", markdown):
        if re.match(r"[A-Za-z*`\"]", part):
            text = " ".join(MARKS.sub(lambda mark: mark[1] or "", part).split())
            return text if len(text) <= LONGEST else text[: LONGEST - 3].rsplit(" ", 1)[0] + "..."
    return ""
