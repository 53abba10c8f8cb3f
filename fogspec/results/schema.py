"""The results of a benchmark: one record per sample, measured or failed."""

from typing import Literal

from pydantic import Field

from fogspec.base import digest
from fogspec.base.quantities import Money, Strict
from fogspec.catalog.machine import Machine
from fogspec.plan.schema import PlanMetadata, Sampling
from fogspec.results.ranges import Amount, Counted, MetricValue, RequestTime, Text, Time

State = Literal["ok", "insufficient", "timeout", "failed"]
Reason = Literal[
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
StoppedBy = Literal["steps", "time", "precision", "exit", "size", "startup", "signal"]
# Failures worth retrying: transient ones, and samples that never ran.
RETRYABLE = {"quota", "capacity", "interrupted", "budget"}
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


class Measured(Strict):
    """One sample's record.

    `substitute_for` names the unavailable sample that this machine was measured for. `stopped_by` is
    what ended the measurement: steps, time, precision, exit of the processes, size of the timings, a signal. Of the
    `duration` that is paid, `setup` is how long it took to the first request, and `measuring` how long from then on.
    `requests` counts valid requests after warm-up, `failed_requests` those that failed their own check.
    `service` is the time that the node worked on a request, without what it waited for others, where the probe tells
    them apart; `lost` of the failed requests got no response, `unmatched` responses belong to no request.
    `latency` is there when at least one valid request was measured, whatever the state; `latency_lower_bound` is a lower
    bound on the latency of a sample that was aborted in the middle of a request. A figure that its machine sent out of
    range (`fogspec.results.ranges`) is none: it makes the sample `failed`, `out_of_range`.
    """

    id: str
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
    substitute_for: str | None = None
    stopped_by: StoppedBy | None = None
    setup: Time | None = None
    measuring: Time | None = None
    duration: Time
    spent: Amount
    timings: Timings | None = None


class ResultsBody(Strict):
    """The samples, and the provenance of their figures.

    `application` is the digest over what measuring reads of the spec; `plan` the digest of the plan, None for
    measurements that were recorded elsewhere, whose `source` cites them. `pins` are the plan's: digests of what the
    spec only names; None where nothing was locked. `field_digests` are the plan's digests of what measuring reads of the spec.
    """

    application: str
    plan: str | None = None
    pins: dict[str, str] | None = None
    field_digests: dict[str, str] | None = None
    runner: str
    source: str | None = None
    budget: Money | None = None
    spent: Amount
    sampling: Sampling | None = None
    samples: list[Measured]


class Results(Strict):
    """`kind: Results`; `integrity` is the digest over everything else, so that an edited file is detected."""

    apiVersion: Literal["fogspec.dev/v1alpha1"] = "fogspec.dev/v1alpha1"
    kind: Literal["Results"] = "Results"
    metadata: PlanMetadata
    spec: ResultsBody
    integrity: str


def with_checksum(metadata: PlanMetadata, body: ResultsBody) -> Results:
    """Return the results with their checksum."""
    return Results(metadata=metadata, spec=body, integrity=_checksum(metadata, body))


def checksum_ok(results: Results) -> bool:
    """Return whether the checksum matches the content."""
    return results.integrity == _checksum(results.metadata, results.spec)


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
    ended = [one for one in results.spec.samples if is_final(one) or one.id in abandoned]
    return frozenset(name for one in ended for name in (one.id, one.substitute_for) if name is not None)


def _abandoned(body: ResultsBody) -> set[str]:
    """Return the unavailable samples of batches after which the campaign continued or stopped, if any was measured."""
    sampling = body.sampling
    if sampling is None or not any(one.state == "ok" for one in body.samples):
        return set()
    before = sampling.batches if sampling.stop_reason is not None else sampling.batches[:-1]
    requested = {sample.id for batch in before for sample in batch.samples}
    return {one.id for one in body.samples if one.reason in UNAVAILABLE and (one.substitute_for or one.id) in requested}


def _checksum(metadata: PlanMetadata, body: ResultsBody) -> str:
    """Return the digest over all fields but those that are None, so that an optional field added later keeps it valid."""
    return digest.of_value([metadata.model_dump(mode="json"), body.model_dump(mode="json", exclude_none=True)])
