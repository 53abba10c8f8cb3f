"""The results of a benchmark: one file per sample, with its record, measured or failed."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import Field

from fogspec.base import digest
from fogspec.base.quantities import Id, Lean, Strict
from fogspec.catalog.machine import Machine, TypeKey
from fogspec.language.schema import Hardware, Statistic, Waiver
from fogspec.language.warned import Warned, mixed_servers, warned
from fogspec.plan.schema import Plan, Sample, Sampling
from fogspec.results.ranges import (
    Amount,
    Counted,
    MemoryUse,
    MetricValue,
    RelativeError,
    RequestTime,
    Text,
    Time,
    Vcpus,
)

State = Literal["ok", "insufficient", "timeout", "failed"]
Reason = Literal[
    "access",
    "quota",
    "capacity",
    "image",
    "setup",
    "crash",
    "out_of_memory",
    "no_response",
    "not_reported",
    "check",
    "out_of_range",
    "interrupted",
    "budget",
]
StoppedBy = Literal["steps", "time", "precision", "decided", "exit", "size", "startup", "signal"]
# Failures worth retrying: transient ones, and samples that never ran.
RETRYABLE = {"access", "quota", "capacity", "interrupted", "budget"}
SHOWN_WAIT = 0.01  # of a machine's time, spent waiting for disks, from which it is shown
UNAVAILABLE = {"quota", "capacity"}


class LatencySummary(Strict):
    """Statistics of the latency of valid requests after warm-up, as far as there were enough requests."""

    mean: RequestTime
    sd: RequestTime | None = None
    p50: RequestTime | None = None
    p95: RequestTime | None = None
    p99: RequestTime | None = None


class ServerFacts(Strict):
    """The server that ran a sample, as it described itself; facts that it did not give are None.

    `features` are instruction sets that matter to numerical code. `clock_ghz` and `run_queue`, the tasks that could have run,
    are those at the end; `steal` is the fraction of the CPU time that its host gave to others, `io_wait` that in which
    it was idle and waited for disks. `changed_to` is another CPU
    that it had at the end. `driver` is that of its GPUs, `packages` the sha256 of the list of its packages, which is next to
    the results.
    """

    cpu: str = Field(min_length=1, max_length=120)
    arch: str | None = Field(None, pattern=r"^[A-Za-z0-9_]{1,16}$")
    kernel: str | None = Field(None, min_length=1, max_length=120)
    driver: str | None = Field(None, pattern=r"^[0-9.]{1,32}$")
    packages: str | None = Field(None, pattern=r"^sha256:[0-9a-f]{64}$")
    features: list[Annotated[str, Field(pattern=r"^[a-z0-9_]{1,16}$")]] = Field([], max_length=32)
    sockets: int | None = Field(None, ge=1, le=64)
    cores: int | None = Field(None, ge=1, le=8192)
    threads: int | None = Field(None, ge=1, le=8192)
    clock_ghz: float | None = Field(None, gt=0, le=10)
    steal: float | None = Field(None, ge=0, le=1)
    io_wait: float | None = Field(None, ge=0, le=1)
    run_queue: int | None = Field(None, ge=0, le=100_000)
    changed_to: str | None = Field(None, max_length=120)

    def line(self) -> str:
        """Return the facts in one line, for people."""
        cores = (
            None
            if self.cores is None
            else f"{self.cores} cores" + (f", {self.threads} threads" if self.threads else "")
        )
        sockets = None if self.sockets in (None, 1) else f"{self.sockets} sockets"
        clock = None if self.clock_ghz is None else f"{self.clock_ghz:.2g} GHz"
        steal = None if not self.steal else f"{self.steal:.1%} of its time stolen"
        waited = (
            None if not self.io_wait or self.io_wait < SHOWN_WAIT else f"{self.io_wait:.1%} of its time idle for disks"
        )
        busy = self.run_queue is not None and self.threads is not None and self.run_queue > self.threads
        queue = f"{self.run_queue} tasks waiting to run" if busy else None
        return ", ".join(filter(None, (self.cpu, sockets, cores, clock, steal, waited, queue)))


class ResourceUse(Strict):
    """What the processes of a sample used while requests were measured, in a `window` that begins after warm-up.

    `cpu_mean` and `cpu_max`, of one second, are in vCPUs, of `vcpus` that affinity and quota let the processes use. `throttled`
    is the fraction of periods in which that quota stopped them. `outside` is the fraction of `vcpus` that other processes, or
    the machine's host, kept from them. `memory_peak` is the largest sum of their resident memory, read
    once per second; `memory_before` is what others used on the machine before they started. Page faults are theirs;
    `major_faults` waited for a disk. `swapped`, `received` and `sent` are what the
    whole machine moved to and from swap and through its network devices. Of its `gpus`, `gpu_mean` and `gpu_max` are the
    fractions of time in which the busiest one computed, and `gpu_memory_peak` is of `gpu_memory` of the fullest one. `overhead`
    is what reading all this took, in vCPUs.
    """

    window: Time
    vcpus: Vcpus
    cpu_mean: Vcpus
    cpu_max: Vcpus
    throttled: float | None = Field(None, ge=0, le=1)
    outside: float | None = Field(None, ge=0, le=1)
    memory_peak: MemoryUse
    memory_before: MemoryUse | None = None
    minor_faults: Annotated[int, Field(ge=0, le=10**15)]
    major_faults: Annotated[int, Field(ge=0, le=10**15)]
    swapped: MemoryUse | None = None
    received: MemoryUse | None = None
    sent: MemoryUse | None = None
    gpus: int | None = Field(None, ge=1, le=1024)
    gpu_mean: float | None = Field(None, ge=0, le=1)
    gpu_max: float | None = Field(None, ge=0, le=1)
    gpu_memory_peak: MemoryUse | None = None
    gpu_memory: MemoryUse | None = None
    overhead: Vcpus


class Measured(Strict):
    """One sample's record.

    `stopped_by` is what ended the measurement: steps, time, precision, decided (too slow to become the choice), exit of the
    processes, size of the timings, a signal. Of the `duration` that is paid, `setup` is how long it took to the first request,
    and `measuring` how long from then on.
    `requests` counts valid requests after warm-up, `failed_requests` those that failed their own check.
    `errors` are relative standard errors of the latency's statistics, from requests in the order they came, and
    `metric_errors` those of metrics: where one is missing, nothing can be said of it. They are None in records of means alone.
    `busy` is what is paid for each valid one: the time in which at least one request was open, those that failed included, and
    the CPU time of an application without a workload between them where it is much.
    `service` is the time that the node worked on a request, without what it waited for others, where the probe tells
    them apart; `lost` of the failed requests got no response, `unmatched` responses belong to no request.
    `latency` is there when at least one valid request was measured, whatever the state; `latency_lower_bound` is a lower
    bound on the latency of a sample that was aborted in the middle of a request. A figure that its machine sent out of
    range (`fogspec.results.ranges`) is none: it makes the sample `failed`, `out_of_range`. `server` is the server
    that ran it, `resources` what it used. `timings` is the digest of the raw timings, a file in the folder of results.
    """

    id: Id
    machine: Machine
    measured_on: Text
    state: State
    reason: Reason | None = None
    detail: Text | None = None
    requests: Counted
    failed_requests: Counted = 0
    latency: LatencySummary | None = None
    errors: dict[Statistic, RelativeError] | None = None
    busy: RequestTime | None = None
    service: LatencySummary | None = None
    lost: Counted | None = None
    unmatched: Counted | None = None
    latency_lower_bound: RequestTime | None = None
    metrics: dict[str, MetricValue] = Field({})
    metric_errors: dict[str, RelativeError] | None = None
    stopped_by: StoppedBy | None = None
    setup: Time | None = None
    measuring: Time | None = None
    duration: Time
    spent: Amount
    timings: str | None = None
    server: ServerFacts | None = None
    resources: ResourceUse | None = None


class Confirmation(Strict):
    """The chosen machine, measured once more after a change: what `sample` measured, and what it was compared with.

    `interval` is that of the older results for another server of this type, at `level`; a change of the latency by less than
    the fraction `detectable` passes such a comparison in one case of five or more.
    """

    sample: Id
    changes: list[Text]
    statistic: Statistic
    latency: RequestTime
    interval: tuple[RequestTime, RequestTime]
    level: float = Field(gt=0, lt=1)
    detectable: float = Field(ge=0)
    metrics: dict[str, MetricValue] = Field({})


class Carried(Lean):
    """Samples that were measured before a change and count on: `inputs` is the digest of the record of inputs before it.

    Because the changes were waived, or a measurement of the chosen machine confirmed the older results. In the file of one
    sample, it is that sample.
    """

    inputs: str
    samples: list[Id] = Field([])
    waivers: list[Waiver] = Field([])
    confirmed: Confirmation | None = None


class Requested(Lean):
    """A sample that an adaptive campaign requested: the `place` that it has in its `batch` of so many, all from 1, and why.

    `hardware`, `infra` and `limits_digest` are those of `fogspec.plan.schema.Sampling`, as are `stop_reason` and
    `out_of_budget`, which the samples of the last batch have.
    """

    batch: int = Field(ge=1)
    place: int = Field(ge=1)
    of: int = Field(ge=1)
    reason: str
    sample: Sample
    hardware: Hardware
    infra: list[str]
    limits_digest: str
    stop_reason: str | None = None
    out_of_budget: bool = False


PUBLISHED = "recorded"  # the runner of samples that others measured and published


class ResultBody(Lean):
    """One sample: its record, None while there is none; what all attempts to measure it have `spent`; and provenance.

    `inputs` is the record of what was measured (`fogspec.language.fingerprints.measured_record`): fields of the spec,
    digests of the image and of the files that were sent. `carried` are the changes since, in order; `inputs` is the
    newest record. `source` cites measurements that were recorded elsewhere.
    """

    id: Id
    inputs: dict[str, Any]
    carried: list[Carried] = Field([], max_length=1000)
    runner: str
    source: str | None = None
    spent: Amount
    requested: Requested | None = None
    record: Measured | None = None


class Result(Strict):
    """`kind: Result`: the file of one sample. `integrity` is the digest over its body, so that an edited file is detected."""

    apiVersion: Literal["fogspec.dev/v1alpha1"] = "fogspec.dev/v1alpha1"
    kind: Literal["Result"] = "Result"
    spec: ResultBody
    integrity: str


class ResultsBody(Strict):
    """All samples of an application: what the files say together (`fogspec.results.folded`).

    `carried` are the changes since the older samples, in order; `inputs` is the newest record. `paid` is what the attempts of
    a sample cost where that is not the cost of its record, or where there is none. `before` is what results cost that were
    set aside.
    """

    inputs: dict[str, Any]
    carried: list[Carried] | None = None
    runner: str
    source: str | None = None
    sampling: Sampling | None = None
    samples: list[Measured]
    paid: dict[str, Amount] = Field({})
    before: Amount = 0.0

    @property
    def machines(self) -> dict[str, Machine]:
        """Return the machine of each sample, by its id."""
        return {one.id: one.machine for one in self.samples}

    @property
    def costs(self) -> dict[str, float]:
        """What each sample has cost in USD, by its id."""
        return {one.id: one.spent for one in self.samples} | self.paid

    @property
    def spent(self) -> float:
        """What all of it has cost in USD."""
        return round(math.fsum([self.before, *self.costs.values()]), 9)


@dataclass(frozen=True, slots=True, kw_only=True)
class Arrivals:
    """What the raw timings of a sample say of its latency at `requests_per_s`, which is `spec.objective.load.rate`.

    `table` is `fogspec.numerics.waiting.table` of its requests, with the relative standard error `error` at the rate; None
    where they came several at a time, less often than that: at `sent_per_s`.
    """

    requests_per_s: float
    table: tuple[float, ...] | None
    error: float = 0.0
    sent_per_s: float | None = None


@dataclass(frozen=True, slots=True)
class Results:
    """The results of an application; `integrity` is the digest over what is measured and its provenance.

    `arrivals` are those of the samples with raw timings, by id, where the spec has a load.
    """

    spec: ResultsBody
    integrity: str
    arrivals: Mapping[str, Arrivals] = field(default_factory=dict)


def results_of(body: ResultsBody) -> Results:
    """Return the results with their digest: over all fields but those that are None, and what was set aside."""
    return Results(body, digest.of_value(body.model_dump(mode="json", exclude={"before"}, exclude_none=True)))


def sealed(body: ResultBody) -> Result:
    """Return the file of a sample with its checksum."""
    return Result(spec=body, integrity=_checksum(body))


def checksum_ok(file: Result) -> bool:
    """Return whether the checksum matches the content."""
    return file.integrity == _checksum(file.spec)


def _checksum(body: ResultBody) -> str:
    """Return the digest over all fields but those that are None, so that an optional field added later keeps it valid."""
    return digest.of_value(body.model_dump(mode="json", exclude_none=True))


def is_final(record: Measured) -> bool:
    """Return whether a sample is measured, or failed for a reason that a retry would not change."""
    return record.state != "failed" or record.reason not in RETRYABLE


def completed(results: Results | None) -> frozenset[str]:
    """Return the ids of samples that are not measured again: final ones, and unavailable ones that a campaign left behind.

    An adaptive campaign that continued without an unavailable machine does not return to it.
    """
    if results is None:
        return frozenset()
    abandoned = _abandoned(results.spec)
    return frozenset(one.id for one in results.spec.samples if is_final(one) or one.id in abandoned)


def other_machines(plan: Plan, results: Results) -> list[str]:
    """Return the ids that are in the plan another machine's than in the results."""
    measured = results.spec.machines
    return [one.id for one in plan.spec.samples if measured.get(one.id, one.machine).identity != one.machine.identity]


