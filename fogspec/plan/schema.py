"""The sampling plan: the machines to measure, the cost of each, and the reason for each."""

import functools
import itertools
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field

from fogspec.base import digest
from fogspec.base.clouds import cloud_of
from fogspec.base.quantities import Duration, Id, Lean, Money, Strict
from fogspec.catalog.machine import Machine
from fogspec.catalog.table import About
from fogspec.language.schema import Benchmark, Hardware, Name, NameInEnvironment, Sampler
from fogspec.language.warned import Warned
from fogspec.plan.commitment import Commitment

LONGEST_ID = 120  # of files' names, which may have 255 bytes


class TaskRef(Strict):
    """A compiled file: path relative to the file that names it, and sha256 of its bytes."""

    path: str
    digest: str


class Sample(Lean):
    """One machine to measure; `id` is unique in the plan and names its cluster, task and files; `task` is the task's sha256.

    Once its latency is certainly above `decided_above` it cannot become the choice, and measuring ends.
    """

    id: Id
    machine: Machine
    reason: str
    task: str | None = None
    decided_above: Duration | None = None


def _each_once(samples: list[Sample]) -> list[Sample]:
    """Return the samples; raise ValueError if two have one id: each would be taken for the other."""
    if twice := [name for name, times in Counter(one.id for one in samples).items() if times > 1]:
        raise ValueError(f"two samples have the id {twice[0]}")
    return samples


class CatalogRef(Lean):
    """The catalog that a file was made from; `origin` is what `--catalog` takes to read it, relative to the project.

    Without prices its costs are `core_hours`.
    """

    origin: str
    source: str
    revision: str
    date: str
    digest: str
    core_hours: bool = False

    @classmethod
    def of(cls, about: About) -> Self:
        """Return the reference to a catalog."""
        return cls.model_validate(about, from_attributes=True)


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


class PlanBody(Strict):
    """The samples of a plan and the settings that they are measured with.

    `hardware` and `infra` are the search space that the samples were chosen from, `design_catalog` is the digest of the
    catalog at that time if it was another; the spec may have become narrower since. `inputs` is the record of
    what is measured (`fogspec.language.fingerprints.measured_record`). `scripts` are what every sample's machine runs.
    """

    inputs: dict[str, Any]
    catalog: CatalogRef
    design_catalog: str | None = None
    hardware: Hardware
    infra: list[str]
    sampler: Sampler
    requests: int | None = None
    duration: Duration
    warmup: int
    ready_timeout: Duration
    budget: Money | None = None
    estimate: Estimate
    scripts: list[TaskRef] = Field([])
    samples: Annotated[list[Sample], AfterValidator(_each_once)]
    notes: list[Warned] = Field([])

    @property
    def designed_from(self) -> str:
        """The digest of the catalog that the samples were chosen from."""
        return self.design_catalog or self.catalog.digest

    @property
    def commitment(self) -> Commitment:
        """The most that each sample's machine is paid for."""
        return Commitment(measuring_s=self.duration, setup_s=self.ready_timeout)


# What every sample is measured with, by the name in a plan, as the fields of `spec.benchmark` have it.
SETTINGS = {
    "requests": "stop.requests",
    "duration": "stop.duration",
    "warmup": "warmup",
    "ready_timeout": "ready_timeout",
}


def settings_of(benchmark: Benchmark) -> dict[str, Any]:
    """Return the values of `SETTINGS` in a spec."""
    return {name: functools.reduce(getattr, path.split("."), benchmark) for name, path in SETTINGS.items()}


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


def sample_id(machine: Machine, nth: int = 1, *, apart: bool = False) -> str:
    """Return the id of the `nth` sample of a machine; it depends on these alone, so that a wider plan keeps it.

    An id that is kept `apart` from that of another machine, `node-a` from `node_a`, ends in a digest of the machine; so
    does one that is too long, or looks as that of a further sample.
    """
    words = [machine.infra, machine.instance]
    if machine.gpu and cloud_of(machine.infra).attaches_gpus:
        words.append(machine.gpu.key)
    if machine.spot:
        words.append("spot")
    plain = re.sub(r"[^a-z0-9]+", "-", " ".join(words).lower()).strip("-")
    if apart or len(plain) > LONGEST_ID or replicate(plain) > 1:
        plain = f"{plain[:LONGEST_ID].rstrip('-')}-{digest.shorten(digest.of_value(machine.identity), 6)}"
    return plain if nth == 1 else f"{plain}-repeat-{nth}"


def replicate(sample_id: str) -> int:
    """Return the number of a sample among those of its machine: 1 for the first."""
    found = re.search(r"-repeat-([0-9]+)$", sample_id)
    return int(found[1]) if found else 1


def sample_on(machine: Machine, reason: str, nth: int = 1, *, apart: bool = False) -> Sample:
    """Return the `nth` sample of this machine."""
    return Sample(id=sample_id(machine, nth, apart=apart), machine=machine, reason=reason)


def is_apart(machine: Machine, taken: Mapping[str, Machine]) -> bool:
    """Return whether the id of a machine must be kept apart from those that are `taken`."""
    other = taken.get(sample_id(machine), machine)
    return other.identity != machine.identity or sample_id(machine, apart=True) in taken


def next_on(machine: Machine, reason: str, taken: Mapping[str, Machine]) -> Sample:
    """Return the first sample of this machine whose id is not taken."""
    apart = is_apart(machine, taken)
    numbered = (sample_on(machine, reason, nth, apart=apart) for nth in itertools.count(1))
    return next(sample for sample in numbered if sample.id not in taken)


def estimate(samples: Sequence[Sample], each: Commitment) -> Estimate:
    """Return the most that the samples can cost in USD, and the time in seconds that they measure and set up at most."""
    usd_per_hour = math.fsum(sample.machine.paid_usd_per_hour for sample in samples)
    measuring, setup = (round(usd_per_hour * seconds / 3600, 6) for seconds in (each.measuring_s, each.setup_s))
    total = round(math.fsum(each.usd(sample.machine) for sample in samples), 6)
    overhead = max(round(total - measuring - setup, 6), 0.0)
    return Estimate(measuring=measuring, setup=setup, overhead=overhead, total=total, wall=each.wall_s)


def digest_without_budget(plan: Plan) -> str:
    """Return the digest of a plan's content without its budget, which decides only whether the plan is measured."""
    return digest.of_value(plan.model_dump(mode="json", exclude={"spec": {"budget"}}))
