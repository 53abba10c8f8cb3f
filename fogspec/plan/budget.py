"""Whether a plan fits its budget, and if not, the ways of making it fit that lose least."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from fogspec.base import units
from fogspec.base.errors import Infeasible, InvalidInput
from fogspec.catalog.filters import Filtered
from fogspec.catalog.table import Catalog
from fogspec.plan.schema import Estimate, Plan, Sample, estimate, make_plan
from fogspec.spec.schema import Application

WAYS = 3
LEAST_MEASURING_S = 10.0
NAMED = 4


@dataclass(frozen=True, slots=True)
class BudgetOption:
    """A change of the spec after which the plan fits.

    `loss` is what is given up as a share of what there was: measuring time, samples, or candidates. `words` say the
    change, `loses` what is given up.
    """

    loss: float
    words: str
    total_usd: float
    loses: str

    def line(self) -> str:
        """The way in one line."""
        return f"{self.words}: at most ${ceil_cents(self.total_usd):.2f}; {self.loses}"


@dataclass(frozen=True, slots=True)
class CostEstimate:
    """What a plan may still cost in USD: `todo` are the samples that are not measured yet, `spent_usd` what is gone."""

    todo: tuple[Sample, ...]
    spent_usd: float
    estimate: Estimate

    @property
    def total_usd(self) -> float:
        """All of it."""
        return self.spent_usd + self.estimate.total


def estimate_cost(plan: Plan, done: frozenset[str] = frozenset(), spent_usd: float = 0.0) -> CostEstimate:
    """The bill of a plan of which the samples `done` are measured, at `spent_usd` so far."""
    todo = tuple(sample for sample in plan.spec.samples if sample.id not in done)
    return CostEstimate(todo, spent_usd, estimate(todo, plan.spec.duration, plan.spec.setup_timeout))


def within_budget(plan: Plan, due: CostEstimate) -> bool:
    """Whether the bill is within the plan's budget; what is measured already needs none."""
    return plan.spec.budget is None or due.total_usd <= plan.spec.budget or not due.todo


def cheapest_options(
    application: Application, plan: Plan, due: CostEstimate, admissible: Filtered
) -> list[BudgetOption]:
    """The `WAYS` changes with the least loss, least first, among: less time, fewer machines, a smaller box."""
    found = [*_less_time(plan, due), *_fewer_machines(plan, due), *_smaller_box(application, plan, due, admissible)]
    return sorted(found, key=lambda way: (way.loss, way.words))[:WAYS]


def ceil_cents(usd: float) -> float:
    """Rounded up to whole cents."""
    return math.ceil(round(usd * 100, 6)) / 100


def _less_time(plan: Plan, due: CostEstimate) -> Iterator[BudgetOption]:
    body = plan.spec
    usd_per_s = math.fsum(sample.machine.price for sample in due.todo) / 3600
    left_s = ((body.budget or 0.0) - due.spent_usd) / usd_per_s
    for name, old, other, least, loses in (
        (
            "spec.benchmark.stop.duration",
            body.duration,
            body.setup_timeout,
            LEAST_MEASURING_S,
            "requests of each sample after that",
        ),
        (
            "spec.benchmark.setup_timeout",
            body.setup_timeout,
            body.duration,
            30.0,
            "every machine that takes longer to be ready",
        ),
    ):
        new = _round_down(left_s - other)
        if least <= new < old:
            words = f"lower {name} from {units.format_duration(old)} to {units.format_duration(new)}"
            yield BudgetOption(1 - new / old, words, due.spent_usd + usd_per_s * (new + other), f"loses {loses}")


def _round_down(seconds: float) -> float:
    """To whole minutes, tens of seconds or seconds, whichever takes off at most a tenth."""
    steps = (step for step in (60, 10, 1) if seconds > 0 and seconds // step * step >= 0.9 * seconds)
    return float(seconds // (step := next(steps, 1)) * step)


def _fewer_machines(plan: Plan, due: CostEstimate) -> Iterator[BudgetOption]:
    """Leave out the dearest samples, as few as it takes."""
    kept = sorted(due.todo, key=lambda sample: (sample.machine.price, sample.id))
    lost: list[Sample] = []
    body = plan.spec
    while kept and due.spent_usd + estimate(kept, body.duration, body.setup_timeout).total > (body.budget or 0.0):
        lost.append(kept.pop())
    if kept:
        total = due.spent_usd + estimate(kept, body.duration, body.setup_timeout).total
        words = f"measure {len(kept)} of {len(due.todo)} machines (spec.benchmark.machines)"
        yield BudgetOption(len(lost) / len(due.todo), words, total, f"loses {_named([_cell(one) for one in lost])}")


def _cell(sample: Sample) -> str:
    return f"{sample.machine.instance} ({sample.reason})"


def _named(words: Sequence[str]) -> str:
    return "; ".join(words[:NAMED]) + (f"; and {len(words) - NAMED} more" if len(words) > NAMED else "")


def _smaller_box(
    application: Application, plan: Plan, due: CostEstimate, admissible: Filtered
) -> Iterator[BudgetOption]:
    """A lower limit on vCPUs, the highest that fits; or one GPU type less."""
    if application.spec.benchmark.machines:
        return
    offers = admissible.offers
    sizes = sorted(set(offers.vcpus.tolist()))
    low, high = 0, len(sizes) - 1
    best: tuple[float, float] | None = None
    while low < high:
        middle = (low + high) // 2
        total = _replanned(application, offers, due, cpus=units.Range(None, sizes[middle]))
        if total is not None and total <= (plan.spec.budget or 0.0):
            best, low = (sizes[middle], total), middle + 1
        else:
            high = middle
    if best is not None:
        lost = float((offers.vcpus > best[0]).mean())
        words = f"lower spec.hardware.cpus to at most {units.format_number(best[0])}"
        yield BudgetOption(lost, words, best[1], f"loses {_share(lost)} of the candidates, those with more vCPUs")
    for gpu in application.spec.hardware.gpus if len(application.spec.hardware.gpus) > 1 else ():
        others = [one for one in application.spec.hardware.gpus if one != gpu]
        total = _replanned(application, offers, due, gpus=others)
        if total is not None and total <= (plan.spec.budget or 0.0):
            lost = float((offers.gpu == ("" if gpu == "none" else gpu.partition(":")[0])).mean())
            what = "machines without a GPU" if gpu == "none" else f"machines with {gpu}"
            words = f"take {gpu} out of spec.hardware.gpus"
            yield BudgetOption(lost, words, total, f"loses {_share(lost)} of the candidates, {what}")


def _replanned(application: Application, offers: Catalog, due: CostEstimate, **hardware: object) -> float | None:
    """What the plan costs with other hardware, in USD; None when nothing is left."""
    narrowed = application.spec.hardware
    if (cpus := hardware.get("cpus")) is not None and narrowed.cpus is not None:
        assert isinstance(cpus, units.Range)
        hardware["cpus"] = units.Range(narrowed.cpus.low, cpus.high)
    spec = application.spec.model_copy(update={"hardware": narrowed.model_copy(update=hardware)})
    try:
        plan = make_plan(application.model_copy(update={"spec": spec}), "", offers)
    except (Infeasible, InvalidInput):
        return None
    return due.spent_usd + plan.spec.estimate.total


def _share(lost: float) -> str:
    return f"{lost:.0%}" if lost >= 0.01 else "less than 1%"
