"""The rule of the choice over arrays of machines: objective, limits, confidence, tie-breaks and the value of a sample.

Every part of fogspec that chooses calls this module: compile, menu, explain, report, the adaptive sampler, the relaxed method
and the evaluation. The report's page repeats `Selection` in JavaScript (ADR 0090).

The objective is alpha * metric / scale.metric + (1 - alpha) * cost / scale.cost (the paper, section 2.E); the metric is the
latency or a metric of the application.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fogspec.catalog.cost import Costs
from fogspec.catalog.table import Catalog
from fogspec.model.predict import Predictions
from fogspec.numerics.acquisition import MORE_LIKELY_THAN_NOT
from fogspec.numerics.pareto import pareto
from fogspec.numerics.surrogate import Posterior
from fogspec.spec.schema import Application

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]

TIE = 1e-9  # relative: smaller differences depend on the processor
MOST_CERTAIN = 0.999
UPPER = 0.95  # upper end of the 90% interval
SHORTEST_S, LONGEST_S, HALVINGS = 1e-9, 1e9, 80  # of the search for a latency, by its logarithm


@dataclass(frozen=True, slots=True)
class Scale:
    """Divisors of the metric and the cost in the objective; both positive."""

    metric: float
    cost: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """Objective and limits over n machines.

    `costs` and `names` (n,) describe the machines; `metric` is the name of the objective's metric, None for the latency. A
    scale that is None is the limit on the same quantity, else its best attainable value (ADR 0004). `max_latency_s` is the
    limit without the network's allowance, `units` are those of metrics, for people. With `measured_first`, a machine that was
    not measured is chosen only if no measured one qualifies. Raise ValueError for an alpha outside of 0 to 1 and scales that
    are not positive.
    """

    costs: Costs
    names: NDArray[np.object_]
    alpha: float
    confidence: float
    metric: str | None = None
    metric_scale: float | None = None
    cost_scale: float | None = None
    max_latency_s: float | None = None
    max_cost_usd: float | None = None
    max_price_usd_per_hour: float | None = None
    max_metrics: Mapping[str, float] = field(default_factory=dict)
    measured_first: bool = False
    units: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not 0 <= self.alpha <= 1:
            raise ValueError(f"alpha lies between 0 and 1, got {self.alpha}")
        if not all(scale is None or scale > 0 for scale in (self.metric_scale, self.cost_scale)):
            raise ValueError("scales must be positive")

    @classmethod
    def of(cls, application: Application, offers: Catalog) -> "Rule":
        """Return the rule of a spec over these offers."""
        spec = application.spec
        objective, constraints = spec.objective, spec.constraints
        return cls(
            costs=Costs.of(spec, offers.price_usd_per_hour, offers.spot),
            names=offers.instance,
            alpha=objective.alpha,
            confidence=constraints.confidence,
            metric=objective.metric,
            metric_scale=objective.scale.metric if objective.metric else objective.scale.latency,
            cost_scale=objective.scale.cost,
            max_latency_s=latency_limit_s(application),
            max_cost_usd=constraints.cost,
            max_price_usd_per_hour=constraints.price,
            max_metrics=constraints.metrics,
            measured_first=spec.benchmark.is_adaptive and spec.benchmark.volume is None,
            units={name: one.unit for name, one in spec.metrics.items() if one.unit},
        )

    def take(self, rows: Rows) -> "Rule":
        """Return the rule over some of the machines."""
        costs = self.costs
        return replace(
            self,
            costs=replace(costs, price_usd_per_hour=costs.price_usd_per_hour[rows], spot=costs.spot[rows]),
            names=self.names[rows],
        )

    @property
    def bounds(self) -> dict[str, float]:
        """Upper bounds by name of the limit."""
        rate = self.costs.requests_per_s
        limits = {
            "latency": self.max_latency_s,
            "cost": self.max_cost_usd,
            "price": self.max_price_usd_per_hour,
            "rate": 1 / rate if rate else None,
            **{f"metrics.{name}": bound for name, bound in sorted(self.max_metrics.items())},
        }
        return {name: bound for name, bound in limits.items() if bound is not None}

    def unit_of(self, limit: str) -> str:
        """Return the unit of a limit on a metric; empty for other limits, whose values are written with theirs."""
        return self.units.get(limit.removeprefix("metrics."), "") if limit.startswith("metrics.") else ""

    def limited(self, latency_s: Floats, metrics: Mapping[str, Floats]) -> dict[str, Floats]:
        """Return the quantity that each limit bounds, by name of the limit."""
        found = {
            "latency": latency_s,
            "cost": self.costs.per_request(latency_s),
            "price": self.costs.price_usd_per_hour,
            "rate": latency_s,
            **{f"metrics.{name}": values for name, values in metrics.items()},
        }
        return {name: found[name] for name in self.bounds}

    @property
    def latency_budget_s(self) -> Floats:
        """The largest latency (n,) that keeps the limits on latency, rate, cost and price; 0 where none does."""
        found = np.full(len(self.names), np.inf)
        if self.max_latency_s is not None:
            found = np.minimum(found, self.max_latency_s)
        if self.costs.requests_per_s:
            found = np.minimum(found, 1 / self.costs.requests_per_s)
        if self.max_cost_usd is not None:
            found = np.minimum(found, self.costs.latency_within(self.max_cost_usd))
        if self.max_price_usd_per_hour is not None:
            found[self.costs.price_usd_per_hour > self.max_price_usd_per_hour] = 0.0
        return found

    @property
    def levels(self) -> tuple[float, float]:
        """The probabilities of meeting the limits that are required, one after the other."""
        return self.confidence, min(self.confidence, MORE_LIKELY_THAN_NOT)

    def objective(self, metric_value: Floats, cost: Floats, scale: Scale) -> Floats:
        """Return the objective, dimensionless; smaller is better."""
        return self.alpha * metric_value / scale.metric + (1 - self.alpha) * cost / scale.cost

    def value(self, latency_s: Floats, scale: Scale) -> Floats:
        """Return the objective at these latencies; for rules without a metric of the application."""
        return self.objective(latency_s, self.costs.per_request(latency_s), scale)

    def scale(self, metric_value: Floats, cost: Floats, eligible: Mask) -> Scale:
        """Return the spec's scales, else its limits, else the best attainable values among eligible machines."""
        limit = self.max_metrics.get(self.metric) if self.metric else self.max_latency_s
        of_metric, of_cost = self.metric_scale or limit, self.cost_scale or self.max_cost_usd
        return Scale(of_metric or best_attainable(metric_value, eligible), of_cost or best_attainable(cost, eligible))


