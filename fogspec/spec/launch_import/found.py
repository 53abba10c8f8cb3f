"""What a launch file starts, in the words of the spec, and what of it could not be read."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span

MOST_BYTES = 256 << 10  # of a launch file
MOST_DATA_BYTES = 1 << 20  # of a file that one reads
MOST_WORK = 20_000_000  # steps and characters that are handled to read one launch file and those that it includes
MOST_FILES = 100
DEEPEST = 50
MOST_NAMED = 8  # things or lines in one note
SHARE = re.compile(r"\$\(find-pkg-share ([A-Za-z0-9_.-]+)\)")


@dataclass(frozen=True, slots=True)
class Place:
    """Where something is written."""

    path: str
    line: int
    column: int = 1
    width: int = 1


@dataclass(frozen=True, slots=True)
class Unknown:
    """A value that only a launch would determine: where it comes from, and why it is not known."""

    place: Place
    why: str


@dataclass(slots=True)
class Made:
    """An action, substitution or description that a launch file makes: its class, and what the class was given.

    `places` is where each of the words is written, as far as a message needs it.
    """

    kind: str
    args: list[Any]
    words: dict[str, Any]
    place: Place
    places: dict[str, Place] = field(default_factory=dict)

    def word(self, name: str, position: int | None = None, default: Any = None) -> Any:
        """Return an argument by name, or by position."""
        if name in self.words:
            return self.words[name]
        return self.args[position] if position is not None and position < len(self.args) else default


@dataclass(kw_only=True)
class LaunchImport:
    """What the spec can take over, and warnings about the rest.

    `constrained` says whether it has constraints, so that none is proposed. `files` are parameter files that the launch file
    writes while it is played, by their names beside the spec. `defaults` are the launch arguments whose default was taken, with
    the value. `origins` and `reasons` are by the id() of a node: where it is written, and why it is proposed for the robot.
    """

    path: str
    cloud: list[dict[str, Any]] = field(default_factory=list)
    robot: list[dict[str, Any]] = field(default_factory=list)
    said_cloud: bool = False
    reasons: dict[int, str] = field(default_factory=dict)
    origins: dict[int, Place] = field(default_factory=dict)
    constrained: bool = False
    constraints: dict[str, Any] = field(default_factory=dict)
    objective: dict[str, Any] = field(default_factory=dict)
    hardware: dict[str, Any] = field(default_factory=dict)
    stop: dict[str, Any] = field(default_factory=dict)
    probe: dict[str, Any] = field(default_factory=dict)
    infra: list[str] = field(default_factory=list)
    image: str | None = None
    setup: list[str] = field(default_factory=list)
    files: dict[str, str] = field(default_factory=dict)
    defaults: dict[str, str] = field(default_factory=dict)
    included: list[str] = field(default_factory=list)
    notes: list[Diagnostic] = field(default_factory=list)
    sources: dict[str, list[str]] = field(default_factory=dict)
    work: int = 0
    noted: set[tuple[str, int, str]] = field(default_factory=set)

    def spend(self, amount: int) -> None:
        """Count work; raise DiagnosticError once it is out of proportion: a few names can double a text many times."""
        self.work += 1 + amount
        if self.work > MOST_WORK:
            message = "the launch file is too large, loops for too long, or its values grow too large"
            fix = "write the spec by hand: fogspec init without --from-launch"
            raise DiagnosticError([Diagnostic("FS801", message, Span(self.path, 1, 1), fix)])

    def note(self, place: Place, message: str) -> None:
        """Report once what was not taken over, and where it is."""
        key = (place.path, place.line, message)
        if key in self.noted:
            return
        self.noted.add(key)
        lines = self.sources.get(place.path, [])
        source = lines[place.line - 1] if 0 < place.line <= len(lines) else ""
        self.spend(len(source))
        column, width = place.column, place.width
        if column == 1:
            column = len(source) - len(source.lstrip()) + 1
        if width == 1:
            width = max(1, len(source.rstrip()) - column + 1)
        span = Span(place.path, place.line, column, width)
        self.notes.append(Diagnostic("FS802", message, span, severity="warning", source_line=source))


NOT_TAKEN = re.compile(r"(?P<what>.*?) (?:is|are) not taken over: (?P<why>.*)", re.DOTALL)


def merged(notes: Sequence[Diagnostic]) -> list[Diagnostic]:
    """Return one note for all that one reason keeps out of one file, at the first of its lines."""
    groups: dict[tuple[str, str, bool], list[Diagnostic]] = {}
    for note in notes:
        match = NOT_TAKEN.fullmatch(note.message)
        groups.setdefault((note.span.path, match["why"] if match else note.message, match is not None), []).append(note)
    return [_one(group, why if is_taken else None) for (_, why, is_taken), group in groups.items()]


def _one(notes: Sequence[Diagnostic], why: str | None) -> Diagnostic:
    first = notes[0]
    lines = list(dict.fromkeys(str(note.span.line) for note in notes))[1:]
    also = f" (also in line{'s' * (len(lines) > 1)} {_listed(lines)})" if lines else ""
    named = (NOT_TAKEN.fullmatch(note.message) for note in notes)
    what = list(dict.fromkeys(match["what"] for match in named if match))
    message = first.message if why is None or len(what) == 1 else f"{_listed(what)} are not taken over: {why}"
    return replace(first, message=f"{message}{also}")


def _listed(words: Sequence[str]) -> str:
    if len(words) > MOST_NAMED + 1:
        return f"{', '.join(words[:MOST_NAMED])} and {len(words) - MOST_NAMED} more"
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else words[0]


def refuse(message: str, place: Place, fix: str | None = None) -> DiagnosticError:
    """Return the error of a launch file that cannot be read at all."""
    return DiagnosticError([Diagnostic("FS801", message, Span(place.path, place.line, place.column), fix)])
