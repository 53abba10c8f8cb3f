"""Report diagnostics as text for people, JSON for programs, or annotations for GitHub."""

import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from typing import Any, Literal

from fogspec import __version__
from fogspec.base.console import has_color, is_quiet, say, say_json, say_text, styled
from fogspec.base.diagnostics import Diagnostic
from fogspec.base.text import line, visible

Output = Literal["text", "json", "github"]

MOST_SHOWN = 50
MOST_COLUMNS = 160
IN_PACKAGE = re.compile(r".*/(?:fogspec/|(?=fogspec_lab/))(.*)")


def show_diagnostics(diagnostics: Sequence[Diagnostic], output: str = "text", color: bool | None = None) -> None:
    """Print diagnostics: text on stderr, JSON and GitHub annotations on stdout.

    If `color` is None, text is colored only on a terminal and only if NO_COLOR is not set.
    """
    if output == "json":
        say_json([as_data(one) for one in diagnostics])
    elif output == "github":
        for one in diagnostics:
            say(annotation(one))
    else:
        if is_quiet():
            diagnostics = [one for one in diagnostics if one.severity == "error"]
        if color is None:
            color = has_color(err=True)
        for one in diagnostics[:MOST_SHOWN]:
            say_text(as_text(one, color) + "\n", err=True, color=color)
        if len(diagnostics) > MOST_SHOWN:
            say(f"... and {len(diagnostics) - MOST_SHOWN} more: `fogspec validate -o json` shows all", "", err=True)
        if diagnostics:
            say(summary(diagnostics), err=True)


def as_text(one: Diagnostic, color: bool = False) -> str:
    """Return the diagnostic with its source line and carets under the span."""
    span, hue = one.span, "red" if one.severity == "error" else "yellow"

    def paint(text: str, **style: Any) -> str:
        return styled(text, **style) if color else text

    head = paint(f"{one.severity}[{one.code}]", fg=hue, bold=True) + paint(f": {line(one.message)}", bold=True)
    where = f"{line(span.path)}:{span.line}:{span.column}"
    if one.source_line is None:
        tail = [f" = {line(one.fix)}"] if one.fix else []
        return "\n".join([head, f" --> {where}", *tail])
    number = str(span.line)
    gutter = " " * len(number)
    shown, before, width = _window(one.source_line, span.column - 1, span.width)
    carets = paint("^" * width + (f" {line(one.fix)}" if one.fix else ""), fg=hue)
    return "\n".join(
        [
            head,
            f"{gutter}--> {where}",
            f"{gutter} |",
            f"{number} | {shown}".rstrip(),
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
    """Count the diagnostics by severity and file, and name the command that explains the first error, or warning."""
    count = Counter(one.severity for one in diagnostics)
    files = len({one.span.path for one in diagnostics})
    first = next((one for one in diagnostics if one.severity == "error"), diagnostics[0])
    counts = [f"{number} {word}{'' if number == 1 else 's'}" for word, number in sorted(count.items())]
    return f"{', '.join(counts)} in {files} file{'' if files == 1 else 's'}; details: fogspec explain {first.code}"


def bug_paragraph(bug: BaseException) -> str:
    """Return a paragraph to paste into an issue: the location in fogspec, without paths or values."""
    import platform
    import traceback

    frames = traceback.extract_tb(bug.__traceback__)
    ours = [(frame, place) for frame in frames if (place := IN_PACKAGE.match(frame.filename))]
    steps = " < ".join(f"{place[1]}:{frame.lineno} {frame.name}" for frame, place in reversed(ours[-4:]))
    return (
        f"fogspec has a bug, and nothing is wrong with your files: {type(bug).__name__} at {steps or 'an unknown place'} "
        f"(fogspec {__version__}, Python {platform.python_version()}, {platform.system()}). Please report this paragraph, "
        f"with the message if it holds nothing private: {line(str(bug))[:300]}"
    )


def _window(source: str, start: int, width: int) -> tuple[str, int, int]:
    """Return the part of a line to show, the cells before the caret, and the cells under it."""

    def shown(left: int, right: int) -> str:
        return visible(source[left:right]).replace("\t", " ")

    start = min(start, len(source))
    left = max(0, start - MOST_COLUMNS // 2) if len(source) > MOST_COLUMNS else 0
    right = left + MOST_COLUMNS
    lead, trail = "…" if left else "", "…" if right < len(source) else ""
    before, marked = shown(left, start), shown(start, min(start + width, right))
    return lead + shown(left, right) + trail, _cells(before) + len(lead), max(1, _cells(marked))


def _cells(text: str) -> int:
    """Return the number of terminal cells that the text takes."""
    wide = sum(1 for character in text if unicodedata.east_asian_width(character) in "WF")
    return len(text) + wide - sum(1 for character in text if unicodedata.combining(character))


def _data(text: str) -> str:
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def _property(text: str) -> str:
    return _data(text).replace(":", "%3A").replace(",", "%2C")
