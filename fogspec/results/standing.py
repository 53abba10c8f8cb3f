"""Whether results still count: which inputs changed since they were measured, and which changes are waived.

A waiver names one change of one input, from one value to one other: it covers no later change, and none beside it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fogspec.base import digest
from fogspec.base.yaml.writer import flow
from fogspec.language import warned as codes
from fogspec.language.fingerprints import change_text, differing_rows, same_value, waivable
from fogspec.language.schema import Waiver
from fogspec.language.warned import Warned, warned
from fogspec.results.schema import Carried, Results

MOST_SHOWN = 8  # waivers to paste


@dataclass(frozen=True, slots=True)
class Standing:
    """What changed since results were measured: `changes`, with an empty reason, and `waived`, with theirs."""

    changes: tuple[Waiver, ...] = ()
    waived: tuple[Waiver, ...] = ()

    @property
    def counts(self) -> bool:
        """Whether the results count: nothing has changed that is not waived."""
        return not self.changes

    @property
    def comparable(self) -> bool:
        """Whether figures of before mean the same as figures of now: no field changed that defines them."""
        return all(waivable(one.change) for one in self.changes)

    @property
    def suggested(self) -> tuple[Waiver, ...]:
        """The waivers that would make the results count; none if no waiver can."""
        return self.changes if self.comparable else ()

    @property
    def reasons(self) -> list[str]:
        """Return what changed, for people."""
        return [change_text(one) for one in self.changes]

    @property
    def fields(self) -> list[str]:
        """Return the names of what changed."""
        return [one.change for one in self.changes]


def standing(results: Results, record: Mapping[str, Any], waivers: Sequence[Waiver]) -> Standing:
    """Return whether results count for what would be measured now (`measured_record`), and what changed since."""
    changed, waived = list[Waiver](), list[Waiver]()
    for one in input_changes(results.spec.inputs, record):
        named = [waiver for waiver in waivers if waiver.change == one.change and waivable(one.change)]
        path = _path(one.old, one.new, named)
        if path is None:
            changed.append(one)
        else:
            waived += path
    return Standing(tuple(changed), tuple(waived))


def input_changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[Waiver]:
    """Return the changes from one record of inputs to the other, each as the waiver that would name it, without a reason."""
    return [
        Waiver.model_construct(change=name, old=before.get(name), new=now.get(name), reason="")
        for name in differing_rows(before, now)
    ]


def _path(old: Any, new: Any, named: Sequence[Waiver]) -> list[Waiver] | None:
    """Return the waivers that lead from one value of an input to the other; None if there are none."""
    path, at = list[Waiver](), new
    while not same_value(at, old):
        before = next((one for one in named if same_value(one.new, at) and one not in path), None)
        if before is None:
            return None
        path.insert(0, before)
        at = before.old
    return path


def carried_on(results: Results, waived: Sequence[Waiver]) -> list[Carried]:
    """Return the changes after which samples count on: those that the results record, and those waived since."""
    body = results.spec
    carried = list(body.carried or ())
    if waived and body.samples:
        ids = [one.id for one in body.samples]
        carried.append(Carried(inputs=digest.of_value(body.inputs), samples=ids, waivers=list(waived)))
    return carried


def carried_warning(one: Carried, total: int) -> Warned:
    """Return the warning about samples from before a change; `total` is the number of all samples."""
    if (found := one.confirmed) is None:
        return warned(codes.waived, samples=len(one.samples), of=total, waivers=one.waivers)
    return warned(
        codes.confirmed,
        samples=len(one.samples),
        of=total,
        changes=found.changes,
        sample=found.sample,
        latency_s=found.latency,
        interval_s=found.interval,
        level=found.level,
    )


def ways_to_keep(found: Standing, spec: Path) -> list[str]:
    """Return how results that do not count can be kept: by waivers in the spec, each still without its reason."""
    if not found.suggested:
        return []
    first = "fogspec bench measures the chosen machine once more first, which may keep the results"
    if len(found.suggested) > MOST_SHOWN:
        many = f"{len(found.suggested)} changes need a waiver each; fogspec status -o json lists them"
        return [first, f"to keep the results, if these changes cannot affect them, waive them in {spec}: {many}"]
    lines = [f"to keep the results, if these changes cannot affect them, add to {spec}, each with its reason:"]
    return [first, *lines, *(f"  {text}" for text in waiver_lines(found.suggested))]


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
