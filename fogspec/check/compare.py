"""Compare two documents field by field."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.text import line
from fogspec.language.loader import SourceFile

LONGEST = 80


@dataclass(frozen=True, slots=True)
class Change:
    """One field that differs; None stands for a missing or null field."""

    field: str
    before: Any
    after: Any

    @property
    def is_digest(self) -> bool:
        """True for a digest, which only reflects that other content differs."""
        return any(isinstance(one, str) and one.startswith("sha256:") for one in (self.before, self.after))


def changes(before: Any, after: Any, at: str = "") -> Iterator[Change]:
    """Yield every field that differs, in the order of the documents."""
    if isinstance(before, Mapping) and isinstance(after, Mapping):
        for key in [*before, *(key for key in after if key not in before)]:
            yield from changes(before.get(key), after.get(key), f"{at}.{key}" if at else str(key))
    elif _is_table(before) and _is_table(after):
        yield from changes(_by_name(before), _by_name(after), at)
    elif before != after:
        yield Change(at, before, after)


def compared(before: Any, after: Any) -> list[Change]:
    """Return the fields in which two documents differ, with digests only if nothing else differs."""
    every = list(changes(before, after))
    return [one for one in every if not one.is_digest] or every


def changes_in_file(file: SourceFile, content: bytes) -> list[Change]:
    """Return the fields in which a YAML file on disk differs from its expected content.

    A damaged file is a single change of the whole document.
    """
    after = SourceFile(file.name, content).plain()
    try:
        return compared(file.plain(), after)
    except DiagnosticError as problems:
        return [Change("", problems.diagnostics[0].message, "a whole file")]


def change_text(change: Change) -> str:
    """Format a change, such as `expected.latency.limit: 2s -> 1s`; without values that differ only where they are cut."""
    before, after = short(change.before), short(change.after)
    return line(f"{change.field}: {'changed' if before == after else f'{before} -> {after}'}".removeprefix(": "))


def short(value: Any) -> str:
    """Format a value, truncated to `LONGEST` characters."""
    if value is None:
        return "none"
    if isinstance(value, Mapping):
        text = ", ".join(f"{key}: {short(one)}" for key, one in value.items() if one not in (None, [], {}))
    else:
        text = ", ".join(map(short, value)) if isinstance(value, list) else str(value)
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


def _is_table(value: Any) -> bool:
    """Return True for a list of machines or files, which are compared by name in any order."""
    return isinstance(value, list) and bool(value) and all(isinstance(one, Mapping) and _name(one) for one in value)


def _by_name(table: list[Mapping[str, Any]]) -> dict[str, Any]:
    return {_name(one): one for one in table}


def _name(one: Mapping[str, Any]) -> str:
    """Return the name of a machine or file in a list; an empty string for other items."""
    if "instance" in one:
        return f"{one['instance']} in {one.get('infra', '')}{' spot' if one.get('spot') else ''}"
    return str(one["path"]) if one.keys() == {"path", "digest"} else ""
