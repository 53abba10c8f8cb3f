"""What a benchmark's money bought: one record a sample, whatever became of it."""

from typing import Literal

from pydantic import Field

from fogspec.base import digest
from fogspec.base.fields import Duration, Money, Strict
from fogspec.plan import MachineRef, PlanMetadata

State = Literal["ok", "insufficient", "timeout", "failed"]
Reason = Literal[
    "quota", "capacity", "image", "setup", "crash", "out_of_memory", "no_response", "check", "interrupted", "budget"
]


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

    `requests` counts valid requests after warm-up, `failed_requests` those that failed their own check.
    `latency` is there when at least one valid request was measured, whatever the state; `waited` is a lower
    bound on the latency of a sample that was aborted in the middle of a request.
    """

    id: str
    machine: MachineRef
    measured_on: str
    state: State
    reason: Reason | None = None
    detail: str | None = None
    requests: int
    failed_requests: int = 0
    latency: LatencySummary | None = None
    waited: Duration | None = None
    metrics: dict[str, float] = Field({})
    duration: Duration
    spent: Money
    timings: Timings | None = None


class ResultsBody(Strict):
    """Where the figures come from, and the samples.

    `application` is the digest over what measuring reads of the spec; `plan` the digest of the plan, None for
    measurements that were recorded elsewhere, whose `source` cites them. `pins` are the plan's: digests of what the
    spec only names; None where nothing was locked. `reads` are the plan's digests of what measuring reads of the spec.
    """

    application: str
    plan: str | None = None
    pins: dict[str, str] | None = None
    reads: dict[str, str] | None = None
    runner: str
    source: str | None = None
    budget: Money | None = None
    spent: Money
    samples: list[Measured]


class Results(Strict):
    """`kind: Results`; `integrity` is the digest over everything else, so that an edited file is noticed."""

    apiVersion: Literal["fogspec.dev/v1alpha1"] = "fogspec.dev/v1alpha1"
    kind: Literal["Results"] = "Results"
    metadata: PlanMetadata
    spec: ResultsBody
    integrity: str


def sealed(metadata: PlanMetadata, body: ResultsBody) -> Results:
    """The results with their seal."""
    return Results(metadata=metadata, spec=body, integrity=_seal(metadata, body))


def intact(results: Results) -> bool:
    """Whether the seal is that of the content."""
    return results.integrity == _seal(results.metadata, results.spec)


def _seal(metadata: PlanMetadata, body: ResultsBody) -> str:
    unused = {name for name in ("pins", "reads") if getattr(body, name) is None}
    return digest.of_value([metadata.model_dump(mode="json"), body.model_dump(mode="json", exclude=unused)])
