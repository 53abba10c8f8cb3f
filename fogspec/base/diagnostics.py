"""Mistakes are data: a `Diagnostic` says what must hold, where, and how to mend it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Span:
    """Where in a file: 1-based line and column, and the width of what is underlined, in characters."""

    path: str
    line: int
    column: int
    width: int = 1


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """One mistake or warning about a file; `fix` says how to mend it, in words or as the text to write."""

    code: str
    message: str
    place: Span
    fix: str | None = None
    severity: Literal["error", "warning"] = "error"
    source_line: str | None = None


class DiagnosticError(Exception):
    """A file is wrong: carries every diagnostic found, errors first in their files' order. Exit code 1."""

    def __init__(self, diagnostics: Sequence[Diagnostic]) -> None:
        super().__init__("; ".join(f"{d.code}: {d.message}" for d in diagnostics))
        self.diagnostics = tuple(diagnostics)
