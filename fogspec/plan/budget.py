"""The budget check, and the changes of a spec that make its plan fit with the least loss."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from fogspec.base import units
from fogspec.base.errors import Infeasible, InvalidInput
from fogspec.catalog.filters import Filtered
from fogspec.catalog.table import Catalog
from fogspec.plan.commitment import Commitment, room_s
from fogspec.plan.design import make_plan
from fogspec.plan.schema import Estimate, Plan, Sample, estimate
from fogspec.spec.schema import Application, Hardware

OPTIONS = 3
MIN_MEASURING_S = 10.0
MIN_SETUP_S = 30.0
NAMED = 4


@dataclass(frozen=True, slots=True)
class BudgetOption:
    """A change of the spec after which the plan fits, described by `change`, and what it `loses`.

    `loss` is the fraction that is lost: of measuring time, samples, or candidates.
    """

    loss: float
    change: str
    total_usd: float
    loses: str

    def line(self) -> str:
        """Return the option in one line."""
        return f"{self.change}: at most ${ceil_cents(self.total_usd):.2f}; {self.loses}"


@dataclass(frozen=True, slots=True)
class CostEstimate:
    """The maximum cost of a plan in USD: `spent_usd` so far, and the estimate for the samples left `todo`."""

    todo: tuple[Sample, ...]
    spent_usd: float
    estimate: Estimate

    @property
    def total_usd(self) -> float:
        """Return the sum of both."""
        return self.spent_usd + self.estimate.total


def estimate_cost(plan: Plan, done: frozenset[str] = frozenset(), spent_usd: float = 0.0) -> CostEstimate:
    """Return the cost estimate of a plan whose samples `done` are measured, at `spent_usd` so far."""
    todo = tuple(sample for sample in plan.spec.samples if sample.id not in done)
    return CostEstimate(todo, spent_usd, estimate(todo, plan.spec.commitment))


def within_budget(plan: Plan, due: CostEstimate) -> bool:
    """Return whether the plan's budget covers the cost; a plan that is fully measured needs none."""
    return plan.spec.budget is None or due.total_usd <= plan.spec.budget or not due.todo


def cheapest_options(
    application: Application, plan: Plan, due: CostEstimate, admissible: Filtered
) -> list[BudgetOption]:
    """Return the `OPTIONS` changes with the least loss, least first: less time, fewer machines, a narrower search space."""
    if (budget := plan.spec.budget) is None:
        return []
    found = [
        *_less_time(plan, due, budget),
        *_fewer_machines(plan, due, budget),
        *_narrower_space(application, budget, due, admissible),
    ]
    return sorted(found, key=lambda option: (option.loss, option.change))[:OPTIONS]


def ceil_cents(usd: float) -> float:
    """Return the amount rounded up to whole cents."""
    return math.ceil(round(usd * 100, 6)) / 100


def _less_time(plan: Plan, due: CostEstimate, budget: float) -> Iterator[BudgetOption]:
    body = plan.spec
    usd_per_hour = math.fsum(sample.machine.price for sample in due.todo)
    left_s = room_s((budget - due.spent_usd) * 3600 / usd_per_hour)
    shorter = _round_down(left_s - body.setup_timeout)
    if MIN_MEASURING_S <= shorter < body.duration:
        change = _lower("spec.benchmark.stop.duration", body.duration, shorter)
        total_usd = due.spent_usd + Commitment(measuring_s=shorter, setup_s=body.setup_timeout).usd(usd_per_hour)
        yield BudgetOption(1 - shorter / body.duration, change, total_usd, "loses requests of each sample after that")
    sooner = _round_down(left_s - body.duration)
    if MIN_SETUP_S <= sooner < body.setup_timeout:
        change = _lower("spec.benchmark.setup_timeout", body.setup_timeout, sooner)
        total_usd = due.spent_usd + Commitment(measuring_s=body.duration, setup_s=sooner).usd(usd_per_hour)
        loses = "loses every machine that takes longer to be ready"
        yield BudgetOption(1 - sooner / body.setup_timeout, change, total_usd, loses)


