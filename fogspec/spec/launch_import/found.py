"""What a launch file says, as far as it can be read without running it."""

import re
import shlex
import sys
from dataclasses import dataclass, field
from typing import Any

from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span
from fogspec.base.units import format_duration
from fogspec.base.yaml.scalars import Refusal, resolve

MOST_BYTES = 256 << 10
MOST_WORK = 20_000_000  # characters that are handled to read one file
DEEPEST = 50
LONGEST_COMMAND = 8 << 10
NODE_WORDS = (
    "package",
    "executable",
    "cmd",
    "name",
    "namespace",
    "parameters",
    "parameter_files",
    "remappings",
    "arguments",
    "env",
)


@dataclass(kw_only=True)
class LaunchImport:
    """Nodes as the spec writes them, whatever else a spec can take over, and warnings about the rest."""

    path: str
    lines: list[str]
    cloud: list[dict[str, Any]] = field(default_factory=list)
    robot: list[dict[str, Any]] = field(default_factory=list)
    constraints: dict[str, Any] = field(default_factory=dict)
    objective: dict[str, Any] = field(default_factory=dict)
    hardware: dict[str, Any] = field(default_factory=dict)
    stop: dict[str, Any] = field(default_factory=dict)
    setup: list[str] = field(default_factory=list)
    notes: list[Diagnostic] = field(default_factory=list)
    work: int = 0

    def spend(self, characters: int) -> None:
        """Count work; raise DiagnosticError once it is out of proportion: a few names can double a text many times."""
        self.work += 16 + characters
        if self.work > MOST_WORK:
            message = "the launch file is too large, or its values grow too large when they are put together"
            fix = "write the spec by hand: fogspec init without --from-launch"
            raise DiagnosticError([Diagnostic("FS801", message, Span(self.path, 1, 1), fix)])

    def checked_depth(self, depth: int, line: int) -> None:
        """Raise DiagnosticError for what is nested too deep."""
        if depth > DEEPEST:
            message = f"a launch file may be nested at most {DEEPEST} deep"
            raise DiagnosticError([Diagnostic("FS801", message, Span(self.path, line, 1))])

    def note(self, line: int, message: str, column: int = 1, width: int | None = None) -> None:
        """Report what was not imported, and where it is."""
        source = self.lines[line - 1] if 0 < line <= len(self.lines) else ""
        self.spend(len(source))
        if column == 1:
            column = len(source) - len(source.lstrip()) + 1
        span = Span(self.path, line, column, width or max(1, len(source.rstrip()) - column + 1))
        self.notes.append(Diagnostic("FS802", message, span, severity="warning", source_line=source))


def tidy_node(raw: dict[str, Any]) -> dict[str, Any]:
    """Return the node with its keys in the order of the schema, without empty ones."""
    return {word: raw[word] for word in NODE_WORDS if raw.get(word) not in (None, "", [], {})}


def typed(text: str) -> Any:
    """Return a parameter's value as ROS 2 would read it from a string; the string if readers would differ."""
    stripped = text.strip()
    if stripped.startswith("[") and stripped.endswith("]"):
        return [typed(part.strip(" '\"")) for part in stripped[1:-1].split(",") if part.strip()]
    value = resolve(stripped)
    return text if value is None or isinstance(value, (Refusal, str)) else value


def words(text: str) -> list[str]:
    """Return a command line as a list of arguments; a very long one is split at spaces: shlex takes quadratic time."""
    try:
        return shlex.split(text) if len(text) <= LONGEST_COMMAND else text.split()
    except ValueError:
        return text.split()


def take_constraint(
    found: LaunchImport, key: str, value: Any, line: int, column: int = 1, width: int | None = None
) -> None:
    """Import one entry of the paper's `constraint={...}`; numbers without units only if they are unambiguous."""
    name = re.sub(r"[^a-z]", "", key.lower())
    if not isinstance(value, (int, float, str)) or isinstance(value, bool) or not _finite(value):
        found.note(line, f"constraint {key} cannot be read", column, width)
    elif "latency" in name or name in ("maxtime", "time"):
        found.constraints["latency"] = value if isinstance(value, str) else format_duration(float(value))
    elif "cost" in name and isinstance(value, str):
        found.constraints["cost"] = value
    elif "cost" in name:
        fix = f"write ${value:g}/request or {value:g} cent/request into spec.constraints.cost"
        found.note(
            line, f"constraint {key} has no currency, dollars and cents are 100 times apart: {fix}", column, width
        )
    elif name == "alpha":
        found.objective["alpha"] = value
    elif "step" in name and isinstance(value, int):
        found.stop["requests"] = value
    elif match := re.fullmatch(r"(min|max)(imum)?(num)?v?(cpus?|memory|mem|ram)", name):
        _bound(found, "cpus" if "cpu" in match[4] else "memory", match[1], value)
    elif name in ("gpu", "gpus", "accelerators"):
        found.hardware["gpus"] = [str(value).partition(":")[0]]
    else:
        found.note(line, f"constraint {key} is not known to fogspec", column, width)


def _finite(value: int | float | str) -> bool:
    return isinstance(value, str) or abs(value) <= sys.float_info.max


def _bound(found: LaunchImport, field_name: str, end: str, value: Any) -> None:
    unit = "" if field_name == "cpus" or isinstance(value, str) else "GiB"
    low, _, high = str(found.hardware.get(field_name, "..")).partition("..")
    written = f"{value}{unit}"
    found.hardware[field_name] = f"{written}..{high}" if end == "min" else f"{low}..{written}"