def free_failures(results: Results | None) -> frozenset[str]:
    """Return the ids of samples that failed and cost nothing: the next bench measures them again, whatever the reason was.

    None of an adaptive campaign, which decided by them.
    """
    if results is None or results.spec.sampling is not None:
        return frozenset()
    return frozenset(one.id for one in results.spec.samples if one.state == "failed" and not one.spent)


def _abandoned(body: ResultsBody) -> set[str]:
    """Return the unavailable samples of batches after which the campaign continued or stopped, if any was measured."""
    sampling = body.sampling
    if sampling is None or not any(one.state == "ok" for one in body.samples):
        return set()
    before = sampling.batches if sampling.stop_reason is not None else sampling.batches[:-1]
    requested = {sample.id for batch in before for sample in batch.samples}
    return {one.id for one in body.samples if one.reason in UNAVAILABLE and one.id in requested}


def other_servers(records: Sequence[Measured]) -> list[Warned]:
    """Return a warning for each instance type that was measured on servers with different CPUs."""
    cpus: dict[TypeKey, dict[str, None]] = {}
    for one in records:
        if one.server is not None:
            seen = filter(None, (one.server.cpu, one.server.changed_to))
            cpus.setdefault(one.machine.type_key, {}).update(dict.fromkeys(seen))
    return [
        warned(mixed_servers, machine=instance, cpus=list(seen))
        for (_, instance, *_), seen in cpus.items()
        if len(seen) > 1
    ]
