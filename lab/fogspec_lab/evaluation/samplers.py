"""Samplers: the machines that a campaign pays for. Each returns the meter that it paid to."""

import hashlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fogspec.choice.outlook import chances, deciding
from fogspec.choice.rule import Rule
from fogspec.language.schema import Benchmark
from fogspec.numerics.acquisition import Batch, Policy
from fogspec.numerics.design import edge_grid
from fogspec_lab.evaluation.cherrypick import cherrypick
from fogspec_lab.evaluation.replay import Case, Meter
from fogspec_lab.evaluation.suites import Problem

Sampler = Callable[[Case, Rule, int], Meter]
RANDOM_SAMPLES = 9  # as many as the paper's grid has cells


def adaptive(case: Case, rule: Rule, _seed: int) -> Meter:
    """Ours: batches until another sample is not worth its price and the choice was measured."""
    meter, rule = case.meter(), replace(rule, measured_first=True)
    # A sweep without repeats has nothing more to say of a machine.
    policy = Policy(each=min(Policy().each, len(case.noise.factor)), batch=Benchmark().batch_size)
    while True:
        selection = case.selection(meter, rule)
        batch = case.proposed(meter, selection, policy)
        if not batch.machines and selection.bounds and not selection.feasible.any():
            possible = case.posterior(meter).samples < policy.each
            everything = np.arange(len(case.machines))
            one = deciding(chances(selection, everything), case.machines.price_usd_per_hour, possible)
            batch = batch if one is None else Batch((one,), "may settle")
        if not batch.machines and selection.unverified is not None:
            batch = Batch((selection.unverified,), "verifies the choice")
        if not batch.machines:
            return meter
        case.measure(meter, batch, selection)


def grid(case: Case, _rule: Rule, _seed: int) -> Meter:
    """Sample the paper's edge cases (section 2.A, Table I), a grid for each GPU type; the cheapest machine of each shape."""
    meter, machines, found = case.meter(), case.machines, list[int]()
    by_price = np.argsort(machines.price_usd_per_hour, kind="stable")
    for gpu in np.unique(machines.gpu):
        rows = np.flatnonzero(machines.gpu == gpu)
        order = np.searchsorted(rows, by_price[np.isin(by_price, rows)])
        cells = edge_grid(machines.vcpus[rows], machines.memory_gib[rows], order).cells
        found += [int(rows[cell.row]) for cell in cells if cell.same_as is None]
    meter.measure(found)
    return meter


def random(case: Case, _rule: Rule, seed: int) -> Meter:
    """As many machines as the grid has cells, drawn without replacement."""
    meter = case.meter()
    count = min(RANDOM_SAMPLES, len(case.machines))
    meter.measure(_generator(case.problem, seed).choice(len(case.machines), count, replace=False).tolist())
    return meter


def full(case: Case, _rule: Rule, _seed: int) -> Meter:
    """Every machine once, as noisy as the samples."""
    meter = case.meter()
    meter.measure(range(len(case.machines)))
    return meter


def best(case: Case, rule: Rule, _seed: int) -> Meter:
    """Sample the truly best machine alone: the floor of what sampling costs; none where none meets the limits."""
    meter, found = case.meter(), case.problem.truth(rule, case.machines).best
    if found is not None:
        meter.measure([found])
    return meter


def _cherrypick(case: Case, rule: Rule, seed: int) -> Meter:
    meter, truth = case.meter(), case.problem.truth(rule)
    cherrypick(case.machines, rule, truth.scale, meter.measure, _generator(case.problem, seed))
    return meter


def _generator(problem: Problem, seed: int) -> np.random.Generator:
    digest = hashlib.sha256(f"{seed}|{problem.id}|sampler".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "big"))


SAMPLERS: dict[str, Sampler] = {
    "grid": grid,
    "adaptive": adaptive,
    "random": random,
    "cherrypick": _cherrypick,
    "full": full,
    "best": best,
}
