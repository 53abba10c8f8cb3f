"""Samplers: which machines a campaign pays for. Each returns the meter that it paid with."""

import hashlib
from collections.abc import Callable

import numpy as np

from fogspec.evaluation.cherrypick import cherrypick
from fogspec.evaluation.replay import Case, Meter
from fogspec.evaluation.suite import Problem, Setting
from fogspec.numerics.acquisition import Policy, next_wave
from fogspec.numerics.design import edge_grid
from fogspec.numerics.samples import observations

Sampler = Callable[[Case, Setting, int], Meter]
RANDOM_SAMPLES = 9  # as many as the paper's grid has cells


def adaptive(case: Case, setting: Setting, _seed: int) -> Meter:
    """Ours: waves until another sample is not worth its money."""
    meter, objective = case.meter(), case.objective(setting)
    # A sweep without repeats has nothing more to say of a machine.
    policy = Policy(each=min(Policy().each, len(case.noise.factor)))
    posterior = case.space.fit(observations([], []))
    while True:
        wave = next_wave(posterior, objective, sample_cost=case.machines.price_usd_per_hour, policy=policy)
        if not wave.machines:
            return meter
        for machine in wave.machines:
            meter.sample(machine)
        posterior = case.space.fit(observations(meter.sampled, meter.latency_s))


def grid(case: Case, _setting: Setting, _seed: int) -> Meter:
    """The paper's edge cases (section 2.A, Table I), a grid for each GPU type; the cheapest machine of each shape."""
    meter, machines = case.meter(), case.machines
    by_price = np.argsort(machines.price_usd_per_hour, kind="stable")
    for gpu in np.unique(machines.gpu):
        rows = np.flatnonzero(machines.gpu == gpu)
        order = np.searchsorted(rows, by_price[np.isin(by_price, rows)])
        cells = edge_grid(machines.vcpus[rows], machines.memory_gib[rows], order).cells
        for cell in cells:
            if cell.same_as is None:
                meter.sample(int(rows[cell.row]))
    return meter


def random(case: Case, _setting: Setting, seed: int) -> Meter:
    """As many machines as the grid has cells, drawn without replacement."""
    meter = case.meter()
    count = min(RANDOM_SAMPLES, len(case.machines))
    for machine in _generator(case.problem, seed).choice(len(case.machines), count, replace=False):
        meter.sample(int(machine))
    return meter


def full(case: Case, _setting: Setting, _seed: int) -> Meter:
    """Every machine once, as noisy as the samples."""
    meter = case.meter()
    for machine in range(len(case.machines)):
        meter.sample(machine)
    return meter


def _by_improvement(case: Case, setting: Setting, seed: int) -> Meter:
    meter = case.meter()
    cherrypick(case.machines, case.objective(setting), meter.sample, _generator(case.problem, seed))
    return meter


def _generator(problem: Problem, seed: int) -> np.random.Generator:
    digest = hashlib.sha256(f"{seed}|{problem.id}|sampler".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "big"))


SAMPLERS: dict[str, Sampler] = {
    "grid": grid,
    "adaptive": adaptive,
    "random": random,
    "cherrypick": _by_improvement,
    "full": full,
}
