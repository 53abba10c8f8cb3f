"""The budget check, and the changes of a spec that make its plan fit with the least loss."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from fogspec.base import units
from fogspec.catalog.filters import Filtered
from fogspec.language.schema import Application, Spec
from fogspec.plan.commitment import room_s
from fogspec.plan.schema import Estimate, Plan, Sample, estimate

OPTIONS = 3
MIN_MEASURING_S = 10.0
MIN_SETUP_S = 30.0
NAMED = 4

# The most that a changed spec may cost in USD, None if it is refused; the fraction that a change loses, its text, that of
# its loss, and the spec with it.
Cost = Callable[[Spec], float | None]
Change = tuple[float, str, str, Spec]


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
    application: Application, plan: Plan, due: CostEstimate, admissible: Filtered, cost: Cost
) -> list[BudgetOption]:
    """Return the `OPTIONS` changes with the least loss, least first: less time, fewer machines, a narrower search space."""
    if (budget := plan.spec.budget) is None:
        return []
    spec = application.spec
    found = [
        BudgetOption(loss, change, total_usd, loses)
        for loss, change, loses, changed in (
            *_less_time(spec, plan, due, budget),
            *_fewer_machines(spec, plan, due, budget),
            *_narrower_space(spec, budget, admissible, cost),
        )
        if (total_usd := cost(changed)) is not None and total_usd <= budget
    ]
    return sorted(found, key=lambda option: (option.loss, option.change))[:OPTIONS]


def ceil_cents(usd: float) -> float:
    """Return the amount rounded up to whole cents."""
    return math.ceil(round(usd * 100, 6)) / 100


def _less_time(spec: Spec, plan: Plan, due: CostEstimate, budget: float) -> Iterator[Change]:
    body, benchmark = plan.spec, spec.benchmark
    usd_per_hour = math.fsum(sample.machine.paid_usd_per_hour for sample in due.todo)
    left_s = room_s((budget - due.spent_usd) * 3600 / usd_per_hour)
    shorter = _round_down(left_s - body.ready_timeout)
    if MIN_MEASURING_S <= shorter < body.duration:
        change = _lower("spec.benchmark.stop.duration", body.duration, shorter)
        stop = benchmark.stop.model_copy(update={"duration": shorter})
        loses = "loses requests of each sample after that"
        yield 1 - shorter / body.duration, change, loses, _with(spec, "benchmark", stop=stop)
    sooner = _round_down(left_s - body.duration)
    if MIN_SETUP_S <= sooner < body.ready_timeout:
        change = _lower("spec.benchmark.ready_timeout", body.ready_timeout, sooner)
        loses = "loses every machine that takes longer to be ready"
        yield 1 - sooner / body.ready_timeout, change, loses, _with(spec, "benchmark", ready_timeout=sooner)


def _with(spec: Spec, part: str, **values: object) -> Spec:
    return spec.model_copy(update={part: getattr(spec, part).model_copy(update=values)})


def _lower(name: str, old_s: float, new_s: float) -> str:
    return f"lower {name} from {units.format_duration(old_s)} to {units.format_duration(new_s)}"


def _round_down(seconds: float) -> float:
    """Round to whole minutes, tens of seconds or seconds, the coarsest that takes off at most a tenth."""
    steps = (step for step in (60, 10, 1) if seconds // step * step >= 0.9 * seconds)
    return float(seconds // (step := next(steps, 1)) * step)


def _fewer_machines(spec: Spec, plan: Plan, due: CostEstimate, budget: float) -> Iterator[Change]:
    """Leave out the most expensive samples, as few as it takes."""
    kept = sorted(due.todo, key=lambda sample: (sample.machine.price, sample.id))
    lost: list[Sample] = []
    body = plan.spec
    while kept and due.spent_usd + estimate(kept, body.commitment).total > budget:
        lost.append(kept.pop())
    if kept:
        machines = [one.machine for one in body.samples if one not in lost]
        names = list(dict.fromkeys(f"local/{one.instance}" if one.is_local else one.instance for one in machines))
        words = f"set spec.benchmark.machines to [{', '.join(names)}], {len(kept)} of {len(due.todo)} machines"
        loses = f"loses {_named([_cell(one) for one in lost])}"
        yield len(lost) / len(due.todo), words, loses, _with(spec, "benchmark", machines=names)


def _cell(sample: Sample) -> str:
    return f"{sample.machine.instance} ({sample.reason})"


def _named(words: Sequence[str]) -> str:
    return "; ".join(words[:NAMED]) + (f"; and {len(words) - NAMED} more" if len(words) > NAMED else "")


def _narrower_space(spec: Spec, budget: float, admissible: Filtered, cost: Cost) -> Iterator[Change]:
    """Lower the limit on vCPUs to the highest that fits, or leave out one GPU type."""
    if spec.benchmark.machines:
        return
    offers, hardware = admissible.offers, spec.hardware
    sizes = sorted(set(offers.vcpus.tolist()))
    fewest = None if hardware.cpus is None else hardware.cpus.low
    low, high = 0, len(sizes) - 1
    best: tuple[float, Spec] | None = None
    while low < high:
        middle = (low + high) // 2
        total_usd = cost(changed := _with(spec, "hardware", cpus=units.Range(fewest, sizes[middle])))
        if total_usd is not None and total_usd <= budget:
            best, low = (sizes[middle], changed), middle + 1
        else:
            high = middle
    if best is not None:
        lost = float((offers.vcpus > best[0]).mean())
        words = f"lower spec.hardware.cpus to at most {units.format_number(best[0])}"
        yield lost, words, f"loses {_percent(lost)} of the candidates, those with more vCPUs", best[1]
    for gpu in hardware.gpus if len(hardware.gpus) > 1 else ():
        lost = float((offers.gpu == ("" if gpu == "none" else gpu.partition(":")[0])).mean())
        what = "machines without a GPU" if gpu == "none" else f"machines with {gpu}"
        others = [one for one in hardware.gpus if one != gpu]
        words, loses = f"take {gpu} out of spec.hardware.gpus", f"loses {_percent(lost)} of the candidates, {what}"
        yield lost, words, loses, _with(spec, "hardware", gpus=others)


def _percent(lost: float) -> str:
    return f"{lost:.0%}" if lost >= 0.01 else "less than 1%"
