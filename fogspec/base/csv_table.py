"""A CSV file as columns of text that remember their places, so that every mistake has a line and a column."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span
from fogspec.base.quantities import Bounds
from fogspec.base.yaml.scalars import HIDDEN

SHOWN = 20  # mistakes shown of one column, and of one file
UNKNOWN = ("", "nan")
MOST_BYTES = 64 << 20
MOST_ROWS = 500_000
MOST_COLUMNS = 256
MOST_FIELDS = 10_000_000  # commas and line ends, also those inside of quotes
LONGEST_FIELD = 16 << 10
SIZES = Bounds(1e-12, 1e12)  # of whatever a table measures; beyond them products and ratios would not be finite


@dataclass(kw_only=True)
class CsvTable:
    """Columns of `size` texts each; `lines` are the lines on which their rows end.

    Problems gather, under the diagnostic code `code`, until `check`.
    """

    path: str
    code: str
    columns: Mapping[str, Sequence[str]]
    lines: Sequence[int]
    text: str = field(repr=False)
    problems: list[Diagnostic] = field(default_factory=list)

    @property
    def size(self) -> int:
        """Return the number of rows."""
        return len(self.lines)

    @cached_property
    def source(self) -> Sequence[str]:
        """The lines of the file, as the csv module counts them."""
        return [line.rstrip("\r\n") for line in io.StringIO(self.text, newline="")]

    def column(self, name: str) -> Sequence[str]:
        """Return the texts of a column; empty ones if the file has no such column."""
        return self.columns.get(name) or [""] * self.size

    def numbers(self, name: str, *, positive: bool = False, bounds: Bounds = SIZES) -> NDArray[np.float64]:
        """Return the numbers of a column, NaN for an empty text.

        A text that is neither 0 nor a number within the bounds is a problem; with `positive`, so are 0 and an empty text.
        """
        if name not in self.columns:
            return np.full(self.size, np.nan)
        texts = self.columns[name]
        known = {text: _number(text) for text in set(texts)}
        wrong = {text for text, number in known.items() if not _is_valid(text, number, positive, bounds)}
        for row in [row for row, text in enumerate(texts) if text in wrong][:SHOWN] if wrong else ():
            self.problem(row, name, _wrong_number(name, texts[row], known[texts[row]], positive, bounds))
        return np.fromiter(map(known.__getitem__, texts), np.float64, len(texts))

    def shared(self, name: str) -> NDArray[np.object_]:
        """Return the texts of a column, equal ones being one object; a text with a hidden character is a problem."""
        if name not in self.columns:
            return np.full(self.size, "", dtype=np.object_)
        texts = self.columns[name]
        if hidden := {text for text in set(texts) if HIDDEN.search(text)}:
            for row in [row for row, text in enumerate(texts) if text in hidden][:SHOWN]:
                self.problem(row, name, f"{name} has a character that cannot be seen: {texts[row]!a}")
        return np.fromiter(map({text: text for text in set(texts)}.__getitem__, texts), np.object_, len(texts))

    def records(self) -> list[dict[str, str]]:
        """Return each row as a mapping of columns to texts."""
        return [dict(zip(self.columns, row, strict=True)) for row in zip(*self.columns.values(), strict=True)]

    def problem(self, row: int, name: str, message: str) -> None:
        """Record a problem of one field."""
        line = self.lines[row]
        text = self.source[line - 1]
        start, end = _field(text, list(self.columns).index(name))
        place = Span(self.path, line, start + 1, max(1, end - start))
        self.problems.append(Diagnostic(self.code, message, place, source_line=text))

    def check(self) -> None:
        """Raise DiagnosticError for the problems so far, the first `SHOWN` of them."""
        if self.problems:
            raise DiagnosticError(sorted(self.problems, key=lambda one: (one.span.line, one.span.column))[:SHOWN])


def parse_csv(content: bytes, path: str, required: Sequence[str], *, code: str, what: str) -> CsvTable:
    """Return the table of a CSV file in UTF-8 with a header; `what` begins the messages about the whole file.

    Raises DiagnosticError, with diagnostics of this code, for a file without rows or required columns and for a ragged row.
    """

    def problem(line: int, message: str, column: int = 1) -> DiagnosticError:
        return DiagnosticError([Diagnostic(code, message, Span(path, line, column))])

    if len(content) > MOST_BYTES:
        raise problem(1, f"{what} has at most {MOST_BYTES >> 20} MiB")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as wrong:
        line = content.count(b"\n", 0, wrong.start) + 1
        raise problem(line, f"{what} is CSV in UTF-8", wrong.start - content.rfind(b"\n", 0, wrong.start)) from None
    if text.count(",") + text.count("\n") + text.count("\r") > MOST_FIELDS:
        raise problem(1, f"{what} has at most {MOST_FIELDS:,} fields")
    try:
        rows, lines = _records(text)
    except _NoCsv as wrong:
        raise problem(wrong.line, f"this is not CSV: {wrong}") from None
    head = [name.strip() for name in rows[0]] if rows else []
    if (message := _wrong_header(head, required, what)) is not None:
        raise problem(1, message)
    width = len(head)
    if len(rows) > MOST_ROWS + 1:
        raise problem(lines[MOST_ROWS + 1], f"{what} has at most {MOST_ROWS:,} rows")
    if set(map(len, rows)) != {width}:
        ragged = next(i for i, row in enumerate(rows) if len(row) != width)
        raise problem(lines[ragged], f"a row must have {width} fields like the header, not {len(rows[ragged])}")
    if len(rows) == 1:
        raise problem(1, f"{what} needs at least one row under its header")
    columns = dict(zip(head, zip(*rows[1:], strict=True), strict=True))
    return CsvTable(path=path, code=code, columns=columns, lines=lines[1:], text=text)


class _NoCsv(Exception):
    def __init__(self, message: str, line: int) -> None:
        super().__init__(message)
        self.line = line


def _records(text: str) -> tuple[list[list[str]], Sequence[int]]:
    """Return every record that is not an empty line, and the line on which it ends."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    before = csv.field_size_limit(LONGEST_FIELD)
    try:
        rows = list(reader)
        if reader.line_num == len(rows) and [] not in rows:
            return rows, range(1, len(rows) + 1)
        reader = csv.reader(io.StringIO(text, newline=""))
        numbered = [(row, reader.line_num) for row in reader if row]
    except csv.Error as wrong:
        raise _NoCsv(str(wrong), reader.line_num or 1) from None
    finally:
        csv.field_size_limit(before)
    return [row for row, _ in numbered], [line for _, line in numbered]


