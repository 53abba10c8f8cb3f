"""Methods: what is read from the samples that were paid for. Each ends with a choice and predictions."""

from collections.abc import Callable

import numpy as np

from fogspec.evaluation.replay import Case, Meter, Run
from fogspec.evaluation.suite import Setting
from fogspec.numerics import fitting, relaxed
from fogspec.numerics.acquisition import choose
from fogspec.numerics.families import Fit, fit_all
from fogspec.numerics.features import Floats
from fogspec.numerics.samples import observations

Method = Callable[[Case, Setting, Meter], Run]


def model(case: Case, setting: Setting, meter: Meter) -> Run:
    """Ours without verification: any machine may be chosen."""
    return _modelled(case, setting, meter, measured_only=False)


def verified(case: Case, setting: Setting, meter: Meter) -> Run:
    """Ours: a machine that was measured is chosen while one qualifies."""
    return _modelled(case, setting, meter, measured_only=True)


def _modelled(case: Case, setting: Setting, meter: Meter, *, measured_only: bool) -> Run:
    objective = case.objective(setting)
    posterior = case.space.fit(observations(meter.sampled, meter.latency_s))
    return Run(
        choose(posterior, objective, measured_only=measured_only).machine, tuple(meter.sampled), meter.paid,
        posterior.mean, np.log(posterior.quantile(0.05)), np.log(posterior.quantile(0.95)),
        posterior.probability_below(objective.limit_s),
    )  # fmt: skip


def measured(case: Case, setting: Setting, meter: Meter) -> Run:
    """No model: the best of the machines that were measured, at what was measured."""
    return _answer(case, setting, meter, _known(case, meter))


def best_r2(case: Case, setting: Setting, meter: Meter) -> Run:
    """The paper's fits, one for each GPU type by the best R² (section 2.C), every machine enumerated at its price."""
    latency = np.full(len(case.machines), np.nan)
    for rows, fit in _fits(case, meter):
        latency[rows] = fit.predict(case.machines.vcpus[rows], case.machines.memory_gib[rows])
    latency = np.where(latency > 0, latency, np.nan)
    known = _known(case, meter)
    return _answer(case, setting, meter, np.where(np.isnan(known), latency, known))


def paper(case: Case, setting: Setting, meter: Meter) -> Run:
    """The paper as it is: the best R², its relaxed optimum, and the best of the admissible neighbours (section 2.E)."""
    machines, problem, objective = case.machines, case.problem, case.objective(setting)
    latency, near = np.full(len(machines), np.nan), np.zeros(len(machines), dtype=bool)
    for rows, fit in _fits(case, meter):
        c, m = machines.vcpus[rows], machines.memory_gib[rows]
        latency[rows] = fit.predict(c, m)
        price = relaxed.price_surface(c, m, machines.price_usd_per_hour[rows])

        def cost(x: Floats, y: Floats, fit: Fit = fit, price: relaxed.Surface = price) -> Floats:
            hourly, rate = price(x, y) / 3600, setting.requests_per_second
            return hourly * fit.predict(x, y) if rate is None else hourly / rate

        def value(x: Floats, y: Floats, fit: Fit = fit, cost: relaxed.Surface = cost) -> Floats:
            weighed = setting.alpha * fit.predict(x, y) / problem.scale_latency_s
            return weighed + (1 - setting.alpha) * cost(x, y) / problem.scale_cost_usd

        def feasible(x: Floats, y: Floats, fit: Fit = fit, cost: relaxed.Surface = cost) -> np.ndarray:
            within = (fit.predict(x, y) > 0) & (fit.predict(x, y) <= (setting.max_latency_s or np.inf))
            return np.asarray(within & (cost(x, y) <= (setting.max_cost_usd_per_request or np.inf)))

        optimum = relaxed.minimise(value, feasible, relaxed.box_of(c, m))
        if optimum is not None:
            near[rows[relaxed.neighbours(optimum, c, m)]] = True
    latency = np.where(latency > 0, latency, np.nan)
    run = _answer(case, setting, meter, np.where(near, latency, np.nan))
    return Run(run.chosen, run.sampled, run.paid, np.log(latency), run.low, run.high, _met(latency, objective.limit_s))


def _fits(case: Case, meter: Meter) -> list[tuple[np.ndarray, Fit]]:
    """Rows of the machines of each GPU type that was sampled, and the fit for them."""
    machines = case.machines
    at, latency = np.array(meter.sampled, dtype=np.intp), np.array(meter.latency_s)
    found = []
    for gpu in np.unique(machines.gpu[at]):
        mine = machines.gpu[at] == gpu
        fits = fit_all(machines.vcpus[at[mine]], machines.memory_gib[at[mine]], latency[mine])
        found.append((np.flatnonzero(machines.gpu == gpu), fitting.select(fits, "r2")))
    return found


def _known(case: Case, meter: Meter) -> Floats:
    """The mean of what was measured on each machine, NaN where nothing was."""
    total, count = np.zeros(len(case.machines)), np.zeros(len(case.machines))
    np.add.at(total, meter.sampled, meter.latency_s)
    np.add.at(count, meter.sampled, 1)
    with np.errstate(invalid="ignore"):
        return np.asarray(total / count)


def _answer(case: Case, setting: Setting, meter: Meter, latency_s: Floats) -> Run:
    """The best machine if these latencies were the truth; no intervals."""
    objective = case.objective(setting)
    met = latency_s <= objective.limit_s
    value = np.where(met, objective.value(latency_s), np.inf)
    none = np.full(len(latency_s), np.nan)
    chosen = int(value.argmin()) if met.any() else None
    known = np.log(latency_s)
    return Run(chosen, tuple(meter.sampled), meter.paid, known, none, none, _met(latency_s, objective.limit_s))


def _met(latency_s: Floats, limit_s: Floats) -> Floats:
    return np.where(np.isnan(latency_s), np.nan, (latency_s <= limit_s).astype(float))


METHODS: dict[str, Method] = {
    "model": model,
    "verified": verified,
    "r2": best_r2,
    "paper": paper,
    "measured": measured,
}
OWN_METHOD = {"grid": "model", "adaptive": "verified", "random": "model", "cherrypick": "measured", "full": "measured"}
