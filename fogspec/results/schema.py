"""The results of a benchmark: one record per sample, measured or failed."""

from collections.abc import Iterable, Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from fogspec.base import digest
from fogspec.base.quantities import Id, Lean, Money, Strict
from fogspec.catalog.machine import Machine, TypeKey
from fogspec.plan.schema import PartName, PlanMetadata, Sampling, article
from fogspec.results.ranges import Amount, Counted, MemoryUse, MetricValue, RequestTime, Text, Time, Vcpus
from fogspec.spec.schema import Statistic, Waiver

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


class Timings(Strict):
    """Raw timings of a sample: a file relative to the results file, and sha256 of its bytes."""

    path: str
    digest: str


class ServerFacts(Strict):
    """The server that ran a sample, as it described itself; facts that it did not give are None.

    `features` are instruction sets that matter to numerical code. `clock_ghz` and `run_queue`, the tasks that could have run,
    are those at the end; `steal` is the fraction of the CPU time that its host gave to others, `io_wait` that in which
    it was idle and waited for disks. `changed_to` is another CPU
    that it had at the end.
    """

    cpu: str = Field(min_length=1, max_length=120)
    arch: str | None = Field(None, pattern=r"^[A-Za-z0-9_]{1,16}$")
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
    is the fraction of periods in which that quota stopped them. `memory_peak` is the largest sum of their resident memory, read
    once per second. Page faults are theirs; `major_faults` waited for a disk. `swapped`, `received` and `sent` are what the
    whole machine moved to and from swap and through its network devices. Of its `gpus`, `gpu_mean` and `gpu_max` are the
    fractions of time in which the busiest one computed, and `gpu_memory_peak` is of `gpu_memory` of the fullest one. `overhead`
    is what reading all this took, in vCPUs.
    """

    window: Time
    vcpus: Vcpus
    cpu_mean: Vcpus
    cpu_max: Vcpus
    throttled: float | None = Field(None, ge=0, le=1)
    memory_peak: MemoryUse
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


class Confined(Strict):
    """By what a part of a machine was held to its vCPUs and to its memory, None for memory that was not limited."""

    cpus_by: Literal["cpuset", "affinity"]
    memory_by: Literal["cgroup"] | None = None


class NestedIn(Strict):
    """The sample whose machine was confined, that machine, the part of it, and how it was held to that."""

    sample: Id
    machine: Machine
    part: PartName
    confined: Confined | None = None

    @property
    def label(self) -> str:
        """Return where it was measured, for people."""
        return f"{article(self.part)} of {self.machine.instance}"


class Measured(Strict):
    """One sample's record.

    `substitute_for` names the unavailable sample that this machine was measured for. `stopped_by` is
    what ended the measurement: steps, time, precision, decided (too slow to become the choice), exit of the processes, size of
    the timings, a signal. Of the `duration` that is paid, `setup` is how long it took to the first request, and `measuring` how
    long from then on.
    `requests` counts valid requests after warm-up, `failed_requests` those that failed their own check.
    `service` is the time that the node worked on a request, without what it waited for others, where the probe tells
    them apart; `lost` of the failed requests got no response, `unmatched` responses belong to no request.
    `latency` is there when at least one valid request was measured, whatever the state; `latency_lower_bound` is a lower
    bound on the latency of a sample that was aborted in the middle of a request. A figure that its machine sent out of
    range (`fogspec.results.ranges`) is none: it makes the sample `failed`, `out_of_range`. `server` is the server
    that ran it, `resources` what it used.

    A record that is `nested_in` another was measured on a part of that one's machine: it stands for `machine`, which it is not,
    and its cost is in that record.
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
    service: LatencySummary | None = None
    lost: Counted | None = None
    unmatched: Counted | None = None
    latency_lower_bound: RequestTime | None = None
    metrics: dict[str, MetricValue] = Field({})
    substitute_for: Id | None = None
    stopped_by: StoppedBy | None = None
    setup: Time | None = None
    measuring: Time | None = None
    duration: Time
    spent: Amount
    timings: Timings | None = None
    server: ServerFacts | None = None
    resources: ResourceUse | None = None
    nested_in: NestedIn | None = None

    @model_validator(mode="after")
    def _is_part(self) -> Self:
        """Require of a nested record that it is smaller than its machine, free of charge, and no substitute."""
        parent = self.nested_in
        if parent is None:
            return self
        if self.machine.cpus >= parent.machine.cpus or self.machine.memory > parent.machine.memory:
            raise ValueError(f"{self.id} is nested in {parent.machine.instance}, which is not larger")
        if self.spent or self.substitute_for is not None:
            raise ValueError(f"{self.id} is nested: its machine is paid for by {parent.sample}")
        return self


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
    """Samples that were measured before a change and count on: `application` and `pins` are those before it.

    Because the changes were waived, or a measurement of the chosen machine confirmed the older results.
    """

    application: str
    pins: dict[str, str] | None = None
    samples: list[Id]
    waivers: list[Waiver] = Field([])
    confirmed: Confirmation | None = None

    ADDED = frozenset({"pins", "waivers", "confirmed"})