def latency_limit_s(application: Application) -> float | None:
    """Return the latency limit without the network's allowance; None without a limit."""
    constraints = application.spec.constraints
    return None if constraints.latency is None else constraints.latency - constraints.network_allowance


def best_attainable(values: Floats, eligible: Mask) -> float:
    """Return the smallest positive finite value among eligible machines; 1 if there is none.

    An irrelevant machine never changes the choice, as it would with min-max scaling: only the best value counts.
    """
    usable = values[eligible & np.isfinite(values) & (values > 0)]
    return float(usable.min()) if len(usable) else 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Violation:
    """One limit while no machine meets them all.

    `row` is the machine with the smallest value among those that meet all other limits (`alone`), else among all; `factor` is
    its value over the bound: how far the limit must be relaxed.
    """

    limit: str
    bound: float
    row: int
    value: float
    factor: float
    alone: bool


@dataclass(frozen=True, kw_only=True)
class Selection:
    """The rule applied to predictions of n machines.

    Latency, rate and cost are limits on latency: one quantile of its distribution is compared with the smallest of them.
    Limits on metrics multiply in; metrics are taken as independent of the latency. Without a posterior the predicted values
    alone must meet the limits.
    """

    rule: Rule
    latency: Predictions
    metrics: Mapping[str, Predictions] = field(default_factory=dict)

    @property
    def bounds(self) -> Mapping[str, float]:
        """Upper bounds by name of the limit."""
        return self.rule.bounds

    @property
    def confidence(self) -> float:
        """The probability with which the limits must be met."""
        return self.rule.confidence

    @property
    def metric_value(self) -> Floats:
        """Predicted values (n,) of the objective's metric: latency in seconds unless the spec names another."""
        return self.metrics[self.rule.metric].value if self.rule.metric else self.latency.value

    @cached_property
    def cost_usd_per_request(self) -> Floats:
        """Cost of one request (n,) at the predicted latency."""
        return self.rule.costs.per_request(self.latency.value)

    @cached_property
    def values(self) -> Mapping[str, Floats]:
        """Predicted values (n,) by name of the limit that bounds them."""
        return self.rule.limited(self.latency.value, {name: one.value for name, one in self.metrics.items()})

    @cached_property
    def latency_budget_s(self) -> Floats:
        """The latency (n,) that the limits on latency, rate, cost and price leave each machine."""
        return self.rule.latency_budget_s

    @cached_property
    def eligible(self) -> Mask:
        """Machines (n,) that can be predicted and did not fail."""
        return np.isfinite(self.metric_value) & np.isfinite(self.latency.value) & ~self.latency.unfit

    @cached_property
    def satisfied(self) -> Mask:
        """Eligible machines (n,) whose predicted values meet every limit."""
        found = self.eligible.copy()
        for name, bound in self.bounds.items():
            found &= self.values[name] <= bound
        return found

    @cached_property
    def _feasible(self) -> tuple[Mask, float | None]:
        if self.latency.posterior is None:
            return self.satisfied, None
        if not self.bounds:
            return self.satisfied, self.confidence
        found = self.satisfied
        for level in self.rule.levels:
            found = self.satisfied & (self.required_latency_s(level) <= self.latency_budget_s)
            if found.any():
                return found, level
        return found, None

    @property
    def feasible(self) -> Mask:
        """Machines (n,) that meet all limits with probability `level` at least."""
        return self._feasible[0]

    @property
    def level(self) -> float | None:
        """The highest required probability that some machine reaches; None if none does or without a posterior."""
        return self._feasible[1]

    @cached_property
    def candidates(self) -> Mask:
        """Feasible machines (n,) among which the best is chosen."""
        measured = self.feasible & self.latency.measured
        return measured if self.rule.measured_first and measured.any() else self.feasible

    @cached_property
    def scale(self) -> Scale:
        """The divisors in the objective."""
        return self.rule.scale(self.metric_value, self.cost_usd_per_request, self.eligible)

    @cached_property
    def objective(self) -> Floats:
        """The objective (n,), infinite for machines that are not eligible."""
        value = self.rule.objective(self.metric_value, self.cost_usd_per_request, self.scale)
        return np.where(self.eligible, value, np.inf)

    def usd_per_request(self) -> float | None:
        """Return what the chosen machine's objective is worth in USD; None where cost has no weight.

        Objectives that differ by cost alone differ by this money. Without a choice it is that of one to come.
        """
        if self.rule.alpha == 1:
            return None
        value = self._value_to_come if self.best is None else float(self.objective[self.best])
        return value * self.scale.cost / (1 - self.rule.alpha) if np.isfinite(value) else None

    @property
    def _value_to_come(self) -> float:
        """The objective of a choice to come while there is none: of the machine of the most probability over objective.

        A machine that meets the limits has at most the latency that they leave it.
        """
        met = self._probability_met
        if met is None or not met.any():
            return float(np.min(self.objective))
        latency_s = np.minimum(self.latency.value, self.latency_budget_s)
        metric = self.metric_value if self.rule.metric else latency_s
        value = self.rule.objective(metric, self.rule.costs.per_request(latency_s), self.scale)
        return float(value[np.argmax(met / np.maximum(value, 1e-300))])

    @cached_property
    def best(self) -> int | None:
        """The candidate with the smallest objective; None if no machine is feasible."""
        return self._first_by(self.objective)

    @cached_property
    def cheapest(self) -> int | None:
        """The candidate with the lowest cost per request."""
        return self._first_by(self.cost_usd_per_request)

    @cached_property
    def fastest(self) -> int | None:
        """The candidate with the lowest latency."""
        return self._first_by(self.latency.value)

    @cached_property
    def least(self) -> int | None:
        """The candidate with the smallest value of the objective's metric; None if that is the latency."""
        return self._first_by(self.metric_value) if self.rule.metric else None

    def _first_by(self, column: Floats) -> int | None:
        """Return the candidate with the smallest value; ties go by cost, then latency, then name, then row."""
        rows = np.flatnonzero(self.candidates)
        if not len(rows):
            return None
        least = column[rows].min()
        tied = rows[column[rows] <= least + TIE * abs(least)]
        cost, latency, names = self.cost_usd_per_request, self.latency.value, self.rule.names
        return int(min(tied, key=lambda row: (cost[row], latency[row], str(names[row]), row)))

    @property
    def unverified(self) -> int | None:
        """The best machine if it was not measured: the adaptive sampler measures it last."""
        return None if self.best is None or self.latency.measured[self.best] else self.best

    def decided_above_s(self, rows: Rows) -> Floats | None:
        """Return the latency (m,) from which on a machine cannot both meet the limits and beat the choice (ADR 0028).

        The choice counts with the upper end of its latency's 90% interval. Infinite where no latency decides; None without a
        measured choice that meets the limits with the required confidence, and where the objective is of another metric.
        """
        best, posterior = self.best, self.latency.posterior
        if best is None or posterior is None or self.rule.metric is not None or self.level != self.confidence:
            return None
        if not self.latency.measured[best]:
            return None
        rule, one = self.rule.take(rows), self.rule.take(np.array([best]))
        slowest_s = posterior.take(self.latency.type_index[[best]]).quantile(UPPER)
        worst = float(one.value(slowest_s, self.scale)[0])
        low, high = np.full(len(rows), SHORTEST_S), np.full(len(rows), LONGEST_S)
        for _ in range(HALVINGS):
            middle = np.sqrt(low * high)
            if ((middle == low) | (middle == high)).all():
                break
            beats = rule.value(middle, self.scale) < worst
            low, high = np.where(beats, middle, low), np.where(beats, high, middle)
        found = np.minimum(high, rule.latency_budget_s)
        return np.where((found > SHORTEST_S * 2) & (found < LONGEST_S / 2), found, np.inf)

    @cached_property
    def front(self) -> Rows:
        """Feasible machines, else eligible ones, that no other beats in both the metric and the cost per request."""
        return self._undominated(self.cost_usd_per_request)

    @cached_property
    def hourly_front(self) -> Rows:
        """The same front with the price per hour, as in the paper's figures."""
        return self._undominated(self.rule.costs.price_usd_per_hour)

    def _undominated(self, column: Floats) -> Rows:
        rows = np.flatnonzero(self.feasible if self.feasible.any() else self.eligible)
        return np.asarray(rows[pareto(column[rows], self.metric_value[rows])])

    def required_latency_s(self, level: float) -> Floats:
        """Return the latency (n,) that each machine must be allowed to meet all limits with this probability.

        A machine meets them if and only if its latency budget is at least this. Raise ValueError without a posterior.
        """
        posterior = self.latency.posterior
        if posterior is None:
            raise ValueError("without a posterior there are no probabilities")
        of_metrics = self._metrics_probability
        if of_metrics is None:
            return np.asarray(posterior.quantile(level)[self.latency.type_index])
        rest = level / np.maximum(of_metrics, 1e-12)
        enough = np.where(rest < 1, posterior.quantile(np.minimum(rest, 1 - 1e-12)), np.inf)
        return np.asarray(enough[self.latency.type_index])

    @cached_property
    def _metrics_probability(self) -> Floats | None:
        """Probability of each type to meet the limits on metrics; None without such a limit."""
        found: Floats | None = None
        for name, predictions in self.metrics.items():
            bound = self.bounds.get(f"metrics.{name}")
            if bound is not None and predictions.posterior is not None:
                own = predictions.posterior.probability_below(bound)
                found = own if found is None else found * own
        return found

    def required(self, level: float | None) -> Mapping[str, Floats]:
        """Return the bound by limit that lets each machine meet it with this probability; the predicted values without one.

        Limits on latency, rate and cost must hold with the probability that the limits on metrics leave, if they leave
        enough.
        """
        if level is None or self.latency.posterior is None:
            return self.values
        latency_s = self._limit_on_latency_s(level)
        found = self.rule.limited(latency_s, {name: one.value for name, one in self.metrics.items()})
        for name, one in self.metrics.items():
            if one.posterior is not None:
                found[f"metrics.{name}"] = np.maximum(one.posterior.quantile(level)[one.type_index], one.value)
        return {name: found[name] for name in self.bounds}

    @property
    def lenient_latency_s(self) -> Floats:
        """The limit on latency (n,) with which each machine would meet it with the lowest required probability."""
        return self._limit_on_latency_s(self.rule.levels[-1])

    def _limit_on_latency_s(self, level: float) -> Floats:
        posterior = self.latency.posterior
        if posterior is None:
            return self.latency.value
        rest = self._metrics_probability
        required = level if rest is None else np.where(rest > level, level / np.maximum(rest, level), level)
        return np.asarray(np.maximum(posterior.quantile(required)[self.latency.type_index], self.latency.value))

    def probability(self, row: int) -> float | None:
        """Return the probability that one machine meets every limit; None if unknown.

        No model is certain: with limits it is at most `MOST_CERTAIN`.
        """
        if not self.eligible[row]:
            return 0.0
        found = self.latency.probability_below(row, float(self.latency_budget_s[row]))
        for name, predictions in self.metrics.items():
            bound = self.bounds.get(f"metrics.{name}")
            if found is not None and bound is not None:
                own = predictions.probability_below(row, bound)
                found = None if own is None else found * own
        return found if found is None or not self.bounds else min(found, MOST_CERTAIN)

    @cached_property
    def most_probable(self) -> int | None:
        """The machine with the highest probability of meeting every limit; None if unknown."""
        met = self._probability_met
        return None if met is None or not self.eligible.any() else int(np.argmax(np.where(self.eligible, met, -1.0)))

    @cached_property
    def _probability_met(self) -> Floats | None:
        """Probability (n,) of meeting every limit, 0 for machines that are not eligible or whose type has a larger budget."""
        posterior = self.latency.posterior
        if posterior is None:
            return None
        types, budget = self.latency.type_index, self.latency_budget_s
        most = np.zeros(len(posterior.machines))
        np.maximum.at(most, types[self.eligible], budget[self.eligible])
        met = posterior.probability_below(most)
        if self._metrics_probability is not None:
            met = met * self._metrics_probability
        return np.where(self.eligible & (budget >= most[types]), met[types], 0.0)

    @cached_property
    def violations(self) -> tuple[Violation, ...]:
        """How far each limit must be relaxed, worst first; empty while some machine meets them all.

        Each factor is the least relaxation of that limit alone. If no limit alone is to blame, because every machine violates
        two limits or more, the result is the limits that the least infeasible machine violates, to be relaxed together.
        """
        if self.feasible.any():
            return ()
        values, bounds = self.required(self.rule.levels[-1]), self.bounds
        found = [one for name in bounds if (one := self._violation(name, values)) is not None and one.factor > 1]
        row = self.least_infeasible
        if not found and row is not None:
            over = {name: float(values[name][row]) for name in bounds if values[name][row] > bounds[name]}
            found = [
                Violation(
                    limit=name, bound=bounds[name], row=row, value=value, factor=_over(value, bounds[name]), alone=False
                )
                for name, value in over.items()
            ]
        return tuple(sorted(found, key=lambda one: (-one.factor, one.limit)))

    def _violation(self, limit: str, values: Mapping[str, Floats]) -> Violation | None:
        others = self.eligible.copy()
        for other, bound in self.bounds.items():
            if other != limit:
                others &= values[other] <= bound
        alone = bool(others.any())
        rows = np.flatnonzero(others if alone else self.eligible)
        if not len(rows):
            return None
        row, bound = int(rows[np.argmin(values[limit][rows])]), self.bounds[limit]
        value = float(values[limit][row])
        return Violation(limit=limit, bound=bound, row=row, value=value, factor=_over(value, bound), alone=alone)

    @cached_property
    def least_infeasible(self) -> int | None:
        """The machine whose worst excess over any limit, as a factor, is smallest; None while some machine is feasible."""
        rows = np.flatnonzero(self.eligible)
        if self.feasible.any() or not len(rows) or not self.bounds:
            return None
        values = self.required(self.rule.levels[-1])
        worst = np.max([values[name][rows] / max(bound, 1e-300) for name, bound in self.bounds.items()], axis=0)
        return int(rows[np.argmin(worst)])

    def utility(self, rows: Rows | None = None, available: Mask | None = None) -> "Utility":
        """Return the value of N types, each at the machine `rows` (N,) says, for the sampler; each machine if None."""
        if rows is None:
            rows = np.arange(len(self.rule.names))
        fit = ~self.latency.unfit[rows]
        return Utility(
            rule=self.rule.take(rows),
            scale=self.scale,
            metrics=self.metrics,
            available=fit if available is None else available & fit,
        )


