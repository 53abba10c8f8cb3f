"""The sampling plan: which machines are measured, what each costs, and why each is there."""

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from fogspec.base import digest
from fogspec.base.quantities import Duration, Money, Strict
from fogspec.catalog.filters import Filtered, filter_offers
from fogspec.catalog.machine import Machine
from fogspec.catalog.table import About, Catalog
from fogspec.plan import design
from fogspec.spec import fingerprints
from fogspec.spec.lockfile import image_named
from fogspec.spec.schema import Application, Hardware

if TYPE_CHECKING:
    from fogspec.numerics.priors import Library


class TaskRef(Strict):
    """A compiled task beside the plan: relative path and sha256 of its bytes."""

    path: str
    digest: str


class Sample(Strict):
    """One machine to measure; `id` is unique in the plan and names its cluster, task and files."""

    id: str
    machine: Machine
    reason: str
    task: TaskRef | None = None


class Substitute(Strict):
    """A machine that is measured where the sample `substitute_for` cannot be had; those named first are tried first."""

    substitute_for: str
    machine: Machine
    reason: str


class CatalogRef(Strict):
    """Which catalog a file was made from."""

    source: str
    revision: str
    date: str
    digest: str


class ApplicationRef(Strict):
    """Which spec a file was made from; the digest is over what the stage reads of it, not over its bytes.

    In a plan, `field_digests` has a short digest of each field that measuring depends on, so that a change can be named.
    """

    path: str
    digest: str
    field_digests: dict[str, str] = Field({})


class Batch(Strict):
    """Machines that were asked for at once, and why."""

    reason: str
    samples: list[Sample]


class Sampling(Strict):
    """The decisions of an adaptive campaign: which machines were asked for, among those of which search box.

    Recorded decisions: later compiles read them here and do not ask again. `limits_digest` is a digest of the limits and the
    objective that were asked for. `stop_reason` says why no further machine was asked for, None while that was not decided;
    `out_of_budget` says that there was one, and not enough money left for it.
    """

    hardware: Hardware
    infra: list[str]
    limits_digest: str
    batches: list[Batch]
    stop_reason: str | None = None
    out_of_budget: bool = False


class Estimate(Strict):
    """What the plan will cost at most, and how long it will take with all samples at once."""

    measuring: Money
    setup: Money
    total: Money
    wall: Duration


class PlanBody(Strict):
    """What the plan says; `hardware` and `infra` are the search box that its samples were picked for, from
    the catalog with the digest `design_catalog`; the spec's own box may have become smaller since, and prices may be new.

    `pins` are the digests of what the spec only names, from the lock.
    """

    application: ApplicationRef
    pins: dict[str, str] = Field({})
    catalog: CatalogRef
    design_catalog: str
    hardware: Hardware
    infra: list[str]
    sampler: Literal["grid", "adaptive", "list"]
    requests: int | None
    duration: Duration
    warmup: int
    setup_timeout: Duration
    budget: Money | None
    estimate: Estimate
    samples: list[Sample]
    substitutes: list[Substitute] = Field([])
    notes: list[str]


class PlanMetadata(Strict):
    """Names the application."""

    name: str


class Plan(Strict):
    """`kind: SamplingPlan`: what `compile` writes before a benchmark and `bench` runs."""

    apiVersion: Literal["fogspec.dev/v1alpha1"] = "fogspec.dev/v1alpha1"
    kind: Literal["SamplingPlan"] = "SamplingPlan"
    metadata: PlanMetadata
    spec: PlanBody


LIFETIME_SLACK_S = 300.0
NO_PINS: Mapping[str, str] = MappingProxyType({})


def make_plan(
    application: Application,
    path: str,
    catalog: Catalog,
    pins: Mapping[str, str] = NO_PINS,
    admissible: Filtered | None = None,
    library: "Library | None" = None,
) -> Plan:
    """The sampling plan of a spec at `path` (as written into the plan), without its tasks.

    Pure: it depends on the values of the spec and the content of the catalog, not on the order of either. Raises
    Infeasible when no machine on offer is admissible, InvalidInput for a listed machine that is not on offer. The
    budget is compared where money would be spent.
    """
    spec = application.spec
    if admissible is None:
        admissible = filter_offers(catalog, spec.hardware, spec.infra)
    found = design.design(spec, catalog, admissible, library)
    samples = [Sample(id=pick.id, machine=pick.machine, reason=pick.reason) for pick in found.picks]
    sampler: Literal["grid", "adaptive", "list"] = "list" if spec.benchmark.machines else spec.benchmark.sampler
    return assemble(application, path, catalog.about, sampler, samples, found.notes, pins)


def assemble(
    application: Application, path: str, about: About, sampler: Literal["grid", "adaptive", "list"],
    samples: Sequence[Sample], notes: Sequence[str], pins: Mapping[str, str] = NO_PINS,
) -> Plan:  # fmt: skip
    """A plan of these samples, with what it costs at most."""
    spec = application.spec
    stop = spec.benchmark.stop
    body = PlanBody(
        application=ApplicationRef(
            path=path,
            digest=fingerprints.planned_digest(application),
            field_digests=fingerprints.measured_fields(application),
        ),
        pins=dict(pins),
        catalog=CatalogRef(source=about.source, revision=about.revision, date=about.date, digest=about.digest),
        design_catalog=about.digest,
        hardware=spec.hardware,
        infra=spec.infra,
        sampler=sampler,
        requests=stop.requests,
        duration=stop.duration,
        warmup=spec.benchmark.warmup,
        setup_timeout=spec.benchmark.setup_timeout,
        budget=spec.benchmark.budget,
        estimate=estimate(samples, stop.duration, spec.benchmark.setup_timeout),
        samples=list(samples),
        notes=[*notes, *_unpinned(application, pins)],
    )
    return Plan(metadata=PlanMetadata(name=application.metadata.name), spec=body)


def _unpinned(application: Application, pins: Mapping[str, str]) -> list[str]:
    image = image_named(application)
    return [] if image is None or "image" in pins else [f"image {image} is not pinned to a digest: fogspec lock"]


def sample_on(machine: Machine, reason: str, nth: int = 1) -> Sample:
    """The `nth` sample that measures this machine; its id depends on the machine and on `nth` alone."""
    return Sample(id=design.sample_id(machine, nth), machine=machine, reason=reason)


def next_on(machine: Machine, reason: str, taken: Collection[str]) -> Sample:
    """The first sample of this machine whose id is not taken."""
    numbered = (sample_on(machine, reason, nth) for nth in itertools.count(1))
    return next(sample for sample in numbered if sample.id not in taken)


def estimate(samples: Sequence[Sample], after_s: float, setup_s: float) -> Estimate:
    """What the samples cost in USD if each measures for `after_s` and none is ready before `setup_s`."""
    usd_per_s = math.fsum(sample.machine.price for sample in samples) / 3600
    measuring, setup = round(usd_per_s * after_s, 6), round(usd_per_s * setup_s, 6)
    return Estimate(measuring=measuring, setup=setup, total=round(measuring + setup, 6), wall=after_s + setup_s)


def digest_without_budget(plan: Plan) -> str:
    """Digest over a plan's content but its budget, which decides whether it is measured and nothing that follows."""
    return digest.of_value(plan.model_dump(mode="json", exclude={"spec": {"budget"}}))


def lifetime_s(after_s: float, setup_s: float) -> float:
    """After how long a sampled machine ends itself though nobody ends it, in whole minutes."""
    return math.ceil((setup_s + after_s + LIFETIME_SLACK_S) / 60) * 60.0
