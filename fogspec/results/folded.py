"""The results of an application and the files of its samples: one is read from the others, and written as them.

Every file stands for itself, so that two branches that measured different samples merge by their files. What one of them
knows more of the changes since, the other's samples have from it.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence

from fogspec.base import digest
from fogspec.plan.schema import Batch, Sampling
from fogspec.results.schema import Carried, Requested, ResultBody, Results, ResultsBody, results_of


class Unmatched(Exception):
    """The sample `id` is not of the same results as the others; the message says why."""

    def __init__(self, name: str, why: str) -> None:
        super().__init__(why)
        self.id = name


def folded(files: Sequence[ResultBody], before_usd: float = 0.0) -> Results | None:
    """Return the results that these files are, whatever their order; None without any. Raise Unmatched.

    `before_usd` is what results cost that were set aside.
    """
    if not files:
        return None
    bodies = sorted(files, key=_place)
    newest = _newest(bodies)
    steps = {one.id: _steps(one, newest) for one in bodies}
    carried = dict[str, Carried]()
    for one in sorted(bodies, key=lambda body: -len(steps[body.id])):
        carried |= {step.inputs: step for step in steps[one.id] if step.inputs not in carried}
    return results_of(
        ResultsBody(
            inputs=newest.inputs,
            carried=[
                step.model_copy(
                    update={"samples": [one.id for one in bodies if name in {each.inputs for each in steps[one.id]}]}
                )
                for name, step in carried.items()
            ]
            or None,
            runner=newest.runner,
            source="; ".join(dict.fromkeys(one.source for one in bodies if one.source)) or None,
            sampling=_sampling(bodies),
            samples=[one.record for one in bodies if one.record is not None],
            paid={
                one.id: one.spent
                for one in bodies
                if one.spent != (one.record.spent if one.record is not None else 0.0)
            },
            before=before_usd,
        )
    )


def split(body: ResultsBody) -> Iterator[ResultBody]:
    """Yield the files that results are, by the ids of their samples."""
    records, requested = {one.id: one for one in body.samples}, dict(_requested(body.sampling))
    for name in sorted({**requested, **body.costs}):
        yield ResultBody(
            id=name,
            inputs=body.inputs,
            carried=[one.model_copy(update={"samples": []}) for one in body.carried or () if name in one.samples],
            runner=body.runner,
            source=body.source,
            spent=body.costs.get(name, 0.0),
            requested=requested.get(name),
            record=records.get(name),
        )


def _place(body: ResultBody) -> tuple[object, ...]:
    """Sort samples as they were requested, else by the size and price of their machines."""
    asked, record = body.requested, body.record
    machine = record.machine if record is not None else asked.sample.machine if asked is not None else None
    size = (0.0, 0.0, 0.0) if machine is None else (machine.cpus, machine.memory, machine.price)
    return (*((asked.batch, asked.place) if asked is not None else (0, 0)), *size, body.id)


def _newest(bodies: Sequence[ResultBody]) -> ResultBody:
    """Return the file with the newest state; raise Unmatched unless the states of all others lead to it."""
    for one in bodies:
        if one.runner != bodies[0].runner:
            raise Unmatched(one.id, f"it was measured with the runner {one.runner}, others with {bodies[0].runner}")
    by_age = sorted(bodies, key=lambda one: -len(one.carried))
    for newest in by_age:
        known = {digest.of_value(newest.inputs), *(step.inputs for step in newest.carried)}
        other = next((one for one in bodies if digest.of_value(one.inputs) not in known), None)
        if other is None:
            return newest
    known = {digest.of_value(by_age[0].inputs), *(step.inputs for step in by_age[0].carried)}
    other = next(one for one in bodies if digest.of_value(one.inputs) not in known)
    raise Unmatched(other.id, f"what it measured is not what {by_age[0].id} measured")


def _steps(one: ResultBody, newest: ResultBody) -> list[Carried]:
    """Return the changes since a sample was measured: its own, and those that only the newest file has."""
    known = digest.of_value(one.inputs)
    if known == digest.of_value(newest.inputs):
        return list(one.carried)
    at = next(number for number, step in enumerate(newest.carried) if step.inputs == known)
    return [*one.carried, *newest.carried[at:]]


def _requested(sampling: Sampling | None) -> Iterator[tuple[str, Requested]]:
    """Yield the samples of a campaign by their ids."""
    if sampling is None:
        return
    for number, batch in enumerate(sampling.batches, 1):
        last = number == len(sampling.batches)
        for place, sample in enumerate(batch.samples, 1):
            yield (
                sample.id,
                Requested(
                    batch=number,
                    place=place,
                    of=len(batch.samples),
                    reason=batch.reason,
                    sample=sample,
                    hardware=sampling.hardware,
                    infra=sampling.infra,
                    limits_digest=sampling.limits_digest,
                    stop_reason=sampling.stop_reason if last else None,
                    out_of_budget=sampling.out_of_budget if last else False,
                ),
            )


def _sampling(bodies: Sequence[ResultBody]) -> Sampling | None:
    """Return the decisions of a campaign from its samples, in their order; None without any.

    It has ended if all samples of its last batch say so: after a merge of two campaigns the sampler decides again. So it does
    where a bench was killed while it wrote the files of a batch: it comes to the same one.
    """
    batches = defaultdict[int, list[Requested]](list)
    for one in bodies:
        if one.requested is not None:
            batches[one.requested.batch].append(one.requested)
    paid = {
        one.requested.batch for one in bodies if one.requested is not None and (one.record is not None or one.spent)
    }
    if batches and (newest := max(batches)) not in paid and len(batches[newest]) < batches[newest][0].of:
        del batches[newest]
    if not batches:
        return None
    last = batches[max(batches)]
    ended = all(one.stop_reason == last[0].stop_reason and _space(one) == _space(last[0]) for one in last)
    return Sampling(
        hardware=last[0].hardware,
        infra=last[0].infra,
        limits_digest=last[0].limits_digest,
        batches=[
            Batch(reason=batch[0].reason, samples=[one.sample for one in batch]) for _, batch in sorted(batches.items())
        ],
        stop_reason=last[0].stop_reason if ended else None,
        out_of_budget=last[0].out_of_budget if ended else False,
    )


def _space(one: Requested) -> tuple[object, ...]:
    return one.hardware, one.infra, one.limits_digest


def cost_usd(files: Iterable[ResultBody], runner: str) -> float:
    """Return what these files say that a runner has spent, in USD."""
    return sum(one.spent for one in files if one.runner == runner)
