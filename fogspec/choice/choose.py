"""The choice: limits met with the asked probability over every admissible offer, then the weighed sum.

"None" is an answer that says why (ADR 0005, ADR 0021).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fogspec.catalog.cost import Costs
from fogspec.catalog.table import Catalog, Floats
from fogspec.model.predict import Predictions, PredictionSet
from fogspec.numerics import select
from fogspec.numerics.frontier import pareto
from fogspec.numerics.select import Mask, Miss, Scale
from fogspec.spec.schema import Application

LIKELY = 0.5
MOST_CERTAIN = 0.999


@dataclass(frozen=True)
class Choice:
    """Every admissible offer with what it is predicted to do, and the rows that stand out; None when nothing meets.

    `values` and `bounds` have an entry for each limit; `within_s` is the latency that all limits on latency, rate and
    cost leave each offer; `eligible` are the offers that can be predicted at all. `feasible` offers meet all limits with
    probability `floor` at least: the asked confidence, or `LIKELY` where no offer reaches it, or None where nothing can be
    said of probabilities. `x` is what alpha weighs: the latency, or a metric. `pool` is what was chosen from; `exhaustive` is
    the best of it, which `chosen` is too unless the spec asks for the relaxed method.
    """

    offers: Catalog
    latency: Predictions
    metrics: Mapping[str, Predictions]
    x: Floats
    cost_usd_per_request: Floats
    costs: Costs
    values: Mapping[str, Floats]
    bounds: Mapping[str, float]
    within_s: Floats
    eligible: Mask
    feasible: Mask
    pool: Mask
    floor: float | None
    confidence: float
    scale: Scale
    objective: Floats
    chosen: int | None
    exhaustive: int | None
    cheapest: int | None
    fastest: int | None

    @property
    def sure(self) -> bool:
        """Whether the choice reaches the asked confidence."""
        return self.chosen is not None and self.floor == self.confidence

    @cached_property
    def front(self) -> NDArray[np.intp]:
        """Rows that no other beats in both x and cost per request, among the feasible, else among all."""
        return self._undominated(self.cost_usd_per_request)

    @cached_property
    def hourly_front(self) -> NDArray[np.intp]:
        """The same with the price of an hour, as the paper draws it."""
        return self._undominated(self.offers.price_usd_per_hour)

    def _undominated(self, column: Floats) -> NDArray[np.intp]:
        rows = np.flatnonzero(self.feasible if self.feasible.any() else self.eligible)
        return np.asarray(rows[pareto(column[rows], self.x[rows])])

    @cached_property
    def misses(self) -> tuple[Miss, ...]:
        """For each limit how far it would have to be relaxed; none while some machine meets them all."""
        if self.feasible.any():
            return ()
        return select.misses(self.needs(levels(self.confidence)[-1]), self.bounds, self.eligible)

    @cached_property
    def nearest(self) -> int | None:
        """The machine that comes nearest to the limits where none meets them all."""
        if self.feasible.any():
            return None
        return select.nearest(self.needs(levels(self.confidence)[-1]), self.bounds, self.eligible)

    def needs(self, floor: float | None) -> Mapping[str, Floats]:
        """What each limit would have to be for each offer to meet it with this probability; the values without one.

        Limits on latency, rate and cost are also asked for what limits on metrics leave of the probability, where they
        leave enough.
        """
        if floor is None or self.latency.posterior is None:
            return self.values
        latency = self._latency_needs(floor)
        found = {"latency": latency, "rate": latency, "cost": self.costs.per_request(latency)}
        for name, one in self.metrics.items():
            if one.posterior is not None:
                found[f"metrics.{name}"] = np.maximum(one.posterior.quantile(floor)[one.of], one.value)
        return {name: found.get(name, values) for name, values in self.values.items()}

    @property
    def latency_needs(self) -> Floats:
        """What a limit on latency would have to be for each offer to meet it with the least probability asked for."""
        return self._latency_needs(levels(self.confidence)[-1])

    def _latency_needs(self, floor: float) -> Floats:
        if self.latency.posterior is None:
            return self.latency.value
        rest = _of_metrics(self.metrics, self.bounds)
        asked = floor if rest is None else np.where(rest > floor, floor / np.maximum(rest, floor), floor)
        return np.asarray(np.maximum(self.latency.posterior.quantile(asked)[self.latency.of], self.latency.value))

    def probability(self, row: int) -> float | None:
        """Probability that one offer meets every limit, latency and metrics taken as independent; None if unknown.

        Where something is limited no model is certain: at most `MOST_CERTAIN` is said.
        """
        if not self.eligible[row]:
            return 0.0
        found = self._probability(row)
        return found if found is None or not self.bounds else min(found, MOST_CERTAIN)

    def _probability(self, row: int) -> float | None:
        found = self.latency.probability_below(row, float(self.within_s[row]))
        for name, predictions in self.metrics.items():
            if found is not None and (bound := self.bounds.get(f"metrics.{name}")) is not None:
                own = predictions.probability_below(row, bound)
                found = None if own is None else found * own
        return found

    @cached_property
    def likeliest(self) -> int | None:
        """The offer that most probably meets every limit; None where that cannot be said."""
        if self.latency.posterior is None or not self.eligible.any():
            return None
        types = self.latency.of
        most = np.zeros(len(self.latency.posterior.machines))
        np.maximum.at(most, types[self.eligible], self.within_s[self.eligible])
        met = self.latency.posterior.probability_below(most)
        of_metrics = _of_metrics(self.metrics, self.bounds)
        if of_metrics is not None:
            met = met * of_metrics
        rows = np.flatnonzero(self.eligible & (self.within_s >= most[types]))
        return int(rows[np.argmax(met[types[rows]])])


def choose(application: Application, predicted: PredictionSet) -> Choice:
    """The choice under the application's limits and objective (the paper, section 2.E, made exhaustive)."""
    spec, offers = application.spec, predicted.offers
    latency = predicted.targets["latency"]
    metrics = {name: one for name, one in predicted.targets.items() if name != "latency"}
    x = metrics[spec.objective.metric].value if spec.objective.metric else latency.value
    costs = Costs.of(spec, offers.price_usd_per_hour, offers.spot)
    cost = costs.per_request(latency.value)
    values, bounds = _limits(application, offers, latency, metrics, cost)
    within_s = latency_budget(application, costs)
    eligible = np.isfinite(x) & np.isfinite(latency.value) & ~latency.unfit
    held = eligible.copy()
    for name, bound in bounds.items():
        held &= values[name] <= bound
    confidence = spec.constraints.confidence
    feasible, floor = _feasible(held, latency, metrics, bounds, within_s, confidence)
    scale = scales(application, x, cost, eligible)
    objective = np.where(eligible, select.weighed(x, cost, spec.objective.alpha, scale), np.inf)
    measured = feasible & latency.measured
    pool = measured if spec.benchmark.sampler == "adaptive" and measured.any() else feasible
    first = _First(cost, latency.value, offers.instance, pool)
    best = first.by(objective)
    return Choice(
        offers, latency, metrics, x, cost, costs, values, bounds, within_s, eligible, feasible, pool, floor, confidence,
        scale, objective, chosen=best, exhaustive=best, cheapest=first.by(cost), fastest=first.by(latency.value),
    )  # fmt: skip


