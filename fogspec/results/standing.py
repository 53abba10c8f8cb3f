"""Whether results still count: what changed since they were measured, and which changes are waived.

A waiver names one change from one value to one other. Results count if the waivers, undone one after the other, lead from what
the spec says now to exactly what was measured, by its digest: so none covers a later change, or a change beside it.
"""

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fogspec.base import digest
from fogspec.base.text import count, line
from fogspec.base.units import shown_duration
from fogspec.base.yaml.writer import flow
from fogspec.results.schema import Carried, Results, ResultsBody
from fogspec.spec import fingerprints
from fogspec.spec.introspect import annotation_at, fields_of
from fogspec.spec.lockfile import changed_pins
from fogspec.spec.schema import ADDED, Application, Benchmark, Spec, Waiver

MOST_TRIED = 2000  # values of the spec, on the way back to what was measured
LONGEST = 60
MOST_SHOWN = 8  # waivers to paste


@dataclass(frozen=True, slots=True)
class Standing:
    """What changed since results were measured: `changes`, with an empty reason, and `waived`, with theirs.

    `others` are sentences on changes that no waiver can name. `suggested` are the waivers that would make the results
    count; empty where there is nothing to waive, or no waiver can.
    """

    changes: tuple[Waiver, ...] = ()
    waived: tuple[Waiver, ...] = ()
    others: tuple[str, ...] = ()
    suggested: tuple[Waiver, ...] = ()

    @property
    def counts(self) -> bool:
        """Whether the results count: nothing has changed that is not waived."""
        return not self.changes and not self.others

    @property
    def reasons(self) -> list[str]:
        """Return what changed, for people."""
        return [*map(change_text, self.changes), *self.others]

    @property
    def fields(self) -> list[str]:
        """Return the names of what changed."""
        return [*(one.change for one in self.changes), *(text.partition(" ")[0] for text in self.others)]


def standing(results: Results, application: Application, pins: Mapping[str, str]) -> Standing:
    """Return whether the results count for this application with these pins, and what changed since."""
    body, waivers = results.spec, application.spec.benchmark.waivers
    now, names = fingerprints.measured_part(application), changed_pins(body.pins, pins)
    files = {name: _traced(pin_change(name), (body.pins or {}).get(name), pins.get(name), waivers) for name in names}
    same = body.application == digest.of_value(now)
    undone = [] if same else _undone(now, body, waivers)
    waived = [*(undone or []), *(one for path in files.values() for one in path or ())]
    changed = [
        Waiver.model_construct(change=pin_change(name), old=(body.pins or {}).get(name), new=pins.get(name), reason="")
        for name, path in files.items()
        if path is None
    ]
    others: list[str] = []
    if undone is None:
        every = [one for _, one in _field_changes(body, now)]
        fields = [one for one in every if _traced(one.change, one.old, one.new, waivers) is None]
        changed = [*fields, *changed]
        others = [] if fields else [f"{name} changed" for name in _changed_parts(body, application)]
        others = others or ([] if fields else ["spec changed: they measured something else"])
    suggested = list(changed)
    if others or (undone is None and _undone(now, body, [*waivers, *suggested]) is None):
        suggested = []
    return Standing(tuple(changed), tuple(waived), tuple(others), tuple(suggested))


def measured_values(application: Application) -> dict[str, Any]:
    """Return what is measured, without what is not set, as results record it."""
    found: dict[str, Any] = _set(fingerprints.measured_part(application))
    return found


def change_text(one: Waiver) -> str:
    """Return a change for people: `spec.cloud[0].env.LOG: info -> debug`; of files that they changed."""
    if not one.change.startswith("spec."):
        how = (
            "is new" if one.old is None else "is no longer there" if one.new is None else "is locked to something else"
        )
        return line(f"{one.change} {how}")
    return line(f"{one.change}: {_short(one.old)} -> {_short(one.new)}")


def carried_on(results: Results, waived: Sequence[Waiver]) -> list[Carried]:
    """Return the changes after which samples count on: those that the results record, and those waived since."""
    body = results.spec
    carried = list(body.carried or ())
    if waived and body.samples:
        ids = [one.id for one in body.samples]
        carried.append(Carried(application=body.application, pins=body.pins, samples=ids, waivers=list(waived)))
    return carried


