"""Read files into trees of values; every error has its span."""

import dataclasses
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fogspec.base.diagnostics import Diagnostic, Span
from fogspec.base.files import PULL, read_file
from fogspec.base.project_files import ProjectFiles
from fogspec.base.yaml import reader
from fogspec.base.yaml.positions import Node

NOT_SHOWN = ("FS509",)  # what looks like a private key must not be in CI's log too
MISSING = ("FS302", "FS501", "FS503", "FS512", "FS522")


@dataclass
class SourceMap:
    """The source map: lines of every file that was read, so that a diagnostic can show them, and its bytes."""

    lines: dict[str, list[str]] = field(default_factory=dict)
    content: dict[str, bytes] = field(default_factory=dict)
    hidden: set[tuple[str, int]] = field(default_factory=set)  # lines by file and number that nothing may show

    def shown(self, diagnostics: Iterable[Diagnostic]) -> list[Diagnostic]:
        """Return the diagnostics with their source lines, by file and line, errors first at a span."""
        given = list(diagnostics)
        self.hidden |= {(one.span.path, one.span.line) for one in given if one.code in NOT_SHOWN}
        found = [
            one
            if (one.span.path, one.span.line) in self.hidden
            else dataclasses.replace(one, source_line=self.line(one.span))
            for one in given
        ]
        files = list(self.lines)
        return sorted(
            found, key=lambda one: (_rank(files, one.span.path), one.span.line, one.span.column, one.severity)
        )

    def line(self, span: Span) -> str | None:
        """Return the source line of a span if its file was read."""
        lines = self.lines.get(span.path, [])
        return lines[span.line - 1] if 0 < span.line <= len(lines) else None

    def last_line(self, path: str) -> int:
        """Return the number of the last line of a file that is not blank, from 1."""
        lines = self.lines.get(path, [])
        return max((i for i, line in enumerate(lines, start=1) if line.strip()), default=1)

    def at_the_cut(self, diagnostics: Sequence[Diagnostic]) -> list[Diagnostic]:
        """Move errors about missing fields to the end of a file that looks cut off."""
        return [self._at_the_cut(one) for one in diagnostics]

    def _at_the_cut(self, one: Diagnostic) -> Diagnostic:
        lines = self.lines.get(one.span.path, [])
        if one.code not in MISSING or not lines or not lines[-1]:
            return one
        last = self.last_line(one.span.path)
        span = Span(one.span.path, last, 1, len(lines[last - 1]))
        return dataclasses.replace(
            one, span=span, fix=f"{one.fix}; the file ends here without a line feed: was it cut?"
        )


@dataclass
class Reading:
    """The specs that a command reads to find and to load them: the content of each file by path, and its parsed documents."""

    contents: dict[str, bytes] = field(default_factory=dict)
    parsed: dict[str, tuple[str, list[Node], list[Diagnostic]]] = field(default_factory=dict)

    def content(self, path: str, files: ProjectFiles | None = None) -> bytes:
        """Return the beginning of a file, as far as a spec may be long, in a project by its `files`; raise OSError."""
        at, most = os.path.normpath(path), reader.MOST_BYTES + 1
        if at not in self.contents:
            self.contents[at] = read_file(path, most) if files is None else files.head(Path(path), most)
        return self.contents[at]


def documents_of(
    path: str | os.PathLike[str], texts: SourceMap, wrong: list[Diagnostic], reading: Reading
) -> tuple[list[Node], bool]:
    """Return the documents of a file, and whether it could be read to its end."""
    name = os.fspath(path)
    if name in texts.lines:
        wrong.append(Diagnostic("FS101", "the file must be named only once", Span(name, 1, 1)))
        return [], False
    texts.lines[name] = []
    try:
        content = reading.content(name)
    except OSError as problem:
        wrong.append(unreadable(name, problem))
        return [], False
    return documents_in(content, name, texts, wrong, parsed=reading.parsed)


def unreadable(name: str, problem: OSError) -> Diagnostic:
    """Return the diagnostic of a file that cannot be read."""
    why = problem.strerror or str(problem)
    said = f"the file cannot be read: {why[:1].lower()}{why[1:].removesuffix(f': {PULL}')}"
    return Diagnostic("FS101", said, Span(name, 1, 1), PULL if why.endswith(PULL) else None)


def documents_in(
    content: bytes,
    name: str,
    texts: SourceMap,
    wrong: list[Diagnostic],
    most_bytes: int = reader.MOST_BYTES,
    parsed: dict[str, tuple[str, list[Node], list[Diagnostic]]] | None = None,
) -> tuple[list[Node], bool]:
    """Return the documents of a file's bytes, and whether they could be read to their end; `parsed` has those of before."""
    texts.content[name] = content
    known = {} if parsed is None else parsed
    if name not in known:
        text, problems = reader.decode(content, name, most_bytes)
        known[name] = (text, *(([], problems) if problems else reader.documents(text, name)))
    text, nodes, problems = known[name]
    texts.lines[name] = text.split("\n")
    wrong.extend(problems)
    return [node for node in nodes if not node.empty], not problems


def _rank(files: list[str], path: str) -> int:
    return files.index(path) if path in files else len(files)
