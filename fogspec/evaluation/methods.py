"""Methods: predictions from the paid samples, and the choice by the rule that ships (`fogspec.choice.rule`)."""

from collections.abc import Callable
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
    posterior = case.posterior(meter)
    selection = Selection(rule=rule, latency=Predictions.of_posterior(posterior))
    return Run(
        chosen=selection.best,
        sampled=tuple(meter.sampled),
        paid=meter.paid,
        log_latency=posterior.mean,
        low=np.log(posterior.elsewhere.quantile(0.05)),
        high=np.log(posterior.elsewhere.quantile(0.95)),
        probability_met=posterior.probability_below(selection.latency_budget_s),
    )


def measured(case: Case, rule: Rule, meter: Meter) -> Run:
    """No model: the best of the measured machines at their measured latencies."""
    return _by_values(case, rule, meter, _measured_mean_s(case, meter))


def best_r2(case: Case, rule: Rule, meter: Meter) -> Run:
    """Choose by the paper's fits, one for each GPU type by the best R² (section 2.C), every machine enumerated at its price."""
    latency = np.full(len(case.machines), np.nan)
    for rows, fit in _fits(case, meter):
        latency[rows] = fit.predict(case.machines.vcpus[rows], case.machines.memory_gib[rows])
    latency = np.where(latency > 0, latency, np.nan)
    known = _measured_mean_s(case, meter)
    return _by_values(case, rule, meter, np.where(np.isnan(known), latency, known))


def paper(case: Case, rule: Rule, meter: Meter) -> Run:
    """Choose as the paper does: the best R², its relaxed optimum, and the best of the admissible neighbours (section 2.E)."""
    machines, scale = case.machines, case.problem.truth(rule).scale
    latency, near = np.full(len(machines), np.nan), np.zeros(len(machines), dtype=bool)
    for rows, fit in _fits(case, meter):
        vcpus, memory_gib = machines.vcpus[rows], machines.memory_gib[rows]
        latency[rows] = fit.predict(vcpus, memory_gib)
        found = relax(rule.take(rows), scale, vcpus, memory_gib, {"latency": fit.predict})
        if found is not None:
            near[rows[found[1]]] = True
    latency = np.where(latency > 0, latency, np.nan)
    run = _by_values(case, rule, meter, np.where(near, latency, np.nan))
    return replace(run, log_latency=np.log(latency), probability_met=_met(latency, rule))


def _fits(case: Case, meter: Meter) -> list[tuple[np.ndarray, Fit]]:
    """Return the rows of the machines of each sampled GPU type, and the fit for them."""
    machines = case.machines
    at, latency = np.array(meter.sampled, dtype=np.intp), np.array(meter.latency_s)
    found = []
    for gpu in np.unique(machines.gpu[at]):
        mine = machines.gpu[at] == gpu
        fits = fit_all(machines.vcpus[at[mine]], machines.memory_gib[at[mine]], latency[mine])
        found.append((np.flatnonzero(machines.gpu == gpu), families.select(fits, "r2")))
    return found


def _measured_mean_s(case: Case, meter: Meter) -> Floats:
    """Return the mean of the samples of each machine, NaN without one."""
    total, count = np.zeros(len(case.machines)), np.zeros(len(case.machines))
    np.add.at(total, meter.sampled, meter.latency_s)
    np.add.at(count, meter.sampled, 1)
    with np.errstate(invalid="ignore"):
        return np.asarray(total / count)


def _by_values(case: Case, rule: Rule, meter: Meter, latency_s: Floats) -> Run:
    """Return the choice if these latencies were exact; there are no intervals."""
    unknown = np.full(len(case.machines), np.nan)
    return Run(
        chosen=Selection(rule=rule, latency=Predictions.of_values(latency_s)).best,
        sampled=tuple(meter.sampled),
        paid=meter.paid,
        log_latency=np.log(latency_s),
        low=unknown,
        high=unknown,
        probability_met=_met(latency_s, rule),
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