def _feasible(
    held: Mask, latency: Predictions, metrics: Mapping[str, Predictions], bounds: Mapping[str, float], within_s: Floats,
    confidence: float,
) -> tuple[Mask, float | None]:  # fmt: skip
    """Offers that meet all limits with the confidence, else those more likely to meet them than not."""
    if latency.posterior is None:
        return held, None
    if not bounds:
        return held, confidence
    for floor in levels(confidence):
        enough = required_latency(latency, metrics, bounds, floor)
        sure = held & (enough <= within_s)
        if sure.any():
            return sure, floor
    return sure, None


def levels(confidence: float) -> tuple[float, float]:
    """The probabilities of meeting the limits that are asked for, one after the other."""
    return confidence, min(confidence, LIKELY)


def required_latency(
    latency: Predictions, metrics: Mapping[str, Predictions], bounds: Mapping[str, float], floor: float
) -> Floats:
    """The latency in seconds (n,) that each offer must be allowed to meet all limits with this probability.

    An offer meets them if and only if its limits leave it so much. Raises ValueError without a posterior.
    """
    if latency.posterior is None:
        raise ValueError("without a posterior there are no probabilities")
    of_metrics = _of_metrics(metrics, bounds)
    if of_metrics is None:
        return np.asarray(latency.posterior.quantile(floor)[latency.of])
    asked = floor / np.maximum(of_metrics, 1e-12)
    enough = np.where(asked < 1, latency.posterior.quantile(np.minimum(asked, 1 - 1e-12)), np.inf)
    return np.asarray(enough[latency.of])


