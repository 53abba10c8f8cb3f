"""The paper's way to choose (section 2.E): a continuous optimum, then its admissible neighbours, limits checked again.

It is kept to be compared with: over the same offers and the same models it is never better than looking at all of them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fogspec.catalog.table import Floats
from fogspec.choice.choose import Choice
from fogspec.choice.rule import Rule, Scale
from fogspec.model.fit import Model, Models
from fogspec.numerics import families, relaxation


@dataclass(frozen=True, slots=True)
class Relaxed:
    """The continuous optimum of the best GPU type, and the row of the offer that rounding selects.

    `row` is None when no neighbour meets the limits; `rounded` is the plain nearest neighbour, limits or not.
    """

    gpu: str | None
    vcpus: float
    memory_gib: float
    rounded: int
    row: int | None


def relaxed_optimum(models: Models, choice: Choice, *, refine: bool = True) -> Relaxed | None:
    """Return the paper's choice over the same offers; None if no continuous machine meets the limits.

    One problem for each GPU type and infra, compared at the end by the exact objective of where they end. `refine` as in
    `relaxation.minimise`.
    """
    groups = [_group(models, choice, gpu, rows, refine) for gpu, rows in _groups(choice).items()]
    found = [one for one in groups if one is not None]
    if not found:
        return None
    return min(found, key=lambda one: np.inf if one.row is None else float(choice.objective[one.row]))


def chosen_by_relaxing(choice: Choice, found: Relaxed | None) -> Choice:
    """Return the choice with the paper's machine in place of the best one."""
    return replace(choice, by_relaxation=True, relaxed_row=None if found is None else found.row)


def _groups(choice: Choice) -> dict[str | None, NDArray[np.intp]]:
    groups: dict[str | None, list[int]] = {}
    for row in np.flatnonzero(choice.eligible).tolist():
        gpu = choice.offers.gpu[row]
        groups.setdefault(f"{gpu}:{choice.offers.gpu_count[row]:g}" if gpu else None, []).append(row)
    return {gpu: np.array(rows) for gpu, rows in groups.items()}


def _group(models: Models, choice: Choice, gpu: str | None, rows: NDArray[np.intp], refine: bool) -> Relaxed | None:
    fitted = {model.target: model for model in models.spec.models if model.gpu == gpu}
    # A metric of which no sample sent a value has no curve.
    needed = {"latency", *choice.rule.max_metrics, *([choice.rule.metric] if choice.rule.metric else [])}
    if not needed <= fitted.keys():
        return None
    offers = choice.offers
    surfaces = {target: partial(_value, model) for target, model in fitted.items()}
    rule = choice.rule.take(rows)
    found = relax(rule, choice.scale, offers.vcpus[rows], offers.memory_gib[rows], surfaces, refine=refine)
    if found is None:
        return None
    optimum, near = found[0], rows[found[1]]
    meet = near[choice.feasible[near]]
    best = int(meet[np.argmin(choice.objective[meet])]) if len(meet) else None
    return Relaxed(gpu, optimum.vcpus, optimum.memory_gib, int(near[0]), best)


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

    def at(c: Floats, m: Floats) -> tuple[Rule, Floats, dict[str, Floats]]:
        usd = np.maximum(price(c, m), 1e-9)
        costs = replace(rule.costs, price_usd_per_hour=usd, spot=np.zeros(usd.shape, dtype=bool))
        metrics = {name: surface(c, m) for name, surface in surfaces.items() if name != "latency"}
        return replace(rule, costs=costs), surfaces["latency"](c, m), metrics

    def objective(c: Floats, m: Floats) -> Floats:
        here, latency_s, metrics = at(c, m)
        metric_value = metrics[rule.metric] if rule.metric else latency_s
        return here.objective(metric_value, here.costs.per_request(latency_s), scale)

    # Not np.median, whose first call imports numpy.ma.
    typical_s = float(np.sort(np.abs(surfaces["latency"](vcpus, memory_gib)))[len(vcpus) // 2]) or 1.0

    def slack(c: Floats, m: Floats) -> Floats:
        here, latency_s, metrics = at(c, m)
        bounds = rule.bounds
        limits = [
            (bounds[name] - values) / (abs(bounds[name]) or 1.0)
            for name, values in here.limited(latency_s, metrics).items()
        ]
        return np.stack([latency_s / typical_s, *limits])

    optimum = relaxation.minimise(objective, slack, relaxation.box_of(vcpus, memory_gib), refine=refine)
    return None if optimum is None else (optimum, relaxation.neighbours(optimum, vcpus, memory_gib))


def _value(model: Model, vcpus: Floats, memory_gib: Floats) -> Floats:
    return families.predict(model.shape, list(model.coefficients.values()), vcpus, memory_gib)
