"""Join the results of two branches by the ids of their samples: none is lost, none counts twice.

Both must have measured the same: one state of the spec, or one whose samples the other carries on. What both sides have is
kept once. A sample that each side measured on its own is two measurements of one machine: the second becomes a further
sample of it.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fogspec.base.errors import Refused
from fogspec.base.project_files import ProjectFiles
from fogspec.plan.schema import Batch, Sampling, next_on
from fogspec.results.io import packed_timings, raw_timings
from fogspec.results.schema import Carried, Measured, Results, ResultsBody, is_final, own_records, with_checksum
from fogspec.spec import fingerprints
from fogspec.spec.lockfile import differing, some


@dataclass(frozen=True, slots=True)
class Joined:
    """The joined results; `theirs` are the records that come from the other side by their id there, as they are now.

    `twice` are the ids of samples that each side measured on its own.
    """

    results: Results
    theirs: Mapping[str, Measured] = field(default_factory=dict)
    twice: tuple[str, ...] = ()


def join_results(ours: Results, other: Results, base: Results | None = None) -> Joined:
    """Return the results of both sides; `base` is what both began with, if that is known.

    Raise Refused, with what differs, for results that cannot be joined.
    """
    _check_same_kind(ours, other)
    kept, added, twice = _records(ours.spec, other.spec, base.spec if base else None)
    records = [*kept, *added.values()]
    first, second = ours.spec, other.spec
    newest, carried = _history(first, second, {name: one.id for name, one in added.items()})
    there = {one.id for one in records}
    steps = [one.model_copy(update={"samples": [name for name in one.samples if name in there]}) for one in carried]
    body = newest.model_copy(
        update={
            "plan": first.plan if first.plan == second.plan else newest.plan,
            "source": first.source if first.source is not None else second.source,
            "budget": first.budget if first.budget is not None else second.budget,
            "field_digests": newest.field_digests,
            "spent": _spent_usd(first, second, base.spec if base else None),
            "sampling": _sampling(first.sampling, second.sampling),
            "carried": [one for one in steps if one.samples] or None,
            "samples": records,
        }
    )
    return Joined(with_checksum(ours.metadata, body), added, tuple(twice))


def _check_same_kind(ours: Results, other: Results) -> None:
    names = [one.metadata.name for one in (ours, other)]
    if names[0] != names[1]:
        raise Refused(f"results of {names[0]} and of {names[1]} are not joined", "join results of one application")
    runners = [one.spec.runner for one in (ours, other)]
    if runners[0] != runners[1] and ours.spec.samples and other.spec.samples:
        raise Refused(
            f"{names[0]}: one side was measured with the runner {runners[0]}, the other with {runners[1]}: "
            "they are not mixed",
            "keep one of the two files",
        )


def _records(
    ours: ResultsBody, other: ResultsBody, base: ResultsBody | None
) -> tuple[list[Measured], dict[str, Measured], list[str]]:
    """Return our records that stay, those of the other side by their id there, and the ids that both sides measured."""
    mine, theirs = _by_id(ours.samples), _by_id(other.samples)
    before = {} if base is None else _by_id(base.samples)
    taken, renamed, replaced, twice = {*mine, *theirs}, dict[str, str](), set[str](), list[str]()
    added: dict[str, Measured] = {}
    here = [_content(one) for one in ours.samples]
    for one in own_records(other.samples):
        own = mine.get(one.id)
        if _content(one) in here:  # perhaps under another id, since an earlier join
            continue
        if own is None:
            added[one.id] = one
        else:
            newer = _newer(own, one, before.get(one.id))
            if newer is None:
                further = one.model_copy(update={"id": next_on(one.machine, "", taken).id})
                taken.add(further.id)
                renamed[one.id] = further.id
                twice.append(one.id)
                added[one.id] = further
            elif newer is one:
                replaced.add(one.id)
                added[one.id] = one
    for one in other.samples:
        if (nested := one.nested_in) is None or nested.sample not in added:
            continue
        parent = renamed.get(nested.sample, nested.sample)
        name = one.id if parent == nested.sample else f"{parent}-{nested.part}"
        added[one.id] = one.model_copy(update={"id": name, "nested_in": nested.model_copy(update={"sample": parent})})
    gone = {*replaced, *(one.id for one in ours.samples if one.nested_in and one.nested_in.sample in replaced)}
    return [one for one in ours.samples if one.id not in gone], added, twice


def _by_id(records: Sequence[Measured]) -> dict[str, Measured]:
    return {one.id: one for one in records}


def _content(record: Measured) -> Measured:
    """Return a record without what names it: its id, and where its raw timings are."""
    timings = None if record.timings is None else record.timings.model_copy(update={"path": ""})
    return record.model_copy(update={"id": "any", "timings": timings})


def _newer(own: Measured, other: Measured, before: Measured | None) -> Measured | None:
    """Return the record that stands for both; None if both are measurements."""
    if before is not None and before in (own, other):
        return other if own == before else own
    if own.state == "ok" and other.state == "ok":
        return None
    if (own.state == "ok") != (other.state == "ok"):
        return own if own.state == "ok" else other
    return other if is_final(other) and not is_final(own) else own


def _spent_usd(ours: ResultsBody, other: ResultsBody, base: ResultsBody | None) -> float:
    """Return what both sides have paid; without their base rather too much than too little."""
    if base is not None:
        return round(max(ours.spent + other.spent - base.spent, ours.spent, other.spent), 6)
    mine, theirs = ours.samples, other.samples
    here = [_content(one) for one in mine]
    shared = [one for one in theirs if _content(one) in here]
    if len(shared) in (len(mine), len(theirs)):  # one side continued the other
        return max(ours.spent, other.spent)
    return round(ours.spent + max(other.spent - math.fsum(one.spent for one in shared), 0.0), 6)


def _states(body: ResultsBody) -> list[tuple[str, Mapping[str, str] | None]]:
    """Return the states of the spec under which samples were measured, the newest last."""
    return [*((one.application, one.pins) for one in body.carried or ()), (body.application, body.pins)]


def _history(ours: ResultsBody, other: ResultsBody, names: Mapping[str, str]) -> tuple[ResultsBody, list[Carried]]:
    """Return the side with the newest state, and the changes since the samples of both.

    `names` are the ids of the other side's records now, by those there. Raise Refused if neither state is one of the other's.
    """
    mine = _steps(ours, {})
    theirs = _steps(other, names)
    for newest, steps, older, shorter in ((ours, mine, other, theirs), (other, theirs, ours, mine)):
        states, before = _states(newest), _states(older)
        if before[-1] in states and states[: len(before)] == before:
            every = [names.get(one.id, one.id) if older is other else one.id for one in older.samples]
            earlier = len(before) - 1
            joined = [_with(step, shorter[i].samples if i < earlier else every) for i, step in enumerate(steps)]
            return newest, joined
    raise Refused("the two sides measured something else: they are not joined", *_differences(ours, other))


def _steps(body: ResultsBody, names: Mapping[str, str]) -> list[Carried]:
    return [
        one.model_copy(update={"samples": [names.get(name, name) for name in one.samples]})
        for one in body.carried or ()
    ]


def _with(step: Carried, names: Sequence[str]) -> Carried:
    return step.model_copy(update={"samples": list(dict.fromkeys([*step.samples, *names]))})


def _differences(ours: ResultsBody, other: ResultsBody) -> Iterator[str]:
    """Yield what the two sides measured differently, and what to do."""
    before, now = ours.field_digests or {}, other.field_digests or {}
    fields = [fingerprints.field_of_measured(name) for name in differing(before, now)] if before and now else []
    files = differing(ours.pins or {}, other.pins or {}) if ours.pins and other.pins else []
    if fields or files:
        yield f"different: {some([*fields, *files])}"
    yield "keep the file of one side; where a change is harmless, waive it there first: fogspec status"


def _sampling(ours: Sampling | None, other: Sampling | None) -> Sampling | None:
    """Return the decisions of both campaigns: every batch, each sample once.

    Raise Refused if machines were selected from different candidates.
    """
    if ours is None or other is None or ours == other:
        return ours if other is None else other
    if (ours.hardware, ours.infra) != (other.hardware, other.infra):
        raise Refused(
            "the two sides selected machines from different candidates: spec.hardware or spec.infra differ",
            "keep the file of one side",
        )
    batches, requested = list(ours.batches), {one.id for batch in ours.batches for one in batch.samples}
    for batch in other.batches:
        if fresh := [one for one in batch.samples if one.id not in requested]:
            batches.append(Batch(reason=batch.reason, samples=fresh))
            requested.update(one.id for one in fresh)
    if len(batches) == len(ours.batches):
        return ours
    if requested == {one.id for batch in other.batches for one in batch.samples}:
        return other
    # With the samples of both, the sampler decides again.
    return ours.model_copy(update={"batches": batches, "stop_reason": None, "out_of_budget": False})


def timings_of(record: Measured, name: str) -> Path | None:
    """Return where the raw timings of a record of `name` belong, relative to its results file; None without any."""
    return None if record.timings is None else Path(name) / "timings" / f"{record.id}.jsonl.gz"


def bring_timings(joined: Joined, results: Path, other: Path) -> Results:
    """Copy the raw timings of the records that come from the file `other`, and return the joined results that refer to them.

    Raises InvalidInput if one is missing beside that file, or not as recorded; then nothing was copied.
    """
    name, found = joined.results.metadata.name, dict[str, Measured]()
    contents: list[tuple[Path, bytes]] = []
    for record in joined.theirs.values():
        target = timings_of(record, name)
        if target is None or record.timings is None:
            continue
        raw_timings(record, other.parent)
        contents.append((results.parent / target, packed_timings(record, other.parent)))
        timings = record.timings.model_copy(update={"path": target.as_posix()})
        found[record.id] = record.model_copy(update={"timings": timings})
    for path, content in contents:
        ProjectFiles(results.parent).write(path, content)
    samples = [found.get(one.id, one) for one in joined.results.spec.samples]
    return with_checksum(joined.results.metadata, joined.results.spec.model_copy(update={"samples": samples}))
