"""Samplers: the machines that a campaign pays for. Each returns the meter that it paid to."""

import hashlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fogspec.choice.rule import Rule
from fogspec.evaluation.cherrypick import cherrypick
from fogspec.evaluation.replay import Case, Meter, nested_factors
from fogspec.evaluation.suites import Problem
from fogspec.numerics.acquisition import Batch, Policy
from fogspec.numerics.design import edge_grid
from fogspec.numerics.nested import Parts

Sampler = Callable[[Case, Rule, int], Meter]
NESTED_SHARE = (
    0.13  # of the price of a sample, for a part: a minute, beside 159 s of boot and image and 300 s of measuring
)
RANDOM_SAMPLES = 9  # as many as the paper's grid has cells


def adaptive(case: Case, rule: Rule, _seed: int) -> Meter:
    """Ours: batches until another sample is not worth its price and the choice was measured."""
    return _adaptive(rule, case, case.meter())


def nested(case: Case, rule: Rule, seed: int) -> Meter:
    """Ours, where a machine that is sampled is also measured as its half, quarter and eighth where that pays."""
    parts = Parts.of(case.machines, NESTED_SHARE)
    return _adaptive(rule, case, case.meter(parts, nested_factors(case.problem, case.machines, seed)))


def _adaptive(rule: Rule, case: Case, meter: Meter) -> Meter:
    rule = replace(rule, measured_first=True)
    # A sweep without repeats has nothing more to say of a machine.
    policy = Policy(each=min(Policy().each, len(case.noise.factor)))
    while True:
        selection = case.selection(meter, rule)
        batch = case.proposed(meter, selection, policy)
        if not batch.machines and selection.unverified is not None:
            batch = Batch((selection.unverified,), "verifies the choice")
        if not batch.machines:
            return meter
        case.measure(meter, batch, selection)


def grid(case: Case, _rule: Rule, _seed: int) -> Meter:
    """Sample the paper's edge cases (section 2.A, Table I), a grid for each GPU type; the cheapest machine of each shape."""
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


def random(case: Case, _rule: Rule, seed: int) -> Meter:
    """As many machines as the grid has cells, drawn without replacement."""
    meter = case.meter()
    count = min(RANDOM_SAMPLES, len(case.machines))
    for machine in _generator(case.problem, seed).choice(len(case.machines), count, replace=False):
        meter.sample(int(machine))
    return meter


def full(case: Case, _rule: Rule, _seed: int) -> Meter:
    """Every machine once, as noisy as the samples."""
    meter = case.meter()
    for machine in range(len(case.machines)):
        meter.sample(machine)
    return meter


def best(case: Case, rule: Rule, _seed: int) -> Meter:
    """Sample the truly best machine alone: the floor of what sampling costs; none where none meets the limits."""
    meter, found = case.meter(), case.problem.truth(rule).best
    if found is not None:
        meter.sample(found)
    return meter


def _cherrypick(case: Case, rule: Rule, seed: int) -> Meter:
    meter, truth = case.meter(), case.problem.truth(rule)
    cherrypick(case.machines, rule, truth.scale, meter.sample, _generator(case.problem, seed))
    return meter


def _generator(problem: Problem, seed: int) -> np.random.Generator:
    digest = hashlib.sha256(f"{seed}|{problem.id}|sampler".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "big"))


SAMPLERS: dict[str, Sampler] = {
    "grid": grid,
    "adaptive": adaptive,
    "nested": nested,
    "random": random,
    "cherrypick": _cherrypick,
    "full": full,
    "best": best,
}
