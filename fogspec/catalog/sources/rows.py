"""A CSV file as columns of texts that remember their places, so that every mistake has a line and a column."""

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span
from fogspec.catalog.table import Floats, Strings

AT_MOST = 20  # mistakes told of one column, and of one file
UNKNOWN = ("", "nan")


@dataclass
class Rows:
    """Columns of `size` texts each; `lines` are the lines on which their rows end.

    Mistakes gather until `check`; `notes` say what was understood but left out.
    """

    path: str
    columns: dict[str, Sequence[str]]
    lines: Sequence[int]
    text: str
    notes: list[str] = field(default_factory=list)
    problems: list[Diagnostic] = field(default_factory=list)

    @property
    def size(self) -> int:
        """How many rows."""
        return len(self.lines)

    @cached_property
    def source(self) -> Sequence[str]:
        """The lines of the file, as the csv module counts them."""
        return [line.rstrip("\r\n") for line in io.StringIO(self.text, newline="")]

    def column(self, name: str) -> Sequence[str]:
        """The texts of a column; empty ones where the file has no such column."""
        return self.columns.get(name) or [""] * self.size

    def numbers(self, name: str) -> Floats:
        """The numbers of a column, NaN where its text is empty; texts that are no number become problems."""
        if name not in self.columns:
            return np.full(self.size, np.nan)
        texts = self.columns[name]
        try:
            known = {text: float(text) if text else math.nan for text in set(texts)}
        except ValueError:
            known = {text: _number(text) for text in set(texts)}
        odd = {text for text, number in known.items()
               if not 0 <= number < math.inf and text.strip().lower() not in UNKNOWN}  # fmt: skip
        for row in [row for row, text in enumerate(texts) if text in odd][:AT_MOST] if odd else ():
            self.problem(row, name, f"{name} must be a number that is not negative, not {texts[row]!r}")
        return np.fromiter(map(known.__getitem__, texts), np.float64, len(texts))

    def shared(self, name: str) -> Strings:
        """The texts of a column, equal ones being one object."""
        if name not in self.columns:
            return np.full(self.size, "", dtype=np.object_)
        texts = self.columns[name]
        return np.fromiter(map({text: text for text in set(texts)}.__getitem__, texts), np.object_, len(texts))

    def problem(self, row: int, name: str, message: str) -> None:
        """Remember a mistake in one field."""
        line = self.lines[row]
        text = self.source[line - 1]
        start, end = _field(text, list(self.columns).index(name))
        place = Span(self.path, line, start + 1, max(1, end - start))
        self.problems.append(Diagnostic("FS401", message, place, source_line=text))

    def note(self, rows: Sequence[int], what: str, names: Sequence[str]) -> None:
        """Say what is true of these rows, with the place of the first one."""
        if len(rows):
            have = "row has" if len(rows) == 1 else "rows have"
            first = f"{names[rows[0]]} at line {self.lines[rows[0]]}"
            self.notes.append(f"{self.path}: {len(rows):,} {have} {what}, such as {first}")

    def check(self) -> None:
        """Raise Problems for the mistakes so far, the first `AT_MOST` of them."""
        if self.problems:
            raise DiagnosticError(sorted(self.problems, key=lambda one: (one.place.line, one.place.column))[:AT_MOST])


def parse(content: bytes, path: str, required: Sequence[str]) -> Rows:
    """The rows of a CSV file in UTF-8 with a header; raises DiagnosticError."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as wrong:
        line = content.count(b"\n", 0, wrong.start) + 1
        column = wrong.start - content.rfind(b"\n", 0, wrong.start)
        raise _problems(path, line, "a catalog is CSV in UTF-8", column) from None
    rows, lines = _records(text, path)
    head = [name.strip() for name in rows[0]] if rows else []
    _check_header(head, path, required)
    width = len(head)
    if set(map(len, rows)) != {width}:
        ragged = next(i for i, row in enumerate(rows) if len(row) != width)
        message = f"a row must have {width} fields like the header, not {len(rows[ragged])}"
        raise _problems(path, lines[ragged], message)
    if len(rows) == 1:
        raise _problems(path, 1, "a catalog needs at least one row under its header")
    columns: dict[str, Sequence[str]] = dict(zip(head, zip(*rows[1:], strict=True), strict=True))
    return Rows(path, columns, lines[1:], text)


def _records(text: str, path: str) -> tuple[list[list[str]], Sequence[int]]:
    """Every record that is not an empty line, and the line on which it ends."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        rows = list(reader)
        if reader.line_num == len(rows) and [] not in rows:
            return rows, range(1, len(rows) + 1)
        reader = csv.reader(io.StringIO(text, newline=""))
        numbered = [(row, reader.line_num) for row in reader if row]
    except csv.Error as wrong:
        raise _problems(path, reader.line_num or 1, f"this is no CSV: {wrong}") from None
    return [row for row, _ in numbered], [line for _, line in numbered]


def _check_header(head: Sequence[str], path: str, required: Sequence[str]) -> None:
    if not head:
        raise _problems(path, 1, f"the catalog is empty; it needs the columns {', '.join(required)}")
    if missing := [name for name in required if name not in head]:
        raise _problems(path, 1, f"a catalog needs the columns {', '.join(required)}; missing: {', '.join(missing)}")
    if twice := sorted({name for name in head if name and head.count(name) > 1}):
        raise _problems(path, 1, f"a column must stand once: {', '.join(twice)}")


def _field(line: str, index: int) -> tuple[int, int]:
    """Where the field with this index starts and ends in a line; all of the line where it cannot be told."""
    starts, quoted = [0], False
    for position, character in enumerate(line):
        if character == '"':
            quoted = not quoted
        elif character == "," and not quoted:
            starts.append(position + 1)
    starts.append(len(line) + 1)
    return (starts[index], starts[index + 1] - 1) if index + 1 < len(starts) else (0, len(line))


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _problems(path: str, line: int, message: str, column: int = 1) -> DiagnosticError:
    return DiagnosticError([Diagnostic("FS401", message, Span(path, line, column))])
