"""Hints for syntax errors: the likely cause, since a YAML parser often stops only after it."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

KEYED = re.compile(r"^\s*(- )?\s*[^\s#][^#]*?:(\s|$)|^\s*-\s")

SYNTAX = (
    (re.compile(r"unexpected end of stream"), "the quote must be closed", "add the closing quote at the end of this line"),
    (re.compile(r"mapping values are not allowed"), "a ':' cannot stand here",
     "put quotes around a text that holds ': ', or indent the line like its neighbours"),
    (re.compile(r"expected ',' or"), "the bracket must be closed", "close the bracket that starts here"),
    (re.compile(r"character '(.)' that cannot start"), "a plain text cannot start with this character",
     "put quotes around the text"),
    (re.compile(r"could not find expected ':'"), "a key must be followed by ':'", "add ': ' and a value, or remove the line"),
    (re.compile(r"expected <block end>"), "the line must be indented like its neighbours", "align it with the lines above"),
    (re.compile(r"undefined alias"), "the anchor must be defined before it is used", None),
)  # fmt: skip
TAB = "\t"
CONFLICT = ("<" * 7, "=" * 7, ">" * 7)
MISPLACED = ("mapping values are not allowed", "expected <block end>", "could not find expected ':'")


@dataclass(frozen=True, slots=True, kw_only=True)
class SyntaxHint:
    """The place (from 0), what must hold there, and how to mend it."""

    line: int
    column: int
    width: int
    message: str
    fix: str | None
    code: str = "FS104"


def _conflict(lines: Sequence[str]) -> SyntaxHint | None:
    """Return what to do about lines that git left of two changes that it could not merge; None without them."""
    marks = {
        mark: i for i, line in enumerate(lines) for mark in CONFLICT if line == mark or line.startswith(f"{mark} ")
    }
    if len(marks) < len(CONFLICT):
        return None
    first = next(i for i, line in enumerate(lines) if line.startswith(CONFLICT[0]))
    return SyntaxHint(
        line=first,
        column=0,
        width=len(lines[first]),
        message="a merge conflict must be resolved",
        fix=f"keep the lines of one side; remove those of the other and the lines {', '.join(CONFLICT)}",
        code="FS117",
    )


def syntax_hint(lines: Sequence[str], wrong: Any) -> SyntaxHint:
    """Return the most likely cause of the parser's error (ruamel.yaml's MarkedYAMLError)."""
    if (conflict := _conflict(lines)) is not None:
        return conflict
    problem, context = str(wrong.problem or wrong.context or ""), str(wrong.context or "")
    mark = wrong.problem_mark or wrong.context_mark
    if mark is None:
        return SyntaxHint(line=0, column=0, width=1, message=f"the text must be YAML: {problem}", fix=None)
    stop = min(mark.line, len(lines) - 1)
    if (blank := _other_blank(lines, stop)) is not None:
        return blank
    inside = "quoted" in context or "flow" in context
    if not inside and any(known in problem for known in MISPLACED):
        found = None if "simple key" in context else misplaced(lines, stop)
        if found is not None:
            line, message, fix = found
            column = _indent(lines[line])
            return SyntaxHint(
                line=line, column=column, width=max(1, len(lines[line].rstrip()) - column), message=message, fix=fix
            )
    if wrong.context_mark and (inside or "simple key" in context):
        mark = wrong.context_mark
    said = next(((said, mend) for pattern, said, mend in SYNTAX if pattern.search(problem)), None)
    if problem.startswith("found unexpected end of stream") and re.search(r"[\[{]", lines[mark.line][: mark.column]):
        said = ("the quote must be closed", "close the quote that starts here")
    message, fix_or_none = said or (f"the text must be YAML: {problem}", None)
    return SyntaxHint(
        line=min(mark.line, len(lines) - 1), column=mark.column, width=1, message=message, fix=fix_or_none
    )


def _other_blank(lines: Sequence[str], stop: int) -> SyntaxHint | None:
    """Return what to do about an indentation with tabs; or with no-break spaces or the like, for which the line after stops."""
    before = _before(lines, stop)
    for at in (stop, *([] if before is None else [before])):
        lead = lines[at][: len(lines[at]) - len(lines[at].lstrip())]
        if found := lead.lstrip(" ")[: 1 if at == stop else 0] or lead.strip(" \t")[:1]:
            return SyntaxHint(
                line=at,
                column=lead.index(found),
                width=1,
                message=f"indentation must be spaces, not {'tabs' if found == TAB else 'no-break spaces'}",
                fix=f"{'replace the tab' if found == TAB else 'indent it'} with {_wanted(lines, at)} spaces",
                code="FS105",
            )
    return None


def misplaced(lines: Sequence[str], stop: int) -> tuple[int, str, str] | None:
    """Return the line above `stop` (from 0) that explains why the parser stopped there, what must hold, and the fix.

    Return None if the line at `stop` itself is the cause.
    """
    before = _before(lines, stop)
    if before is None or _blank(lines[stop]):
        return None
    if not KEYED.match(lines[before]) and _opens_text(lines, before):
        return before, "a key must be followed by ': '", "add ':' and a space, or remove the line"
    above = before
    first = stop
    while _indent(lines[above]) >= _indent(lines[stop]):
        first, further = above, _before(lines, above)
        if further is None:
            return None
        above = further
    line = _odd_one(lines, stop, above, first, before)
    if line is None:
        return None
    good = _indent(lines[stop]) if line != above or first != stop else _indent(lines[stop]) - _dash(lines[above])
    return line, "the line must be indented like its neighbours", f"indent it with {good} spaces"


def _odd_one(lines: Sequence[str], stop: int, above: int, first: int, before: int) -> int | None:
    """Return the line around a break in indentation that does not fit.

    `above` is the nearest line that is indented less than `stop`, `first` the first line of the block under it.
    """
    here, step = _indent(lines[stop]), _step(lines)
    if here % step:
        return None
    if first == stop:
        if _dash(lines[above]):
            return above if here != _indent(lines[above]) + 2 else None
        earlier = _before(lines, above)
        slanted = _indent(lines[above]) % step != 0 and here % step == 0
        between = earlier is not None and _indent(lines[earlier]) == here
        return above if slanted or between else None
    inner = _indent(lines[first])
    if inner <= here:
        return None
    return above if inner - here == step and first != before and here - _indent(lines[above]) <= step else first


def _step(lines: Sequence[str]) -> int:
    """Return the number of spaces by which the file indents."""
    return min((_indent(line) for line in lines if not _blank(line) and _indent(line) > 1), default=2)


def _wanted(lines: Sequence[str], line: int) -> int:
    """Return the number of spaces that a line most likely needs: those of the one above, or a step more after `key:`."""
    above = _before(lines, line)
    if above is None:
        return _step(lines)
    return _indent(lines[above]) + (_step(lines) if lines[above].rstrip().endswith(":") else 0)


def _dash(line: str) -> int:
    return 2 if line.lstrip().startswith("- ") else 0


def _opens_text(lines: Sequence[str], line: int) -> bool:
    """Return whether a line without a key is not the continuation of a string that began above."""
    above = _before(lines, line)
    return above is None or not re.search(r"[|>][-+]?\s*(#.*)?$", lines[above])


def _before(lines: Sequence[str], line: int) -> int | None:
    """Return the previous line that is not blank."""
    return next((i for i in range(line - 1, -1, -1) if not _blank(lines[i])), None)


def _blank(line: str) -> bool:
    stripped = line.strip()
    return not stripped or stripped.startswith("#") or stripped == "---"


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip(" "))