def carried_text(one: Carried, total: int) -> str:
    """Return what a reviewer should know of samples from before a change; `total` is the number of all samples."""
    before = f"{len(one.samples)} of {count(total, 'sample')} measured before changes"
    if (found := one.confirmed) is not None:
        low, high = map(shown_duration, found.interval)
        return line(
            f"{before}: {'; '.join(found.changes)}; confirmed: {found.sample} took {shown_duration(found.latency)}, "
            f"the {found.level:.0%} interval of the older results is [{low}, {high}]"
        )
    waived = "; ".join(f"{change_text(waiver)} ({waiver.reason})" for waiver in one.waivers)
    return line(f"{before} that the spec waives: {waived}")


def ways_to_keep(found: Standing, spec: Path) -> list[str]:
    """Return how results that do not count can be kept: by waivers in the spec, each still without its reason."""
    if not found.suggested:
        return []
    if len(found.suggested) > MOST_SHOWN:
        many = f"{len(found.suggested)} changes need a waiver each; fogspec status -o json lists them"
        return [f"to keep the results, if these changes cannot affect them, waive them in {spec}: {many}"]
    lines = [f"to keep the results, if these changes cannot affect them, add to {spec}, each with its reason:"]
    return [*lines, *(f"  {text}" for text in waiver_lines(found.suggested))]


def waiver_lines(waivers: Sequence[Waiver]) -> list[str]:
    """Return the lines of a spec that waive these changes."""
    lines = ["spec:", "  benchmark:", "    waivers:"]
    for one in waivers:
        lines.append(f"      - change: {flow(one.change)}")
        lines += [
            f"        {name}: {flow(value)}"
            for name, value in (("old", one.old), ("new", one.new))
            if value is not None
        ]
        lines.append(f"        reason: {flow(one.reason)}")
    return lines


def pin_change(name: str) -> str:
    """Return how a waiver names a pin: a file whose name reads as a field is written with `./`."""
    return f"./{name}" if name.startswith("spec.") else name


def _traced(change: str, old: Any, new: Any, waivers: Sequence[Waiver]) -> list[Waiver] | None:
    """Return the waivers that lead from one value of a field, or digest of a file, to the other; None if there are none."""
    named, path, at = [one for one in waivers if one.change == change], list[Waiver](), new
    while at != old:
        before = next((one for one in named if one.new == at and one not in path), None)
        if before is None:
            return None
        path.insert(0, before)
        at = before.old
    return path


def _undone(now: Mapping[str, Any], body: ResultsBody, waivers: Sequence[Waiver]) -> list[Waiver] | None:
    """Return waivers whose undoing leads from the values now to those that were measured, None if none do.

    All that apply are undone first; without some of them is tried after that, as often as `MOST_TRIED` allows.
    """
    named = [one for one in waivers if one.change.startswith("spec.") and fingerprints.waivable(one.change)]
    if (direct := _each_undone(now, body, named)) is not None:
        return direct
    if body.measured is not None:
        changed = [one.change for _, one in _field_changes(body, now)]
        named = [one for one in named if any(_beside(one.change, other) for other in changed)]
    known, states, tried = {digest.of_value(now)}, [(now, list[Waiver]())], 0
    while states and tried < MOST_TRIED:
        values, path = states.pop()
        for one in named:
            if one in path:
                continue
            for before in _without(values, one):
                at, tried = digest.of_value(before), tried + 1
                if at == body.application:
                    return [one, *path]
                if at not in known:
                    known.add(at)
                    states.append((before, [one, *path]))
    return None


def _each_undone(now: Mapping[str, Any], body: ResultsBody, waivers: Sequence[Waiver]) -> list[Waiver] | None:
    """Return the waivers of each field that changed, if the results say what was measured and undoing them leads there."""
    if body.measured is None:
        return None
    found, values = list[Waiver](), copy.deepcopy(now)
    for path, change in _field_changes(body, now):
        traced = _traced(change.change, change.old, change.new, waivers)
        if traced is None:
            return None
        found += traced
        _put(values, path, change.old)
    return found if digest.of_value(values) == body.application else None