def _of_metrics(metrics: Mapping[str, Predictions], bounds: Mapping[str, float]) -> Floats | None:
    """Probability of each type to meet the limits on metrics; None without such a limit."""
    found: Floats | None = None
    for name, predictions in metrics.items():
        bound = bounds.get(f"metrics.{name}")
        if bound is not None and predictions.posterior is not None:
            own = predictions.posterior.probability_below(bound)
            found = own if found is None else found * own
    return found


@dataclass(frozen=True, slots=True)
class _First:
    """The best row among some by a column."""

    cost: Floats
    latency_s: Floats
    names: NDArray[np.object_]
    among: Mask

    def by(self, column: Floats) -> int | None:
        return select.first_by(column, self.cost, self.latency_s, self.names, self.among)


def _limits(
    application: Application, offers: Catalog, latency: Predictions, metrics: Mapping[str, Predictions], cost: Floats
) -> tuple[dict[str, Floats], dict[str, float]]:
    """Upper bounds by name, and the values that they bound; the network's allowance is taken off the latency."""
    constraints, objective = application.spec.constraints, application.spec.objective
    limits: list[tuple[str, Floats, float | None]] = [
        ("latency", latency.value, latency_limit_s(application)),
        ("cost", cost, constraints.cost),
        ("price", offers.price_usd_per_hour, constraints.price),
    ]
    if objective.billing == "provisioned" and objective.rate:
        limits.append(("rate", latency.value, 1 / objective.rate))
    limits += [(f"metrics.{name}", metrics[name].value, bound) for name, bound in sorted(constraints.metrics.items())]
    bounded = [(name, values, bound) for name, values, bound in limits if bound is not None]
    return {name: values for name, values, _ in bounded}, {name: bound for name, _, bound in bounded}


def latency_budget(application: Application, costs: Costs) -> Floats:
    """The largest latency of each offer that keeps the limits on latency, rate, cost and price."""
    constraints, objective = application.spec.constraints, application.spec.objective
    found = np.full(len(costs.price_usd_per_hour), np.inf)
    if (limit := latency_limit_s(application)) is not None:
        found = np.minimum(found, limit)
    if objective.billing == "provisioned" and objective.rate:
        found = np.minimum(found, 1 / objective.rate)
    if constraints.cost is not None:
        found = np.minimum(found, costs.latency_within(constraints.cost))
    if constraints.price is not None:
        found[costs.price_usd_per_hour > constraints.price] = 0.0
    return found


def latency_limit_s(application: Application) -> float | None:
    """What is left of the latency limit for the machine, once the network's allowance is taken off."""
    constraints = application.spec.constraints
    return None if constraints.latency is None else constraints.latency - constraints.network_allowance


def scales(application: Application, x: Floats, cost: Floats, eligible: Mask) -> Scale:
    """What x and cost are divided by: the spec's scale, else its limit, else the best attainable (ADR 0004)."""
    spec = application.spec
    given, metric = spec.objective.scale, spec.objective.metric
    of_x = (
        (given.metric or spec.constraints.metrics.get(metric))
        if metric
        else (given.latency or latency_limit_s(application))
    )
    of_cost = given.cost or spec.constraints.cost
    return Scale(of_x or select.best_attainable(x, eligible), of_cost or select.best_attainable(cost, eligible))
