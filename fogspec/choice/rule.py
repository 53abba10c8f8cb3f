"""The rule of the choice over arrays of machines: objective, limits, confidence, tie-breaks and the value of a sample.

Every part of fogspec that chooses calls this module: compile, menu, explain, report, the adaptive sampler, the relaxed method
and the evaluation. The report's page repeats `Selection` in JavaScript (ADR 0170).

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
from fogspec.language.schema import Application
from fogspec.model.predict import Predictions
from fogspec.numerics.pareto import pareto
from fogspec.numerics.surrogate import Posterior
from fogspec.numerics.waiting import Waiting

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

    `costs` and `names` (n,) describe the machines; `metric` is the name of the objective's metric, None for the latency. The
    limits must be met with probability `confidence`; without one, by the predicted values. A scale that is None is the limit
    on the same quantity, else its best attainable value (ADR 0005). `max_latency_s` is the limit without the network's
    allowance, `units` are those of metrics, for people. With `measured_first`, a machine that was not measured is chosen only
    if no measured one qualifies. Latencies are those at the declared rate, where `waiting` is known. Raise ValueError for an
    alpha outside of 0 to 1 and scales that are not positive.
    """

    costs: Costs
    names: NDArray[np.object_]
    alpha: float
    confidence: float | None
    metric: str | None = None
    metric_scale: float | None = None
    cost_scale: float | None = None
    max_latency_s: float | None = None
    max_cost_usd: float | None = None
    max_price_usd_per_hour: float | None = None
    max_metrics: Mapping[str, float] = field(default_factory=dict)
    measured_first: bool = False
    units: Mapping[str, str] = field(default_factory=dict)
    waiting: Waiting | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.alpha <= 1:
            raise ValueError(f"alpha lies between 0 and 1, got {self.alpha}")
        if not all(scale is None or scale > 0 for scale in (self.metric_scale, self.cost_scale)):
            raise ValueError("scales must be positive")

    @classmethod
    def of(
        cls,
        application: Application,
        offers: Catalog,
        busy_ratio: Floats | None = None,
        waiting: Waiting | None = None,
        alone: bool = False,
    ) -> "Rule":
        """Return the rule of a spec over these offers; `busy_ratio` is that of `Costs`, `alone` leaves out disk and address."""
        spec = application.spec
        objective, constraints = spec.objective, spec.constraints
        return cls(
            costs=Costs.of(
                spec, offers.price_usd_per_hour, offers.spot, busy_ratio, None if alone else offers.beside_usd_per_hour
            ),
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
            measured_first=spec.sampler == "adaptive",
            units={name: one.unit for name, one in spec.metrics.items() if one.unit},
            waiting=waiting,
        )

    def take(self, rows: Rows) -> "Rule":
        """Return the rule over some of the machines."""
        waiting = None if self.waiting is None else self.waiting.take(rows)
        return replace(self, costs=self.costs.take(rows), names=self.names[rows], waiting=waiting)

    def at_rate(self, alone_s: Floats) -> Floats:
        """Return the latency (..., n) at the declared rate for that of requests one after the other."""
        return alone_s if self.waiting is None else self.waiting.at_rate(alone_s)

    def alone(self, latency_s: Floats) -> Floats:
        """Return the latency (..., n) of requests one after the other for that at the declared rate."""
        return latency_s if self.waiting is None else self.waiting.alone(latency_s)

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
            "rate": self.alone(latency_s) * self.costs.busy_ratio,
            **{f"metrics.{name}": values for name, values in metrics.items()},
        }
        return {name: found[name] for name in self.bounds}

    @property
    def latency_budget_s(self) -> Floats:
        """The largest latency (n,) of requests one after the other that keeps the limits on latency, rate, cost and price.

        0 where none does.
        """
        found = np.full(len(self.names), np.inf)
        if self.max_latency_s is not None:
            found = np.minimum(found, self.alone(np.full(len(found), self.max_latency_s)))
        if self.costs.requests_per_s:
            found = np.minimum(found, 1 / self.costs.requests_per_s / self.costs.busy_ratio)
        if self.max_cost_usd is not None:
            found = np.minimum(found, self.costs.latency_within(self.max_cost_usd))
        if self.max_price_usd_per_hour is not None:
            found[self.costs.price_usd_per_hour > self.max_price_usd_per_hour] = 0.0
        return found

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

    Latency, rate and cost are limits on latency, to which the time that a machine is busy is in a known ratio: the
    distribution of the latency on another server of the type says how likely the smallest of them holds. Limits on metrics
    multiply in; metrics are taken as independent of the latency. Without a distribution no machine meets limits with any
    probability.
    """

    rule: Rule
    latency: Predictions
    metrics: Mapping[str, Predictions] = field(default_factory=dict)

    @property
    def bounds(self) -> Mapping[str, float]:
        """Upper bounds by name of the limit."""
        return self.rule.bounds

    @property
    def confidence(self) -> float | None:
        """The probability with which the limits must be met; None if predicted values decide."""
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
        """The latency (n,) of requests one after the other that the limits, but for those on metrics, leave each machine."""
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
    def feasible(self) -> Mask:
        """Machines (n,) that meet all limits with the required probability."""
        if not self.bounds or self.confidence is None:
            return self.satisfied
        met = self._probability_met
        return np.zeros_like(self.satisfied) if met is None else self.satisfied & (met >= self.confidence)

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

        It is that of requests one after the other, as they are measured. The choice counts with the upper end of the 90%
        interval of its latency as it was measured: every type's servers differ. Infinite where no latency decides; None without
        a measured choice, and where the objective is of another metric.
        """
        best, distribution = self.best, self.latency.distribution
        if best is None or distribution is None or self.rule.metric is not None:
            return None
        if not self.latency.measured[best]:
            return None
        rule, one = self.rule.take(rows), self.rule.take(np.array([best]))
        slowest_s = distribution.take(self.latency.type_index[[best]]).on_measured_server.quantile(UPPER)
        worst = float(one.value(slowest_s, self.scale)[0])
        low, high = np.full(len(rows), SHORTEST_S), np.full(len(rows), LONGEST_S)
        for _ in range(HALVINGS):
            middle = np.sqrt(low * high)
            if ((middle == low) | (middle == high)).all():
                break
            beats = rule.value(rule.at_rate(middle), self.scale) < worst
            low, high = np.where(beats, middle, low), np.where(beats, high, middle)
        found = np.minimum(high, rule.latency_budget_s)
        return np.where((found > SHORTEST_S * 2) & (found < LONGEST_S / 2), found, np.inf)

    @cached_property
    def front(self) -> Rows:
        """Feasible machines, else eligible ones, that no other beats in both the metric and the cost per request."""
        rows = np.flatnonzero(self.feasible if self.feasible.any() else self.eligible)
        return np.asarray(rows[pareto(self.cost_usd_per_request[rows], self.metric_value[rows])])

    def required_latency_s(self, level: float) -> Floats:
        """Return the latency (n,) that each machine must be allowed to meet all limits with this probability.

        Infinite where the limits on metrics leave too little. Raise ValueError without a distribution.
        """
        distribution = self.latency.distribution
        if distribution is None:
            raise ValueError("without a distribution there are no probabilities")
        of_metrics = self.metrics_probability
        if of_metrics is None:
            return np.asarray(distribution.quantile(level)[self.latency.type_index])
        rest = level / np.maximum(of_metrics, 1e-12)
        enough = np.where(rest < 1, distribution.quantile(np.minimum(rest, 1 - 1e-12)), np.inf)
        return np.asarray(enough[self.latency.type_index])

    @cached_property
    def metrics_probability(self) -> Floats | None:
        """Probability of each type to meet the limits on metrics; None without such a limit."""
        found: Floats | None = None
        for name, predictions in self.metrics.items():
            bound = self.bounds.get(f"metrics.{name}")
            if bound is not None and predictions.distribution is not None:
                own = predictions.distribution.probability_below(bound)
                found = own if found is None else found * own
        return found

    def required(self, level: float | None) -> Mapping[str, Floats]:
        """Return the bound by limit that lets each machine meet it with this probability; the predicted values without one.

        Limits on latency, rate and cost must hold with the probability that the limits on metrics leave, if they leave
        enough.
        """
        if level is None or self.latency.distribution is None:
            return self.values
        latency_s = self._limit_on_latency_s(level)
        found = self.rule.limited(latency_s, {name: one.value for name, one in self.metrics.items()})
        for name, one in self.metrics.items():
            if one.distribution is not None:
                found[f"metrics.{name}"] = np.maximum(one.distribution.quantile(level)[one.type_index], one.value)
        return {name: found[name] for name in self.bounds}

    def _limit_on_latency_s(self, level: float) -> Floats:
        distribution = self.latency.distribution
        if distribution is None:
            return self.latency.value
        rest = self.metrics_probability
        required = level if rest is None else np.where(rest > level, level / np.maximum(rest, level), level)
        return np.asarray(np.maximum(distribution.quantile(required)[self.latency.type_index], self.latency.value))

    def probability(self, row: int, *, measured_server: bool = False) -> float | None:
        """Return the probability that another server of one machine's type meets every limit; None if unknown.

        No model is certain: with limits it is at most `MOST_CERTAIN`. It is for the server that was measured if that is asked.
        """
        if not self.eligible[row]:
            return 0.0
        budget = float(self.latency_budget_s[row])
        found = self.latency.alone.probability_below(row, budget, measured_server=measured_server)
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
        """Probability (n,) of meeting every limit, 0 for machines that are not eligible; None without a distribution."""
        distribution, of = self.latency.distribution, self.latency.type_index
        if distribution is None:
            return None
        met = distribution.alone.take(of).probability_below(self.latency_budget_s)
        if self.metrics_probability is not None:
            met = met * self.metrics_probability[of]
        return np.where(self.eligible, met, 0.0)

    @cached_property
    def violations(self) -> tuple[Violation, ...]:
        """How far each limit must be relaxed, worst first; empty while some machine meets them all.

        Each factor is the least relaxation of that limit alone. If no limit alone is to blame, because every machine violates
        two limits or more, the result is the limits that the least infeasible machine violates, to be relaxed together.
        """
        if self.feasible.any():
            return ()
        values, bounds = self.required(self.confidence), self.bounds
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
        values = self.required(self.confidence)
        worst = np.max([values[name][rows] / max(bound, 1e-300) for name, bound in self.bounds.items()], axis=0)
        return int(rows[np.argmin(worst)])

    def utility(self, rows: Rows | None = None, available: Mask | None = None) -> "Utility":
        """Return the value of N types, each at the machine `rows` (N,) says, for the sampler; each machine if None."""
        if rows is None:
            rows = np.arange(len(self.rule.names))
        fit, rule, distribution = ~self.latency.unfit[rows], self.rule.take(rows), self.latency.distribution
        qualifies = self.feasible[rows] & (True if available is None else available)
        budget_s = rule.latency_budget_s
        if distribution is not None and self.confidence is not None:
            budget_s = np.where(qualifies, budget_s, budget_s * np.exp(-distribution.room(self.confidence)))
        return Utility(
            rule=rule,
            qualifies=qualifies,
            latency_budget_s=budget_s,
            scale=self.scale,
            metrics=self.metrics,
            available=fit if available is None else available & fit,
        )