def _put(values: Any, path: tuple[Any, ...], value: Any) -> None:
    """Set a field; what is None is removed from a user's own mapping."""
    for step in path[:-1]:
        values = values[step]
    if value is None and isinstance(values, dict) and not _is_always_there(path):
        values.pop(path[-1], None)
    else:
        values[path[-1]] = value


def _beside(one: str, other: str) -> bool:
    """Return whether one of two fields is the other, or above it."""
    return one.startswith(other) or other.startswith(one)


def _without(values: Mapping[str, Any], waiver: Waiver) -> Iterator[Mapping[str, Any]]:
    """Yield the values with a change undone, in each way in which its field can be read."""
    for path in _paths(values, waiver.change.removeprefix("spec.").removeprefix("benchmark.")):
        at: Any = values
        for step in path[:-1]:
            at = at[step]
        there = at[path[-1]] if isinstance(at, list) or path[-1] in at else None
        if there == waiver.new:
            found = copy.deepcopy(values)
            _put(found, path, waiver.old)
            yield found


def _is_always_there(path: tuple[Any, ...]) -> bool:
    """Return whether a field is there also if it is not set, as null; keys of the user's own mappings are not."""
    return path[-1] in _fields(path[:-1]) and path[-1] not in ADDED


def _fields(path: tuple[Any, ...]) -> Mapping[str, Any]:
    """Return the fields that the schema has at a path of what is measured; none for the user's own mappings."""
    if not path:
        return {**fields_of(Spec), **fields_of(Benchmark)}
    within = ("spec", "benchmark") if path[0] in Benchmark.model_fields else ("spec",)
    return fields_of(annotation_at(Application, (*within, *path)))


def _paths(values: Any, text: str, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the paths that a dotted text can mean; a user's own key may have dots itself, and may be absent."""
    if isinstance(values, list):
        number, closed, rest = text.partition("]")
        if closed and number[:1] == "[" and number[1:].isdecimal() and int(number[1:]) < len(values):
            yield from _below(values, int(number[1:]), rest, at)
        return
    if not isinstance(values, Mapping):
        return
    text = text.removeprefix(".")
    for key in values:
        if text.startswith(key):
            yield from _below(values, key, text[len(key) :], at)
    fields = _fields(at)
    if text not in values and (text in fields or (text and not fields)):
        yield (*at, text)


def _below(values: Any, key: Any, rest: str, at: tuple[Any, ...]) -> Iterator[tuple[Any, ...]]:
    if not rest:
        yield (*at, key)
    elif rest[0] in ".[":
        yield from _paths(values[key], rest, (*at, key))


def _field_changes(body: ResultsBody, now: Mapping[str, Any]) -> Iterator[tuple[tuple[Any, ...], Waiver]]:
    """Yield the fields of the spec that changed with their paths, if the results say what was measured."""
    if body.measured is None:
        return
    for name in {**body.measured, **now}:
        at = fingerprints.field_of_measured(name)
        yield from _changes(body.measured.get(name), _set(now.get(name)), at, (name,))


def _changes(before: Any, after: Any, at: str, path: tuple[Any, ...]) -> Iterator[tuple[tuple[Any, ...], Waiver]]:
    if isinstance(before, Mapping) and isinstance(after, Mapping):
        for key in {**before, **after}:
            yield from _changes(before.get(key), after.get(key), f"{at}.{key}", (*path, key))
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for number, (one, other) in enumerate(zip(before, after, strict=True)):
            yield from _changes(one, other, f"{at}[{number}]", (*path, number))
    elif before != after:
        yield path, Waiver.model_construct(change=at, old=before, new=after, reason="")


def _changed_parts(body: ResultsBody, application: Application) -> Iterator[str]:
    """Yield the parts of the spec whose recorded digests changed."""
    before, now = body.field_digests, fingerprints.measured_fields(application)
    if before:
        yield from (fingerprints.field_of_measured(name) for name, one in now.items() if before.get(name) != one)


def _set(value: Any) -> Any:
    """Return a value without the fields that are None, at any depth."""
    if isinstance(value, Mapping):
        return {key: _set(one) for key, one in value.items() if one is not None}
    return [_set(one) for one in value] if isinstance(value, list) else value


def _short(value: Any) -> str:
    text = "none" if value is None else flow(value)
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."
