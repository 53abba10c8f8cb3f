"""What a benchmark's money bought: one record a sample, whatever became of it."""

from typing import Literal

from pydantic import Field

from fogspec.base import digest
from fogspec.base.quantities import Duration, Money, Strict
from fogspec.catalog.machine import Machine
from fogspec.plan.schema import PlanMetadata, Sampling

State = Literal["ok", "insufficient", "timeout", "failed"]
Reason = Literal[
    "quota", "capacity", "image", "setup", "crash", "out_of_memory", "no_response", "check", "interrupted", "budget"
]
StoppedBy = Literal["steps", "time", "precision", "exit", "size", "startup", "signal"]
# Nothing that a second try could change came of these, or nobody had the chance to try.
RETRYABLE = {"quota", "capacity", "interrupted", "budget"}
UNAVAILABLE = {"quota", "capacity"}


class LatencySummary(Strict):
    """Statistics of the valid requests' latency after warm-up; only what was measured is there."""

    mean: Duration
    sd: Duration | None = None
    p50: Duration | None = None
    p95: Duration | None = None
    p99: Duration | None = None


class Timings(Strict):
    """Raw timings of a sample: a file relative to the results file, and sha256 of its bytes."""

    path: str
    digest: str


class Measured(Strict):
    """One sample's record.

    `substitute_for` names the sample that could not be had, in whose place this machine was measured. `stopped_by` says
    what ended the measuring: steps, time, precision, exit of the processes, size of the timings, a signal. Of the
    `duration` that is paid, `setup` is how long it took to the first request, and `measuring` how long from then on.
    `requests` counts valid requests after warm-up, `failed_requests` those that failed their own check.
    `service` is the time that the node worked on a request, without what it waited for others, where the probe tells
    them apart; `lost` of the failed requests got no response, `unmatched` responses belong to no request.
    `latency` is there when at least one valid request was measured, whatever the state; `latency_lower_bound` is a lower
    bound on the latency of a sample that was aborted in the middle of a request.
    """

    id: str
    machine: Machine
    measured_on: str
    state: State
    reason: Reason | None = None
    detail: str | None = None
    requests: int
    failed_requests: int = 0
    latency: LatencySummary | None = None
    service: LatencySummary | None = None
    lost: int | None = None
    unmatched: int | None = None
    latency_lower_bound: Duration | None = None
    metrics: dict[str, float] = Field({})
    substitute_for: str | None = None
    stopped_by: StoppedBy | None = None
    setup: Duration | None = None
    measuring: Duration | None = None
    duration: Duration
    spent: Money
    timings: Timings | None = None


class ResultsBody(Strict):
    """Where the figures come from, and the samples.

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
    spent: Money
    sampling: Sampling | None = None
    samples: list[Measured]


class Results(Strict):
    """`kind: Results`; `integrity` is the digest over everything else, so that an edited file is noticed."""

    apiVersion: Literal["fogspec.dev/v1alpha1"] = "fogspec.dev/v1alpha1"
    kind: Literal["Results"] = "Results"
    metadata: PlanMetadata
    spec: ResultsBody
    integrity: str


def with_checksum(metadata: PlanMetadata, body: ResultsBody) -> Results:
    """The results with their seal."""
    return Results(metadata=metadata, spec=body, integrity=_checksum(metadata, body))


def checksum_ok(results: Results) -> bool:
    """Whether the seal is that of the content."""
    return results.integrity == _checksum(results.metadata, results.spec)


def is_final(record: Measured) -> bool:
    """Whether a sample need not be measured again: measured, or failed for a reason of its own."""
    return record.state != "failed" or record.reason not in RETRYABLE


def completed(results: Results | None) -> frozenset[str]:
    """The ids of samples that need not be measured again: finished, or another machine took their place.

    An adaptive campaign goes elsewhere when a machine is not to be had, and does not come back once it has.
    """
    if results is None:
        return frozenset()
    given_up = _is_abandoned(results.spec)
    ended = [one for one in results.spec.samples if is_final(one) or one.id in given_up]
    return frozenset(name for one in ended for name in (one.id, one.substitute_for) if name is not None)


def _is_abandoned(body: ResultsBody) -> set[str]:
    """Samples that were not to be had, of waves after which another was asked for, or none, if any was measured."""
    sampling = body.sampling
    if sampling is None or not any(one.state == "ok" for one in body.samples):
        return set()
    before = sampling.batches if sampling.stop_reason is not None else sampling.batches[:-1]
    asked = {sample.id for wave in before for sample in wave.samples}
    return {one.id for one in body.samples if one.reason in UNAVAILABLE and (one.substitute_for or one.id) in asked}


def _checksum(metadata: PlanMetadata, body: ResultsBody) -> str:
    """Return the digest over all fields but those that are None, so that an optional field added later keeps it valid."""
    return digest.of_value([metadata.model_dump(mode="json"), body.model_dump(mode="json", exclude_none=True)])