def _lower(name: str, old_s: float, new_s: float) -> str:
    return f"lower {name} from {units.format_duration(old_s)} to {units.format_duration(new_s)}"


def _round_down(seconds: float) -> float:
    """Round to whole minutes, tens of seconds or seconds, the coarsest that takes off at most a tenth."""
    steps = (step for step in (60, 10, 1) if seconds // step * step >= 0.9 * seconds)
    return float(seconds // (step := next(steps, 1)) * step)


def _fewer_machines(plan: Plan, due: CostEstimate, budget: float) -> Iterator[BudgetOption]:
    """Leave out the most expensive samples, as few as it takes."""
    kept = sorted(due.todo, key=lambda sample: (sample.machine.price, sample.id))
    lost: list[Sample] = []
    body = plan.spec
    while kept and due.spent_usd + estimate(kept, body.commitment).total > budget:
        lost.append(kept.pop())
    if kept:
        total = due.spent_usd + estimate(kept, body.commitment).total
        words = f"measure {len(kept)} of {len(due.todo)} machines (spec.benchmark.machines)"
        yield BudgetOption(len(lost) / len(due.todo), words, total, f"loses {_named([_cell(one) for one in lost])}")


def _cell(sample: Sample) -> str:
    return f"{sample.machine.instance} ({sample.reason})"


def _named(words: Sequence[str]) -> str:
    return "; ".join(words[:NAMED]) + (f"; and {len(words) - NAMED} more" if len(words) > NAMED else "")


def _narrower_space(
    application: Application, budget: float, due: CostEstimate, admissible: Filtered
) -> Iterator[BudgetOption]:
    """Lower the limit on vCPUs to the highest that fits, or leave out one GPU type."""
    if application.spec.benchmark.machines:
        return
    offers, hardware = admissible.offers, application.spec.hardware
    sizes = sorted(set(offers.vcpus.tolist()))
    low, high = 0, len(sizes) - 1
    best: tuple[float, float] | None = None
    while low < high:
        middle = (low + high) // 2
        total = _total_usd(application, offers, due, _with_cpus(hardware, sizes[middle]))
        if total is not None and total <= budget:
            best, low = (sizes[middle], total), middle + 1
        else:
            high = middle
    if best is not None:
        lost = float((offers.vcpus > best[0]).mean())
        words = f"lower spec.hardware.cpus to at most {units.format_number(best[0])}"
        yield BudgetOption(lost, words, best[1], f"loses {_percent(lost)} of the candidates, those with more vCPUs")
    for gpu in hardware.gpus if len(hardware.gpus) > 1 else ():
        others = [one for one in hardware.gpus if one != gpu]
        total = _total_usd(application, offers, due, hardware.model_copy(update={"gpus": others}))
        if total is not None and total <= budget:
            lost = float((offers.gpu == ("" if gpu == "none" else gpu.partition(":")[0])).mean())
            what = "machines without a GPU" if gpu == "none" else f"machines with {gpu}"
            words = f"take {gpu} out of spec.hardware.gpus"
            yield BudgetOption(lost, words, total, f"loses {_percent(lost)} of the candidates, {what}")


def _with_cpus(hardware: Hardware, high: float) -> Hardware:
    low = None if hardware.cpus is None else hardware.cpus.low
    return hardware.model_copy(update={"cpus": units.Range(low, high)})


def _total_usd(application: Application, offers: Catalog, due: CostEstimate, hardware: Hardware) -> float | None:
    """Return the cost of the plan for this hardware, in USD; None if no machine is left."""
    spec = application.spec.model_copy(update={"hardware": hardware})
    try:
        plan = make_plan(application.model_copy(update={"spec": spec}), "", offers)
    except (Infeasible, InvalidInput):
        return None
    return due.spent_usd + plan.spec.estimate.total


def _percent(lost: float) -> str:
    return f"{lost:.0%}" if lost >= 0.01 else "less than 1%"
