"""The paper's way to choose (sections 2.C to 2.E): its own model, a continuous optimum, and its admissible neighbours.

The model of each GPU type is the curve with the largest R². It alone decides which machines meet the limits, which are
checked again after rounding. The objective is the formula's: `alpha` weighs the latency. Its scales are those of the spec, else
the limits, else the best values that the curves predict (ADR 0005).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fogspec.catalog.table import Floats
from fogspec.choice.choose import Choice
from fogspec.choice.rule import Rule, Scale, Selection
from fogspec.model.fit import Fitted, Model
from fogspec.model.predict import Predictions
from fogspec.numerics import families, relaxation


@dataclass(frozen=True, slots=True, kw_only=True)
class Relaxed:
    """The continuous optimum of the best GPU type, and the row of the offer that rounding selects.

    `row` is None when no neighbour meets the limits; `rounded` is the plain nearest neighbour, limits or not. `selection` is
    the rule applied to the predictions of the curves.
    """

    gpu: str | None
    vcpus: float
    memory_gib: float
    rounded: int
    row: int | None
    selection: Selection


def relaxed_optimum(models: Fitted, choice: Choice, *, refine: bool = True) -> Relaxed | None:
    """Return the paper's choice over the same offers; None if no continuous machine meets the limits.

    One problem for each GPU type, compared at the end by the objective of where they end. `refine` as in
    `relaxation.minimise`.
    """
    own = _by_curves(models, choice)
    groups = [_group(models, choice, own, gpu, rows, refine) for gpu, rows in _groups(choice, own).items()]
    found = [one for one in groups if one is not None]
    if not found:
        return None
    return min(found, key=lambda one: np.inf if one.row is None else float(own.objective[one.row]))


def chosen_by_relaxing(choice: Choice, found: Relaxed | None) -> Choice:
    """Return the choice with the paper's machine in place of the best one."""
    return replace(choice, by_relaxation=True, relaxed_row=None if found is None else found.row)


def _by_curves(models: Fitted, choice: Choice) -> Selection:
    """Return the choice's rule over the values that the curves of the largest R² predict; NaN where there is none.

    Curves have no probabilities: values decide. A machine that failed when it was measured is not admissible.
    """
    offers = choice.offers
    gpus = _gpu_keys(choice)
    values = {name: np.full(len(offers), np.nan) for name in ("latency", *choice.metrics)}
    for model in models.curves:
        if model.target in values:
            rows = np.flatnonzero(gpus == (model.gpu or ""))
            values[model.target][rows] = _surface(model)(offers.vcpus[rows], offers.memory_gib[rows])
    predicted = {
        name: replace(Predictions.of_values(np.where(value > 0, value, np.nan)), unfit=choice.latency.unfit)
        for name, value in values.items()
    }
    return Selection(rule=replace(choice.rule, confidence=None), latency=predicted.pop("latency"), metrics=predicted)


def _gpu_keys(choice: Choice) -> NDArray[np.str_]:
    """Return `T4:1` for each offer, empty without accelerators."""
    offers = choice.offers
    return np.array([f"{gpu}:{n:g}" if gpu else "" for gpu, n in zip(offers.gpu, offers.gpu_count, strict=True)])


def _groups(choice: Choice, own: Selection) -> dict[str | None, NDArray[np.intp]]:
    """Return the rows of the offers of each GPU type for which there is a curve."""
    gpus = _gpu_keys(choice)
    return {gpu or None: np.flatnonzero(own.eligible & (gpus == gpu)) for gpu in sorted(set(gpus[own.eligible]))}


def _group(
    models: Fitted, choice: Choice, own: Selection, gpu: str | None, rows: NDArray[np.intp], refine: bool
) -> Relaxed | None:
    fitted = {model.target: model for model in models.curves if model.gpu == gpu}
    # A metric of which no sample sent a value has no curve.
    needed = {"latency", *choice.rule.max_metrics, *([choice.rule.metric] if choice.rule.metric else [])}
    if not needed <= fitted.keys():
        return None
    offers = choice.offers
    surfaces = {target: _surface(model) for target, model in fitted.items()}
    rule = choice.rule.take(rows)
    found = relax(rule, own.scale, offers.vcpus[rows], offers.memory_gib[rows], surfaces, refine=refine)
    if found is None:
        return None
    optimum, near = found[0], rows[found[1]]
    meet = near[own.feasible[near]]
    best = int(meet[np.argmin(own.objective[meet])]) if len(meet) else None
    return Relaxed(
        gpu=gpu,
        vcpus=optimum.vcpus,
        memory_gib=optimum.memory_gib,
        rounded=int(near[0]),
        row=best,
        selection=own,
    )


def _surface(model: Model) -> relaxation.Surface:
    """Return the paper's curve of a model; that of one value where samples do not vary, which have no R²."""
    curve = model.paper or model
    return partial(_value, curve.shape, list(curve.coefficients.values()))


def relax(
    rule: Rule,
    scale: Scale,
    vcpus: Floats,
    memory_gib: Floats,
    surfaces: Mapping[str, relaxation.Surface],
    *,
    refine: bool = True,
) -> tuple[relaxation.Optimum, NDArray[np.intp]] | None:
    """Return the continuous optimum over machines of one kind (n,), and its neighbours among them, the nearest first.

    `surfaces` predict the latency and each metric from vCPUs and GiB; the price is a plane through the machines' prices. None
    if no continuous machine meets the limits. `refine` as in `relaxation.minimise`.
    """
    price = relaxation.price_surface(vcpus, memory_gib, rule.costs.price_usd_per_hour)
    ratio, waiting = np.asarray(rule.costs.typical_busy_ratio), rule.waiting and rule.waiting.typical
    beside = np.asarray(rule.costs.typical_beside_usd_per_hour)

    def at(c: Floats, m: Floats) -> tuple[Rule, Floats, dict[str, Floats]]:
        usd = np.maximum(price(c, m), 1e-9)
        costs = replace(
            rule.costs,
            price_usd_per_hour=usd,
            spot=np.zeros(usd.shape, dtype=bool),
            busy_ratio=ratio,
            beside_usd_per_hour=beside,
        )
        metrics = {name: surface(c, m) for name, surface in surfaces.items() if name != "latency"}
        return replace(rule, costs=costs, waiting=waiting), surfaces["latency"](c, m), metrics

    def objective(c: Floats, m: Floats) -> Floats:
        here, alone_s, metrics = at(c, m)
        latency_s = here.at_rate(alone_s)
        metric_value = metrics[rule.metric] if rule.metric else latency_s
        return here.objective(metric_value, here.costs.per_request(latency_s), scale)

    # Not np.median, whose first call imports numpy.ma.
    typical_s = float(np.sort(np.abs(surfaces["latency"](vcpus, memory_gib)))[len(vcpus) // 2]) or 1.0

    def slack(c: Floats, m: Floats) -> Floats:
        here, alone_s, metrics = at(c, m)
        bounds = rule.bounds
        limits = [
            (bounds[name] - values) / (abs(bounds[name]) or 1.0)
            for name, values in here.limited(here.at_rate(alone_s), metrics).items()
        ]
        return np.stack([alone_s / typical_s, *limits])

    optimum = relaxation.minimise(objective, slack, relaxation.box_of(vcpus, memory_gib), refine=refine)
    return None if optimum is None else (optimum, relaxation.neighbours(optimum, vcpus, memory_gib))


def _value(shape: families.Shape, coefficients: list[float], vcpus: Floats, memory_gib: Floats) -> Floats:
    return families.predict(shape, coefficients, vcpus, memory_gib)
