"""Diagnostics: what must hold, where it does not, and how to repair it."""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Span:
    """A place in a file: line and column from 1, and the number of characters to underline."""

    path: str
    line: int
    column: int
    width: int = 1


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """One error or warning about a file; `fix` is how to repair it, in words or as the text to write.

    `source_line` is the line at `span`, once a `SourceMap` has added it.
    """

    code: str
    message: str
    span: Span
    fix: str | None = None
    _: KW_ONLY
    severity: Literal["error", "warning"] = "error"
    source_line: str | None = None


class DiagnosticError(Exception):
    """A file is wrong: carries every diagnostic found, in the order of files and lines. Exit code 1."""

    def __init__(self, diagnostics: Sequence[Diagnostic]) -> None:
        super().__init__("; ".join(f"{d.code}: {d.message}" for d in diagnostics))
        self.diagnostics = tuple(diagnostics)

    def __reduce__(self) -> tuple[type["DiagnosticError"], tuple[tuple[Diagnostic, ...]]]:
        """Let it pass between processes."""
        return type(self), (self.diagnostics,)
