"""Methods: predictions from the paid samples, and the choice by the rule that ships (`fogspec.choice.rule`)."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from fogspec.choice.relaxed import relax
from fogspec.choice.rule import Rule, Selection
from fogspec.evaluation.replay import Case, Meter, Run
from fogspec.model.predict import Predictions
from fogspec.numerics import families
from fogspec.numerics.families import Fit, fit_all
from fogspec.numerics.kernels import Floats

Method = Callable[[Case, Rule, Meter], Run]


def model(case: Case, rule: Rule, meter: Meter) -> Run:
    """Ours without verification: any machine may be chosen."""
    return _modelled(case, replace(rule, measured_first=False), meter)


def verified(case: Case, rule: Rule, meter: Meter) -> Run:
    """Ours: a measured machine is chosen while one qualifies."""
    return _modelled(case, replace(rule, measured_first=True), meter)


def _modelled(case: Case, rule: Rule, meter: Meter) -> Run:
    posterior, selection = case.posterior(meter), case.selection(meter, rule)
    return Run(
        chosen=selection.best,
        sampled=tuple(meter.sampled),
        paid=meter.paid,
        log_latency=posterior.mean,
        low=np.log(posterior.elsewhere.quantile(0.05)),
        high=np.log(posterior.elsewhere.quantile(0.95)),
        probability_met=posterior.probability_below(selection.latency_budget_s),
        metrics={name: one.value for name, one in selection.metrics.items()},
    )


def measured(case: Case, rule: Rule, meter: Meter) -> Run:
    """No model: the best of the measured machines at their measured values."""
    return _by_values(rule, meter, _measured_mean(case, meter))


def best_r2(case: Case, rule: Rule, meter: Meter) -> Run:
    """Choose by the paper's fits, one for each GPU type by the best R² (section 2.C), every machine enumerated at its price."""
    known = _measured_mean(case, meter)
    found = {name: np.full(len(case.machines), np.nan) for name in known}
    for rows, fits in _fits(case, meter):
        for name, fit in fits.items():
            found[name][rows] = fit.predict(case.machines.vcpus[rows], case.machines.memory_gib[rows])
    values = {name: np.where(one > 0, one, np.nan) for name, one in found.items()}
    return _by_values(
        rule, meter, {name: np.where(np.isnan(known[name]), one, known[name]) for name, one in values.items()}
    )


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
        fits = {name: families.select(fit_all(vcpus, memory_gib, one[mine]), "r2") for name, one in values.items()}
        found.append((np.flatnonzero(machines.gpu == gpu), fits))
    return found


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
        rule=rule,
        latency=Predictions.of_values(latency_s),
        metrics={name: Predictions.of_values(one) for name, one in metrics.items()},
    )
    return Run(
        chosen=selection.best,
        sampled=tuple(meter.sampled),
        paid=meter.paid,
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
    "r2": best_r2,
    "paper": paper,
    "measured": measured,
}
OWN_METHOD = {
    "grid": "model",
    "adaptive": "verified",
    "nested": "verified",
    "random": "model",
    "cherrypick": "measured",
    "full": "measured",
    "best": "measured",
}
