"""Report diagnostics as text for people, JSON for programs, or annotations for GitHub."""

import json
import os
import platform
import sys
import traceback
import unicodedata
from collections import Counter
from collections.abc import Sequence
from typing import Any, Literal

import click

from fogspec import __version__
from fogspec.base.diagnostics import Diagnostic

Output = Literal["text", "json", "github"]

MOST_SHOWN = 50
MOST_COLUMNS = 160


def show_diagnostics(diagnostics: Sequence[Diagnostic], output: str = "text", color: bool | None = None) -> None:
    """Print diagnostics: text on stderr, JSON and GitHub annotations on stdout.

    If `color` is None, text is colored only on a terminal and only if NO_COLOR is not set.
    """
    if output == "json":
        click.echo(json.dumps([as_data(one) for one in diagnostics], ensure_ascii=False, indent=2))
    elif output == "github":
        for one in diagnostics:
            click.echo(annotation(one))
    else:
        if color is None:
            color = sys.stderr.isatty() and not os.environ.get("NO_COLOR")
        for one in diagnostics[:MOST_SHOWN]:
            click.echo(as_text(one, color) + "\n", err=True, color=color)
        if len(diagnostics) > MOST_SHOWN:
            click.echo(
                f"... and {len(diagnostics) - MOST_SHOWN} more: `fogspec validate -o json` shows all\n", err=True
            )
        if diagnostics:
            click.echo(summary(diagnostics), err=True)


def as_text(one: Diagnostic, color: bool = False) -> str:
    """Return the diagnostic with its source line and carets under the span."""
    span, hue = one.span, "red" if one.severity == "error" else "yellow"

    def paint(text: str, **style: Any) -> str:
        return click.style(text, **style) if color else text

    head = paint(f"{one.severity}[{one.code}]", fg=hue, bold=True) + paint(f": {_clean(one.message)}", bold=True)
    where = f"{_clean(span.path)}:{span.line}:{span.column}"
    if one.source_line is None:
        tail = [f" = {_clean(one.fix)}"] if one.fix else []
        return "\n".join([head, f" --> {where}", *tail])
    number = str(span.line)
    gutter = " " * len(number)
    line, before, width = _window(one.source_line, span.column - 1, span.width)
    carets = paint("^" * width + (f" {_clean(one.fix)}" if one.fix else ""), fg=hue)
    return "\n".join(
        [
            head,
            f"{gutter}--> {where}",
            f"{gutter} |",
            f"{number} | {line}".rstrip(),
            f"{gutter} | {' ' * before}{carets}",
        ]
    )


def as_data(one: Diagnostic) -> dict[str, Any]:
    """Return the diagnostic as a dict for JSON; lines and columns count from 1."""
    return {
        "severity": one.severity,
        "code": one.code,
        "message": one.message,
        "fix": one.fix,
        "path": one.span.path,
        "line": one.span.line,
        "column": one.span.column,
        "width": one.span.width,
    }


def annotation(one: Diagnostic) -> str:
    """Return a GitHub workflow command that annotates the line in a pull request."""
    span = one.span
    end = span.column + span.width - 1
    where = f"file={_property(span.path)},line={span.line},endLine={span.line},col={span.column},endColumn={end}"
    text = f"{one.message}; {one.fix}" if one.fix else one.message
    return f"::{one.severity} {where},title={_property(one.code)}::{_data(text)}"


def summary(diagnostics: Sequence[Diagnostic]) -> str:
    """Count the diagnostics by severity and file, and name the command that explains the first."""
    count = Counter(one.severity for one in diagnostics)
    files = len({one.span.path for one in diagnostics})
    counts = [f"{number} {word}{'' if number == 1 else 's'}" for word, number in sorted(count.items())]
    return f"{', '.join(counts)} in {files} file{'' if files == 1 else 's'}; `fogspec explain {diagnostics[0].code}` says more"


def bug_paragraph(bug: BaseException) -> str:
    """Return a paragraph to paste into an issue: the location in fogspec, without paths or values."""
    frames = traceback.extract_tb(bug.__traceback__)
    ours = [frame for frame in frames if f"{os.sep}fogspec{os.sep}" in frame.filename] or frames
    steps = " < ".join(
        f"{frame.filename.rpartition(f'{os.sep}fogspec{os.sep}')[2]}:{frame.lineno} {frame.name}"
        for frame in reversed(ours[-4:])
    )
    return (
        f"fogspec has a bug, and nothing is wrong with your files: {type(bug).__name__} at {steps or 'an unknown place'} "
        f"(fogspec {__version__}, Python {platform.python_version()}, {platform.system()}). Please report this paragraph, "
        f"with the message if it holds nothing private: {_clean(str(bug))[:300]}"
    )


def _window(line: str, start: int, width: int) -> tuple[str, int, int]:
    """Return the part of a line to show, the cells before the caret, and the cells under it."""
    start = min(start, len(line))
    left = max(0, start - MOST_COLUMNS // 2) if len(line) > MOST_COLUMNS else 0
    shown = line[left : left + MOST_COLUMNS]
    marked = shown[start - left : start - left + width]
    lead, trail = "…" if left else "", "…" if left + MOST_COLUMNS < len(line) else ""
    before = _cells(_clean(shown[: start - left])) + len(lead)
    return lead + _clean(shown) + trail, before, max(1, _cells(_clean(marked)))


def _cells(text: str) -> int:
    """Return the number of terminal cells that the text takes."""
    wide = sum(1 for character in text if unicodedata.east_asian_width(character) in "WF")
    return len(text) + wide - sum(1 for character in text if unicodedata.combining(character))


def _clean(text: str | None) -> str:
    """Return the text without control characters, which a terminal would interpret."""
    return "".join(_visible(character) for character in text or "")


def _visible(character: str) -> str:
    if character.isprintable():
        return character
    return " " if character in "\t\n" else "�"


def _data(text: str) -> str:
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def _property(text: str) -> str:
    return _data(text).replace(":", "%3A").replace(",", "%2C")
