"""Methods: predictions from the paid samples, and the choice by the rule that ships (`fogspec.choice.rule`)."""

import functools
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from fogspec.choice.relaxed import relax
from fogspec.choice.rule import Rule, Selection
from fogspec.model.predict import Predictions
from fogspec.numerics import families
from fogspec.numerics.families import Fit, fit_all
from fogspec.numerics.kernels import Floats
from fogspec_lab.evaluation.replay import Case, Meter, Run

Method = Callable[[Case, Rule, Meter], Run]


def model(case: Case, rule: Rule, meter: Meter) -> Run:
    """Ours without verification: any machine may be chosen."""
    return _modelled(case, replace(rule, measured_first=False), meter)


def verified(case: Case, rule: Rule, meter: Meter) -> Run:
    """Ours: a measured machine is chosen while one qualifies."""
    return _modelled(case, replace(rule, measured_first=True), meter)


def _modelled(case: Case, rule: Rule, meter: Meter) -> Run:
    posterior, selection = case.posterior(meter), case.selection(meter, rule)
    low_s, high_s = posterior.prediction.interval(0.9)
    return Run(
        chosen=selection.best,
        bill=meter.bill,
        log_latency=posterior.mean,
        low=np.log(low_s),
        high=np.log(high_s),
        probability_met=posterior.prediction.on_measured_server.probability_below(selection.latency_budget_s),
        metrics={name: one.value for name, one in selection.metrics.items()},
    )


def measured(case: Case, rule: Rule, meter: Meter) -> Run:
    """No model: the best of the measured machines at their measured values."""
    return _by_values(rule, meter, _measured_mean(case, meter))


def paper(case: Case, rule: Rule, meter: Meter) -> Run:
    """Choose as the paper does: the best R², its relaxed optimum, and the best of the admissible neighbours (section 2.E)."""
    machines, scale = case.machines, case.problem.truth(rule).scale
    found = {name: np.full(len(machines), np.nan) for name in ("latency", *case.problem.metrics)}
    near = np.zeros(len(machines), dtype=bool)
    for rows, fits in _fits(case, meter):
        vcpus, memory_gib = machines.vcpus[rows], machines.memory_gib[rows]
        surfaces = {name: fit.predict for name, fit in fits.items()}
        for name, surface in surfaces.items():
            found[name][rows] = surface(vcpus, memory_gib)
        ended = relax(rule.take(rows), scale, vcpus, memory_gib, surfaces)
        if ended is not None:
            near[rows[ended[1]]] = True
    values = {name: np.where(one > 0, one, np.nan) for name, one in found.items()}
    run = _by_values(rule, meter, {name: np.where(near, one, np.nan) for name, one in values.items()})
    latency_s = values.pop("latency")
    return replace(run, log_latency=np.log(latency_s), probability_met=_met(latency_s, rule), metrics=values)


def _fits(case: Case, meter: Meter) -> list[tuple[np.ndarray, dict[str, Fit]]]:
    """Return the rows of the machines of each sampled GPU type, and the fits for them by target."""
    machines = case.machines
    at = np.array(meter.sampled, dtype=np.intp)
    values = {"latency": np.array(meter.latency_s), **{name: np.array(one) for name, one in meter.metrics.items()}}
    found = []
    for gpu in np.unique(machines.gpu[at]):
        mine = machines.gpu[at] == gpu
        vcpus, memory_gib = machines.vcpus[at[mine]], machines.memory_gib[at[mine]]
        shapes = tuple(vcpus.tolist()), tuple(memory_gib.tolist())
        fits = {name: _best_fit(*shapes, tuple(one[mine].tolist())) for name, one in values.items()}
        found.append((np.flatnonzero(machines.gpu == gpu), fits))
    return found


@functools.lru_cache(maxsize=64)
def _best_fit(vcpus: tuple[float, ...], memory_gib: tuple[float, ...], values: tuple[float, ...]) -> Fit:
    """Return the fit of the best R²; the settings of a problem have samples in common."""
    return families.select(fit_all(np.array(vcpus), np.array(memory_gib), np.array(values)), "r2")


def _measured_mean(case: Case, meter: Meter) -> dict[str, Floats]:
    """Return the mean of the samples of each machine by target, NaN without one."""
    found = {}
    for name in ("latency", *case.problem.metrics):
        total, count = np.zeros(len(case.machines)), np.zeros(len(case.machines))
        np.add.at(total, meter.sampled, meter.latency_s if name == "latency" else meter.metrics.get(name, []))
        np.add.at(count, meter.sampled, 1)
        with np.errstate(invalid="ignore"):
            found[name] = np.asarray(total / count)
    return found


def _by_values(rule: Rule, meter: Meter, values: Mapping[str, Floats]) -> Run:
    """Return the choice if these values by target were exact; there are no intervals."""
    metrics = {name: one for name, one in values.items() if name != "latency"}
    latency_s = values["latency"]
    unknown = np.full(len(latency_s), np.nan)
    selection = Selection(
        rule=replace(rule, confidence=None),
        latency=Predictions.of_values(latency_s),
        metrics={name: Predictions.of_values(one) for name, one in metrics.items()},
    )
    return Run(
        chosen=selection.best,
        bill=meter.bill,
        log_latency=np.log(latency_s),
        low=unknown,
        high=unknown,
        probability_met=_met(latency_s, rule),
        metrics=metrics,
    )


def _met(latency_s: Floats, rule: Rule) -> Floats:
    return np.where(np.isnan(latency_s), np.nan, (latency_s <= rule.latency_budget_s).astype(float))


METHODS: dict[str, Method] = {
    "model": model,
    "verified": verified,
    "paper": paper,
    "measured": measured,
}
OWN_METHOD = {
    "grid": "model",
    "adaptive": "verified",
    "random": "model",
    "cherrypick": "measured",
    "full": "measured",
    "best": "measured",
}