def _wrong_header(head: Sequence[str], required: Sequence[str], what: str) -> str | None:
    if not head:
        return f"{what} is empty; it needs the columns {', '.join(required)}"
    if len(head) > MOST_COLUMNS:
        return f"{what} has at most {MOST_COLUMNS} columns, not {len(head):,}"
    if missing := [name for name in required if name not in head]:
        return f"{what} needs the columns {', '.join(required)}; missing: {', '.join(missing)}"
    if twice := sorted({name for name in head if name and head.count(name) > 1}):
        return f"a column must stand once: {', '.join(twice)}"
    return None


def _is_valid(text: str, number: float, positive: bool, bounds: Bounds) -> bool:
    return bounds.holds(number) or (not positive and (number == 0 or text.strip().lower() in UNKNOWN))


def _wrong_number(name: str, text: str, number: float, positive: bool, bounds: Bounds) -> str:
    if 0 < number < math.inf:
        return f"{name} must be {bounds.text}, not {text!r}"
    if not positive:
        return f"{name} must be a number that is not negative, not {text!r}"
    return (
        f"{name} is not a number: {text!r}" if number != number else f"{name} must be positive and finite, got {text!r}"
    )


def _field(line: str, index: int) -> tuple[int, int]:
    """Return where the field with this index starts and ends in a line; the whole line if it is unknown."""
    starts, quoted = [0], False
    for position, character in enumerate(line):
        if character == '"':
            quoted = not quoted
        elif character == "," and not quoted:
            starts.append(position + 1)
    starts.append(len(line) + 1)
    return (starts[index], starts[index + 1] - 1) if index + 1 < len(starts) else (0, len(line))


def _number(text: str) -> float:
    """Return the number, NaN for what is none in a spec either: Python also reads `1_000`, and digits of other scripts."""
    try:
        return float(text) if text.isascii() and "_" not in text else math.nan
    except ValueError:
        return math.nan