def _over(value: float, bound: float) -> float:
    return value / bound if bound > 0 else float("inf")


@dataclass(frozen=True, slots=True, kw_only=True)
class Utility:
    """The value of N types in joint draws of their latency and metrics: the objective, infinite where a limit is violated.

    The sampler measures the type of the largest expected improvement of this value per price, and stops when that falls below
    the threshold of its `Policy` (`fogspec.numerics.acquisition`).
    """

    rule: Rule
    scale: Scale
    metrics: Mapping[str, Predictions]
    available: Mask

    @property
    def confidence(self) -> float:
        """The probability with which the limits must be met."""
        return self.rule.confidence

    @property
    def measured_first(self) -> bool:
        """Whether a machine that was not measured is chosen only if no measured one qualifies."""
        return self.rule.measured_first

    def loss(self, posterior: Posterior, rows: Rows | None = None) -> Floats:
        """Return the value of each type in each draw (S, N), or only of M types at these indices, (S, M)."""
        rule, bounds = self.rule if rows is None else self.rule.take(rows), self.rule.bounds
        some: Rows | slice = slice(None) if rows is None else rows
        latency_s = np.exp(posterior.draws[:, some])
        met = latency_s <= rule.latency_budget_s
        met &= self.available[some]
        metric_value = latency_s
        for name, predictions in self.metrics.items():
            if predictions.posterior is None:
                continue
            # Both posteriors draw from one seed: the reversed order makes them independent.
            value = np.exp(predictions.posterior.draws[::-1, some])
            met &= value <= bounds.get(f"metrics.{name}", np.inf)
            if name == rule.metric:
                metric_value = value
        # In place: tables of draws by machines are large, and new ones take longer than what is computed in them.
        found = rule.costs.per_request(latency_s)
        found *= (1 - rule.alpha) / self.scale.cost
        metric_value *= rule.alpha / self.scale.metric
        found += metric_value
        found[~met] = np.inf
        return found