class ResultsBody(Strict):
    """The samples, and the provenance of their figures.

    `application` is the digest over what measuring reads of the spec; `plan` the digest of the plan, None for
    measurements that were recorded elsewhere, whose `source` cites them. `pins` are the plan's: digests of what the
    spec only names; None where nothing was locked. `field_digests` are the plan's digests of what measuring reads of the spec.
    `measured` are the values behind `application`, without those that are not set, so that a later change can be named.
    `carried` are the changes since the older samples, in order; the digests are those of the newest.
    """

    application: str
    plan: str | None = None
    pins: dict[str, str] | None = None
    field_digests: dict[str, str] | None = None
    measured: dict[str, Any] | None = None
    carried: list[Carried] | None = Field(None, max_length=1000)
    runner: str
    source: str | None = None
    budget: Money | None = None
    spent: Amount
    sampling: Sampling | None = None
    samples: list[Measured]

    @model_validator(mode="after")
    def _have_parents(self) -> Self:
        """Require of each nested record the record of the sample whose machine it was measured on."""
        known = {one.id: one.machine.type_key for one in own_records(self.samples)}
        for one in self.samples:
            parent = one.nested_in
            if parent is not None and known.get(parent.sample) != parent.machine.type_key:
                raise ValueError(
                    f"{one.id} is nested in {parent.sample}, and there is no record of that sample and machine"
                )
        return self


class Results(Strict):
    """`kind: Results`; `integrity` is the digest over everything else, so that an edited file is detected."""

    apiVersion: Literal["fogspec.dev/v1alpha1"] = "fogspec.dev/v1alpha1"
    kind: Literal["Results"] = "Results"
    metadata: PlanMetadata
    spec: ResultsBody
    integrity: str


def with_checksum(metadata: PlanMetadata, body: ResultsBody) -> Results:
    """Return the results with their checksum."""
    found = Results(metadata=metadata, spec=body, integrity="")
    return found.model_copy(update={"integrity": _checksum(found)})


def checksum_ok(results: Results) -> bool:
    """Return whether the checksum matches the content."""
    return results.integrity == _checksum(results)


def is_final(record: Measured) -> bool:
    """Return whether a sample is measured, or failed for a reason that a retry would not change."""
    return record.state != "failed" or record.reason not in RETRYABLE


def completed(results: Results | None) -> frozenset[str]:
    """Return the ids of samples that are not measured again: final ones, and those that a substitute replaced.

    An adaptive campaign that continued without an unavailable machine does not return to it.
    """
    if results is None:
        return frozenset()
    abandoned = _abandoned(results.spec)
    ended = [one for one in own_records(results.spec.samples) if is_final(one) or one.id in abandoned]
    return frozenset(name for one in ended for name in (one.id, one.substitute_for) if name is not None)


def own_records(records: Iterable[Measured]) -> list[Measured]:
    """Return the records of machines themselves, without those of parts of machines."""
    return [one for one in records if one.nested_in is None]


def _abandoned(body: ResultsBody) -> set[str]:
    """Return the unavailable samples of batches after which the campaign continued or stopped, if any was measured."""
    sampling = body.sampling
    if sampling is None or not any(one.state == "ok" for one in body.samples):
        return set()
    before = sampling.batches if sampling.stop_reason is not None else sampling.batches[:-1]
    requested = {sample.id for batch in before for sample in batch.samples}
    return {one.id for one in body.samples if one.reason in UNAVAILABLE and (one.substitute_for or one.id) in requested}


def _checksum(results: Results) -> str:
    """Return the digest over all fields but those that are None, so that an optional field added later keeps it valid."""
    written = results.model_dump(mode="json", include={"metadata", "spec"}, exclude_none=True)
    return digest.of_value([written["metadata"], written["spec"]])


def other_servers(records: Sequence[Measured]) -> list[str]:
    """Return a sentence for each instance type that was measured on servers with different CPUs."""
    cpus: dict[TypeKey, dict[str, None]] = {}
    for one in own_records(records):
        if one.server is not None:
            seen = filter(None, (one.server.cpu, one.server.changed_to))
            cpus.setdefault(one.machine.type_key, {}).update(dict.fromkeys(seen))
    return [
        f"{instance} is not one kind of machine: it was measured on {' and on '.join(seen)}"
        for (_, instance, *_), seen in cpus.items()
        if len(seen) > 1
    ]