def independent(draws: Floats) -> Floats:
    """Return draws (S, N) in another order: those of two posteriors are from one seed, model by model, even if reversed."""
    return draws[np.random.default_rng(0).permutation(len(draws))]


def _over(value: float, bound: float) -> float:
    return value / bound if bound > 0 else float("inf")


@dataclass(frozen=True, slots=True, kw_only=True)
class Utility:
    """The value of N types in joint draws of their latency and metrics: the objective, infinite where a limit is violated.

    The sampler measures the type of the largest expected improvement of this value per price, and stops when that falls below
    the threshold of its `Policy` (`fogspec.numerics.acquisition`). `latency_budget_s` (N,) leaves room for another server
    where a type does not qualify yet.
    """

    rule: Rule
    qualifies: Mask
    latency_budget_s: Floats
    scale: Scale
    metrics: Mapping[str, Predictions]
    available: Mask

    @property
    def measured_first(self) -> bool:
        """Whether a machine that was not measured is chosen only if no measured one qualifies."""
        return self.rule.measured_first

    def loss(self, posterior: Posterior, rows: Rows | None = None) -> Floats:
        """Return the value of each type in each draw (S, N), or only of M types at these indices, (S, M)."""
        rule, bounds = self.rule if rows is None else self.rule.take(rows), self.rule.bounds
        some: Rows | slice = slice(None) if rows is None else rows
        alone_s = np.exp(posterior.draws[:, some])
        met = alone_s <= self.latency_budget_s[some]
        met &= self.available[some]
        latency_s = rule.at_rate(alone_s)
        metric_value = latency_s
        for name, predictions in self.metrics.items():
            if predictions.posterior is None:
                continue
            value = np.exp(independent(predictions.posterior.draws)[:, some])
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
