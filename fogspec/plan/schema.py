"""The sampling plan: the machines to measure, the cost of each, and the reason for each."""

import itertools
import math
import re
from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Literal

from pydantic import Field

from fogspec.base import digest
from fogspec.base.clouds import cloud_of
from fogspec.base.quantities import Duration, Id, Lean, Money, Strict
from fogspec.catalog.machine import Machine
from fogspec.plan.commitment import Commitment
from fogspec.spec.schema import Hardware, Name, NameInEnvironment

Sampler = Literal["grid", "adaptive", "list"]
PartName = Literal["half", "quarter", "eighth"]
Nested = Literal["nested"]


class TaskRef(Strict):
    """A compiled task beside the plan: relative path and sha256 of its bytes."""

    path: str
    digest: str


def article(part: PartName) -> str:
    """Return a part's name with its article."""
    return f"an {part}" if part == "eighth" else f"a {part}"


class Part(Strict):
    """A part of a machine, and the machine that it stands for: of that many vCPUs and that much memory."""

    part: PartName
    machine: Machine


class Sample(Lean):
    """One machine to measure; `id` is unique in the plan and names its cluster, task and files.

    `parts` of it are measured after it, on the same machine (ADR 0025). Once its latency is certainly above `decided_above` it
    cannot become the choice, and measuring ends (ADR 0028).
    """

    id: Id
    machine: Machine
    reason: str
    task: TaskRef | None = None
    parts: list[Part] = Field([], max_length=3)
    decided_above: Duration | None = None

    ADDED = frozenset({"parts", "decided_above"})

    @property
    def part_names(self) -> tuple[PartName, ...]:
        """The names of its parts, in the order in which they are measured."""
        return tuple(one.part for one in self.parts)

    def nested(self, part: Part) -> "Sample":
        """Return the sample that a part of the machine is."""
        return Sample(
            id=f"{self.id}-{part.part}", machine=part.machine, reason=f"{article(part.part)} of {self.machine.instance}"
        )


class Substitute(Strict):
    """A machine to measure if the machine of the sample `substitute_for` is unavailable; they are tried in this order."""

    substitute_for: Id
    machine: Machine
    reason: str


class CatalogRef(Strict):
    """The catalog that a file was made from."""

    source: str
    revision: str
    date: str
    digest: str


class ApplicationRef(Strict):
    """The spec that a file was made from; the digest covers the values that the stage reads, not the bytes of the file.

    In a plan, `field_digests` has a short digest of each field that the measurements depend on, to name a change.
    """

    path: str
    digest: str
    field_digests: dict[str, str] = Field({})


class Batch(Strict):
    """Samples that were requested together, and why."""

    reason: str
    samples: list[Sample]


class Sampling(Strict):
    """Recorded decisions of an adaptive campaign; later compiles reuse them instead of running the sampler again.

    `hardware` and `infra` are the search space that the batches were chosen from, `limits_digest` is a digest of the limits
    and the objective. `stop_reason` is why no further sample was requested, None while that is undecided; with
    `out_of_budget` there was one, but not enough money left for it.
    """

    hardware: Hardware
    infra: list[str]
    limits_digest: str
    batches: list[Batch]
    stop_reason: str | None = None
    out_of_budget: bool = False


class Estimate(Strict):
    """The maximum cost of the plan, and its duration with all samples at once.

    `measuring` and `setup` are their longest times, `overhead` the rest that is paid: provisioning, collecting, teardown.
    """

    measuring: Money
    setup: Money
    overhead: Money = Field(0.0)
    total: Money
    wall: Duration


class PlanBody(Lean):
    """The samples of a plan and the settings that they are measured with.

    `hardware` and `infra` are the search space that the samples were chosen from, `design_catalog` is the digest of the
    catalog at that time; the spec may have become narrower since, and prices may have changed. `pins` are digests from the
    lock of what the spec only names.
    """

    application: ApplicationRef
    pins: dict[str, str] = Field({})
    catalog: CatalogRef
    design_catalog: str
    hardware: Hardware
    infra: list[str]
    sampler: Sampler
    shapes: Nested | None = None
    requests: int | None
    duration: Duration
    warmup: int
    setup_timeout: Duration
    budget: Money | None
    estimate: Estimate
    samples: list[Sample]
    substitutes: list[Substitute] = Field([])
    notes: list[str]

    ADDED = frozenset({"shapes"})

    @property
    def commitment(self) -> Commitment:
        """The most that each sample's machine is paid for."""
        return Commitment(measuring_s=self.duration, setup_s=self.setup_timeout, nested=self.shapes is not None)


class PlanMetadata(Strict):
    """The name of the application."""

    name: Name


class EnvironmentMetadata(Strict):
    """The name of the application, with `@` and the environment behind it unless that is the default one."""

    name: NameInEnvironment


class Plan(Strict):
    """`kind: SamplingPlan`: written by `compile` and run by `bench`."""

    apiVersion: Literal["fogspec.dev/v1alpha1"] = "fogspec.dev/v1alpha1"
    kind: Literal["SamplingPlan"] = "SamplingPlan"
    metadata: PlanMetadata
    spec: PlanBody

    @property
    def runner_options(self) -> list[str]:
        """The options of `fogspec bench` that say where this plan is measured, if it is on this host."""
        return ["--runner", "local"] if all(sample.machine.is_local for sample in self.spec.samples) else []


NO_PINS: Mapping[str, str] = MappingProxyType({})


def sample_id(machine: Machine, nth: int = 1) -> str:
    """Return the id of the `nth` sample of a machine; it depends on both alone, so that a wider plan keeps it."""
    words = [machine.infra, machine.instance]
    if machine.gpu and cloud_of(machine.infra).attaches_gpus:
        words.append(machine.gpu.key)
    if machine.spot:
        words.append("spot")
    if nth > 1:
        words.append(f"repeat-{nth}")
    return re.sub(r"[^a-z0-9]+", "-", " ".join(words).lower()).strip("-")


def replicate(sample_id: str) -> int:
    """Return the number of a sample among those of its machine: 1 for the first."""
    found = re.search(r"-repeat-([0-9]+)$", sample_id)
    return int(found[1]) if found else 1


def sample_on(machine: Machine, reason: str, nth: int = 1) -> Sample:
    """Return the `nth` sample of this machine."""
    return Sample(id=sample_id(machine, nth), machine=machine, reason=reason)


def next_on(machine: Machine, reason: str, taken: Collection[str]) -> Sample:
    """Return the first sample of this machine whose id is not taken."""
    numbered = (sample_on(machine, reason, nth) for nth in itertools.count(1))
    return next(sample for sample in numbered if sample.id not in taken)


def estimate(samples: Sequence[Sample], each: Commitment) -> Estimate:
    """Return the most that the samples can cost in USD, and the time in seconds that they measure and set up at most."""
    usd_per_hour = math.fsum(sample.machine.price for sample in samples)
    measuring, setup = (round(usd_per_hour * seconds / 3600, 6) for seconds in (each.measuring_s, each.setup_s))
    total = round(each.usd(usd_per_hour), 6)
    overhead = max(round(total - measuring - setup, 6), 0.0)
    return Estimate(measuring=measuring, setup=setup, overhead=overhead, total=total, wall=each.wall_s)


def digest_without_budget(plan: Plan) -> str:
    """Return the digest of a plan's content without its budget, which decides only whether the plan is measured."""
    return digest.of_value(plan.model_dump(mode="json", exclude={"spec": {"budget"}}))
