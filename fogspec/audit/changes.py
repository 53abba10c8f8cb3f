"""Differences told: as text, for programs, and as Markdown for a pull request."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from fogspec.audit.compare import Change, change_text, short
from fogspec.audit.diff import Difference, measuring_words

NAMES = {"price": "machine", "month": "a month", "request": "a request", "latency": "latency"}


def as_text(one: Difference, running: Sequence[Change] | None = None) -> str:
    """The difference in lines; `running` is what differs between what runs and the manifest."""
    lines = [f"{one.layout.name}: {headline(one)}"]
    lines += [f"  {change.field}: {short(change.before)} -> {short(change.after)}" for change in one.changes]
    lines += [f"  cost: {line}" for line in _cost_lines(one)]
    if one.differs:
        lines += [f"  why: {reason}" for reason in one.why]
        lines.append(f"  {measuring_words(one)}")
    if running is not None:
        lines.append(f"  running: {'as the manifest says' if not running else 'not what the manifest says'}")
        lines += [f"    {change_text(change)}" for change in running]
    return "\n".join(lines)


def headline(one: Difference) -> str:
    """What would happen, in one line."""
    if one.refused and one.after is None:
        return f"cannot be compiled to a manifest now: {one.refused}"
    if one.before is None:
        return "a new manifest"
    if not one.changes:
        return "the manifest is what compile would write" + (", other files differ" if one.why else "")
    was, now = (_machine(document) for document in (one.before, one.after))
    return f"{was} -> {now}" if was != now else f"{was} stays"


def _machine(document: Mapping[str, Any] | None) -> str:
    spec = document.get("spec") if document else None
    if not isinstance(spec, Mapping):
        return "nothing"
    return f"{spec.get('instance')} in {spec.get('infra')}"


def _cost_lines(one: Difference) -> Iterator[str]:
    for name, (was, now, relative) in one.costs.items():
        yield f"{NAMES[name]} {was} -> {now}{f' ({relative})' if relative else ''}"


def as_dict(one: Difference, running: Sequence[Change] | None = None) -> dict[str, Any]:
    """The same for programs."""
    return {
        "name": one.layout.name,
        "differs": one.differs,
        "refused": one.refused,
        "changes": [_change(change) for change in one.changes],
        "costs": {name: {"before": was, "after": now, "relative": rel} for name, (was, now, rel) in one.costs.items()},
        "why": list(one.why),
        "to_measure": list(one.to_measure),
        "measuring_usd_at_most": one.measuring_usd,
        "running": None if running is None else [_change(change) for change in running],
    }


def _change(change: Change) -> dict[str, Any]:
    return {"field": change.field, "before": change.before, "after": change.after}


def markdown(one: Difference, running: Sequence[Change] | None = None) -> str:
    """The same for a pull request."""
    lines = [f"### {one.layout.name}: {escaped(headline(one))}", ""]
    if one.costs:
        lines += ["| | before | after | |", "|--|--|--|--|"]
        lines += [
            f"| {NAMES[name]} | {escaped(was)} | {escaped(now)} | {rel} |"
            for name, (was, now, rel) in one.costs.items()
        ]
        lines.append("")
    if one.differs:
        lines += [*(f"- {escaped(reason)}" for reason in one.why), f"- {escaped(measuring_words(one))}", ""]
    if one.changes:
        lines += [f"<details><summary>{len(one.changes)} fields differ</summary>", "", "| field | before | after |",
                  "|--|--|--|"]  # fmt: skip
        lines += [
            f"| `{change.field}` | {escaped(short(change.before))} | {escaped(short(change.after))} |"
            for change in one.changes
        ]
        lines += ["", "</details>", ""]
    if running is not None:
        lines += [f"What runs {'is what the manifest says.' if not running else 'differs from the manifest:'}", ""]
        lines += [f"- {escaped(change_text(change))}" for change in running]
    return "\n".join(lines).rstrip()


def escaped(words: str) -> str:
    """Text that Markdown shows as it is, in a table too."""
    cleaned = "".join(one if one.isprintable() else " " for one in words)
    for character in "\\`*_[]<>|":
        cleaned = cleaned.replace(character, f"\\{character}")
    return cleaned
