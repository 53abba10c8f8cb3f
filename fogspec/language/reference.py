"""Pages of fields and codes for the terminal, made from the types and the table of codes."""

import dataclasses
import textwrap
from collections.abc import Sequence
from typing import Any

from fogspec.base.diagnostics import Span
from fogspec.base.yaml.writer import flow
from fogspec.language.codes import codes
from fogspec.language.field_docs import FieldPage
from fogspec.language.schema import BASIC


def code_text(name: str) -> str:
    """Return the page of a code, for the terminal."""
    page = codes()[name]
    parts = [f"{name}: {page.title}", textwrap.fill(page.why, 100)]
    if page.wrong:
        parts.append(f"wrong:\n{_indented(page.wrong)}")
    if page.right:
        parts.append(f"right:\n{_indented(page.right)}")
    return "\n\n".join(parts)


def field_text(page: FieldPage, spans: Sequence[tuple[Span, str]] = ()) -> str:
    """Return the page of a field, for the terminal, with the spans that set it."""
    rows = [
        ("meaning", page.meaning),
        ("type", page.type),
        ("range", page.limits),
        ("unit", page.unit),
        ("default", page.default),
        ("tier", page.tier if page.tier == BASIC.name else ""),
        ("example", f"{_key(page)}: {flow(page.example)}" if page.example is not None else ""),
    ]
    rows += [("set at", f"{span.path}:{span.line}:{span.column}  {line.strip()}") for span, line in spans]
    return "\n".join([page.path, *(f"  {name:<8} {text}" for name, text in rows if text)])


def field_data(page: FieldPage, spans: Sequence[tuple[Span, str]] = ()) -> dict[str, Any]:
    """Return the page of a field as JSON data."""
    set_at = [{"path": span.path, "line": span.line, "column": span.column} for span, _ in spans]
    return {**dataclasses.asdict(page), "set_at": set_at}


def _key(page: FieldPage) -> str:
    return page.path.rpartition(".")[2]


def _indented(text: str) -> str:
    return textwrap.indent(text, "    ")
