"""The paper's way to choose (section 2.E): a continuous optimum, then its admissible neighbours, limits checked again.

It is kept to be compared with: over the same offers and the same models it is never better than looking at all of them.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fogspec.catalog.cost import Costs
from fogspec.catalog.table import Floats
from fogspec.choice.choose import Choice
from fogspec.model.fit import Model, Models
from fogspec.numerics import curves, relaxed, select
from fogspec.spec.schema import Application


@dataclass(frozen=True, slots=True)
class Relaxed:
    """The continuous optimum of the best GPU type, and the row of the offer that it ends at.

    `row` is None when no neighbour meets the limits; `rounded` is the plain nearest neighbour, limits or not.
    """

    gpu: str | None
    vcpus: float
    memory_gib: float
    rounded: int
    row: int | None


def relaxed_optimum(application: Application, models: Models, choice: Choice) -> Relaxed | None:
    """The paper's choice over the same offers; None where no continuous machine meets the limits.

    One problem for each GPU type and infra, compared at the end by the exact objective of where they end.
    """
    found = [
        one
        for gpu, rows in _groups(choice).items()
        if (one := _group(application, models, choice, gpu, rows)) is not None
    ]
    if not found:
        return None
    return min(found, key=lambda one: np.inf if one.row is None else float(choice.objective[one.row]))


def chosen_by_relaxing(choice: Choice, found: Relaxed | None) -> Choice:
    """The choice with the paper's machine in place of the best one."""
    return replace(choice, chosen=None if found is None else found.row)


def _groups(choice: Choice) -> dict[str | None, NDArray[np.intp]]:
    groups: dict[str | None, list[int]] = {}
    for row in np.flatnonzero(choice.eligible).tolist():
        gpu = choice.offers.gpu[row]
        groups.setdefault(f"{gpu}:{choice.offers.gpu_count[row]:g}" if gpu else None, []).append(row)
    return {gpu: np.array(rows) for gpu, rows in groups.items()}


def _group(
    application: Application, models: Models, choice: Choice, gpu: str | None, rows: NDArray[np.intp]
) -> Relaxed | None:
    fitted = {model.target: model for model in models.spec.models if model.gpu == gpu}
    if "latency" not in fitted:
        return None
    offers = choice.offers
    vcpus, memory = offers.vcpus[rows], offers.memory_gib[rows]
    price = relaxed.price_surface(vcpus, memory, offers.price_usd_per_hour[rows])
    metric = application.spec.objective.metric

    def values(c: Floats, m: Floats) -> dict[str, Floats]:
        latency = _value(fitted["latency"], c, m)
        dollars = np.maximum(price(c, m), 1e-9)
        found = {"latency": latency, "rate": latency, "price": dollars}
        found["cost"] = Costs.of(application.spec, dollars, np.zeros(dollars.shape, bool)).per_request(latency)
        return found | {f"metrics.{name}": _value(model, c, m) for name, model in fitted.items() if name != "latency"}

    def objective(c: Floats, m: Floats) -> Floats:
        at = values(c, m)
        x = at[f"metrics.{metric}"] if metric else at["latency"]
        return select.weighed(x, at["cost"], application.spec.objective.alpha, choice.scale)

    def feasible(c: Floats, m: Floats) -> NDArray[np.bool_]:
        at = values(c, m)
        held = at["latency"] > 0
        for name, bound in choice.bounds.items():
            held &= at[name] <= bound
        return np.asarray(held)

    optimum = relaxed.minimise(objective, feasible, relaxed.box_of(vcpus, memory))
    if optimum is None:
        return None
    near = rows[relaxed.neighbours(optimum, vcpus, memory)]
    meet = near[choice.feasible[near]]
    best = int(meet[np.argmin(choice.objective[meet])]) if len(meet) else None
    return Relaxed(gpu, optimum.vcpus, optimum.memory_gib, int(near[0]), best)


def _value(model: Model, vcpus: Floats, memory_gib: Floats) -> Floats:
    return curves.predict(model.shape, list(model.coefficients.values()), vcpus, memory_gib)
