"""The choice: hard limits over every admissible offer, then the weighed sum; "none" is an answer that says why."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fogspec.admissible import Admissible
from fogspec.catalog import Catalog, Floats
from fogspec.models import Models, Predictions, predict
from fogspec.numerics import select
from fogspec.numerics.frontier import pareto
from fogspec.numerics.select import Mask, Miss, Scale
from fogspec.spec import Application

HOURS_PER_MONTH = 730


@dataclass(frozen=True, slots=True)
class Choice:
    """Every admissible offer with what it is predicted to do, and the rows that stand out; None when nothing meets.

    `values` and `bounds` have an entry for each limit; `eligible` are the offers that can be predicted at all.
    `x` is what alpha weighs: the latency, or a metric. `front` holds no offer that another beats in both x and
    cost per request; `hourly_front` the same with the price of an hour, as the paper draws it.
    """

    offers: Catalog
    latency: Predictions
    metrics: Mapping[str, Predictions]
    x: Floats
    cost_usd_per_request: Floats
    values: Mapping[str, Floats]
    bounds: Mapping[str, float]
    eligible: Mask
    feasible: Mask
    scale: Scale
    objective: Floats
    chosen: int | None
    cheapest: int | None
    fastest: int | None
    front: NDArray[np.intp]
    hourly_front: NDArray[np.intp]
    misses: tuple[Miss, ...]
    nearest: int | None

    @property
    def relaxed_limits(self) -> str:
        """One line for people: which limits bind and by how much, when nothing meets them."""
        return "; ".join(f"{m.limit} is missed by a factor of {m.factor:.3g}" for m in self.misses)


def choose(application: Application, models: Models, admissible: Admissible) -> Choice:
    """The choice under the application's limits and objective (the paper, section 2.E, made exhaustive: ADR 0005)."""
    spec, offers = application.spec, admissible.offers
    latency = predict(models, offers)
    names = {*spec.constraints.metrics, *([spec.objective.metric] if spec.objective.metric else [])}
    metrics = {name: predict(models, offers, name) for name in sorted(names)}
    x = metrics[spec.objective.metric].value if spec.objective.metric else latency.value
    cost = cost_usd_per_request(application, offers.price_usd_per_hour, latency.value)
    values, bounds = _limits(application, offers, latency, metrics, cost)
    eligible = np.isfinite(x) & np.isfinite(latency.value) & ~latency.unfit
    feasible = eligible.copy()
    for name, bound in bounds.items():
        feasible &= values[name] <= bound
    scale = scales(application, x, cost, eligible)
    objective = np.where(eligible, select.weighed(x, cost, spec.objective.alpha, scale), np.inf)
    first = _First(cost, latency.value, offers.instance, feasible)
    rows = np.flatnonzero(feasible if feasible.any() else eligible)
    return Choice(
        offers, latency, metrics, x, cost, values, bounds, eligible, feasible, scale, objective,
        chosen=first.by(objective), cheapest=first.by(cost), fastest=first.by(latency.value),
        front=rows[pareto(cost[rows], x[rows])], hourly_front=rows[pareto(offers.price_usd_per_hour[rows], x[rows])],
        misses=() if feasible.any() else select.misses(values, bounds, eligible),
        nearest=None if feasible.any() else select.nearest(values, bounds, eligible),
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class _First:
    """The best feasible row by some column."""

    cost: Floats
    latency_s: Floats
    names: NDArray[np.object_]
    among: Mask

    def by(self, column: Floats) -> int | None:
        return select.first_by(column, self.cost, self.latency_s, self.names, self.among)


def cost_usd_per_request(application: Application, price_usd_per_hour: Floats, latency_s: Floats) -> Floats:
    """USD per request: busy seconds at the exact price (section 2.D), or the whole hour shared by its requests."""
    objective = application.spec.objective
    if objective.billing == "provisioned" and objective.rate:
        return price_usd_per_hour / 3600 / objective.rate + 0 * latency_s
    return price_usd_per_hour / 3600 * latency_s


def _limits(
    application: Application,
    offers: Catalog,
    latency: Predictions,
    metrics: Mapping[str, Predictions],
    cost: Floats,
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


def latency_limit_s(application: Application) -> float | None:
    """What is left of the latency limit for the machine, once the network's allowance is taken off."""
    constraints = application.spec.constraints
    return None if constraints.latency is None else constraints.latency - constraints.network


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
