"""What a bench is about to spend, said before it is spent; and refused where the plan's prices no longer hold."""

from collections.abc import Iterator
from dataclasses import dataclass

from fogspec.backends.protocol import Runner
from fogspec.base import units
from fogspec.base.errors import Refused
from fogspec.base.units import dollars
from fogspec.bench.adaptive import should_resume
from fogspec.bench.prepare import Prepared
from fogspec.catalog.table import Catalog
from fogspec.plan.reuse import price_rises
from fogspec.plan.schema import Sample, lifetime_s

NAMED = 9


@dataclass(frozen=True, slots=True)
class Quote:
    """A bench before it begins. `worst_usd` is what its samples cost if each machine runs until it ends by itself."""

    name: str
    todo: tuple[Sample, ...]
    planned: int
    adaptive: bool
    life_s: float
    wall_usd: float | None
    runner: str
    costs: str

    @classmethod
    def of(cls, prepared: Prepared, runner: Runner, max_usd: float | None) -> "Quote":
        """From the plan, and what was spent of its budget already."""
        body, benchmark = prepared.plan.spec, prepared.application.spec.benchmark
        spent = prepared.results.spec.spent if prepared.results is not None else 0.0
        left = None if benchmark.budget is None else max(benchmark.budget - spent, 0.0)
        sampling = prepared.results.spec.sampling if prepared.results is not None else None
        decided = (
            sampling is not None
            and sampling.stop_reason is not None
            and not should_resume(prepared.application, sampling)
        )
        adaptive = body.sampler == "adaptive" and not prepared.only and not decided
        walls = [one for one in (left, max_usd) if one is not None]
        return cls(
            prepared.layout.name, prepared.todo, len(body.samples), adaptive, lifetime_s(body.duration, body.setup_timeout),
            min(walls, default=None), runner.name, runner.costs,
        )  # fmt: skip

    @property
    def worst_usd(self) -> float:
        """What the samples cost at most, whatever the wall."""
        return sum(self.usd(sample) for sample in self.todo)

    @property
    def asks(self) -> bool:
        """Whether it can cost money."""
        return self.costs == "real" and (bool(self.todo) or self.adaptive)

    def usd(self, sample: Sample) -> float:
        """What one sample costs at most."""
        return sample.machine.price * self.life_s / 3600

    def line(self) -> str:
        """What would be measured, and the most that it may cost."""
        count = f"{self.name}: {len(self.todo)} of {self.planned} samples to measure"
        if self.adaptive:
            count += ", then the machines that the model asks for"
        if self.costs != "real":
            return f"{count} with the {self.runner} runner: costs nothing"
        if self.adaptive:
            return f"{count}: " + ("no budget" if self.wall_usd is None else f"at most {dollars(self.wall_usd)}")
        wall = self.wall_usd is not None and self.wall_usd < self.worst_usd
        most = min(self.worst_usd, self.worst_usd if self.wall_usd is None else self.wall_usd)
        when = ", where it stops" if wall else ", if every machine runs until it ends by itself"
        return f"{count}: at most {dollars(most)}{when if self.todo else ''}"

    def lines(self) -> Iterator[str]:
        """A line a sample."""
        for sample in self.todo:
            machine = sample.machine
            price = (
                f"{units.format_price(machine.price)}, at most {dollars(self.usd(sample))}" if machine.price else "free"
            )
            yield f"  {sample.id}: {machine.infra} {machine.instance}, {price}"


def check_prices(samples: tuple[Sample, ...] | list[Sample], prices: Catalog, again: str) -> None:
    """Raises Refused when a machine has become dearer than the plan says: nobody agreed to that."""
    if rises := price_rises(samples, prices):
        more = [f"and {len(rises) - NAMED} more"] if len(rises) > NAMED else []
        raise Refused(
            "prices have risen since the plan was compiled: nothing was started", *rises[:NAMED], *more,
            f"compile with the prices of today, look at the plan, and measure then: {again}",
        )  # fmt: skip
