"""The cost of a bench before it begins, and the check that the plan's prices still hold."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from fogspec.backends.protocol import Costs, SampleBackend
from fogspec.backends.skypilot.handed_over import handed_over
from fogspec.base import units
from fogspec.base.errors import Refused
from fogspec.base.units import dollars
from fogspec.bench.prepare import Prepared
from fogspec.catalog.table import Catalog
from fogspec.plan.commitment import Commitment, unattended
from fogspec.plan.reuse import price_rises, selects_more
from fogspec.plan.schema import Sample, estimate

NAMED = 9


@dataclass(frozen=True, slots=True, kw_only=True)
class Quote:
    """The cost of a bench; `cap_usd` is the budget that is left, None without one."""

    name: str
    todo: tuple[Sample, ...]
    planned: int
    adaptive: bool
    commitment: Commitment
    cap_usd: float | None
    runner: str
    costs: Costs
    once_more: bool = False
    beyond_plan: bool = False

    @classmethod
    def of(cls, prepared: Prepared, backend: SampleBackend, max_usd: float | None, once_more: bool = False) -> "Quote":
        """Return the quote of the plan, with what is left of its budget; `once_more` is for the chosen machine alone."""
        body, benchmark = prepared.plan.spec, prepared.application.spec.benchmark
        spent = prepared.spent_usd.get(backend.name, 0.0)
        left = None if benchmark.budget is None else max(benchmark.budget - spent, 0.0)
        sampling = prepared.results.spec.sampling if prepared.results is not None else None
        adaptive = not prepared.only and selects_more(prepared.application, body.sampler, sampling)
        caps = [one for one in (left, max_usd) if one is not None]
        return cls(
            name=prepared.layout.name,
            todo=prepared.todo,
            planned=len(body.samples),
            adaptive=adaptive,
            commitment=body.commitment,
            cap_usd=min(caps, default=None),
            runner=backend.name,
            costs=backend.costs,
            once_more=once_more,
            beyond_plan=not {one.id for one in prepared.todo} <= {one.id for one in body.samples},
        )

    @property
    def worst_usd(self) -> float:
        """The cost of the samples if each machine is paid for its longest time, without the cap."""
        return estimate(self.todo, self.commitment).total

    @property
    def most_usd(self) -> float | None:
        """The most that it can cost; None if the model selects further machines without a budget."""
        return most_usd(self.worst_usd, self.cap_usd, self.adaptive)

    @property
    def needs_consent(self) -> bool:
        """Whether it can cost real money."""
        return self.costs is Costs.REAL and (bool(self.todo) or self.adaptive)

    def usd(self, sample: Sample) -> float:
        """Return the most that one sample can cost."""
        return self.commitment.usd(sample.machine)

    def spent_line(self, prepared: Prepared) -> str | None:
        """Return what is spent of the budget already; None if it is nothing, or no money."""
        spent, budget = prepared.spent_usd.get(self.runner, 0.0), prepared.application.spec.benchmark.budget
        if self.costs is not Costs.REAL or not spent or budget is None:
            return None
        return f"{dollars(spent)} of the budget of {dollars(budget)} is spent; spec.benchmark.budget allows more"

    def line(self) -> str:
        """Return one line: the samples to measure, and the most that they can cost."""
        count = f"{self.name}: {len(self.todo)} of {self.planned} samples to measure"
        if self.beyond_plan:
            count = f"{self.name}: a sample of {', '.join(one.machine.instance for one in self.todo)} besides the plan"
        if self.once_more:
            count = f"{self.name}: {', '.join(one.machine.instance for one in self.todo)} to measure once more"
        if self.adaptive:
            count += ", then the machines that the model selects"
        if self.costs is not Costs.REAL:
            return f"{count} with the {self.runner} runner: costs nothing"
        if (most := self.most_usd) is None:
            return f"{count}: no budget"
        if self.adaptive or not self.todo:
            return f"{count}: at most {dollars(most)}"
        when = ", where it stops" if most < self.worst_usd else ", if every machine runs until it ends by itself"
        return f"{count}: at most {dollars(most)}{when}"

    def together(self, at_once: int) -> Iterator[str]:
        """Yield the highest price of the machines that run at the same time, if they cost money, and the longest time."""
        prices = sorted((sample.machine.paid_usd_per_hour for sample in self.todo), reverse=True)[:at_once]
        if self.costs is Costs.REAL and prices:
            most_s = math.ceil(len(self.todo) / len(prices)) * self.commitment.paid_s
            price, time = units.shown_price(sum(prices)), units.shown_duration(most_s)
            together = (f"{len(prices)} machines at once", f"{price} together")
            machines, most = together if len(prices) > 1 else ("1 machine at a time", price)
            yield f"{machines}: at most {most}, for {time} at most"

    def unattended(self) -> Iterator[str]:
        """Yield what happens to machines that cost money if this computer goes off while they start, and what they get."""
        if self.costs is Costs.REAL:
            yield from unattended((sample.machine for sample in self.todo), self.commitment, self.name)
            yield from handed_over(sample.machine.infra for sample in self.todo)

    def lines(self) -> Iterator[str]:
        """Yield a line per sample."""
        for sample in self.todo:
            machine = sample.machine
            price = f"{machine.price_words}, at most {dollars(self.usd(sample))}" if machine.price else "free"
            yield f"  {sample.id}: {machine.infra} {machine.instance}, {price}"


def most_usd(worst_usd: float, cap_usd: float | None, adaptive: bool) -> float | None:
    """Return the most that a bench can cost, from its samples' cost and what is left of the budget.

    An adaptive bench may spend all that is left; None without a budget.
    """
    if adaptive:
        return cap_usd
    return worst_usd if cap_usd is None else min(worst_usd, cap_usd)


def check_prices(samples: tuple[Sample, ...] | list[Sample], prices: Catalog, again: str) -> None:
    """Raise Refused if a machine has become more expensive than in the plan that was approved."""
    if rises := price_rises(samples, prices):
        more = [f"and {len(rises) - NAMED} more"] if len(rises) > NAMED else []
        raise Refused(
            "prices have risen since the plan was compiled: nothing was started",
            *rises[:NAMED],
            *more,
            f"compile with the prices of today, look at the plan, and measure then: {again}",
        )
