"""What a benchmark and the choice after it cost together, for a volume of requests, against benchmarks of a fixed size.

The total is the price of the samples plus the volume times the regret of the choice in USD a request: what its objective is
above the best one's, by the money that the objective weighs against it. A choice that breaks a limit by more than the scores
allow, or none where a machine meets them all, counts as twice the best. Settings in which cost has no weight are left out.
What a benchmark program calls a request is arbitrary: requests are as long that the best machine's objective is worth
`REQUEST_USD`, so that every problem counts alike.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fogspec.choice.rule import Rule, Selection
from fogspec.evaluation.replay import Case
from fogspec.evaluation.scores import TOLERANCE
from fogspec.model.predict import Predictions
from fogspec.numerics.acquisition import Batch, Policy

VOLUMES = tuple(10.0**power for power in range(2, 9))
SIZES = (1, 2, 3, 5, 8, 12, 20, 30)  # of benchmarks of a fixed number of samples
SAMPLE_S = 600.0  # of a machine that is paid for a sample: set-up and measuring as a spec has them by default
REQUEST_USD = 1e-5
WITHOUT_END = 1e12


@dataclass(frozen=True, slots=True)
class Step:
    """A campaign after some samples: their price, the regret of the choice, and what the next sample is expected to save.

    `regret_usd` is for one request; `saving` is that of a request over the price of the next sample, 0 if there is none.
    """

    paid_usd: float
    regret_usd: float
    saving: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Totals:
    """Total costs in USD of one problem and setting: paying for itself (V,), of fixed sizes (sizes, V), and relative."""

    kind: str
    own: tuple[float, ...]
    fixed: tuple[tuple[float, ...], ...]
    relative: tuple[float, ...]


def totals(case: Case, rule: Rule) -> Totals | None:
    """Return the total costs over `VOLUMES`; None where cost has no weight or no machine meets the limits."""
    if rule.alpha == 1 or case.problem.truth(rule).best is None:
        return None
    own = list(_steps(case, replace(rule, measured_first=False), Policy(first=1, worth=WITHOUT_END)))
    greedy = list(
        _steps(case, replace(rule, measured_first=True), Policy(min_gain=1e-9, min_repeat_gain=1e-9, first=1))
    )
    usual = list(_steps(case, replace(rule, measured_first=True), Policy()))[-1]
    ends = [next((one for one in own if one.saving * volume < 1), own[-1]) for volume in VOLUMES]
    return Totals(
        kind=case.problem.kind,
        own=tuple(end.paid_usd + volume * end.regret_usd for end, volume in zip(ends, VOLUMES, strict=True)),
        fixed=tuple(_of(greedy[min(size, len(greedy)) - 1]) for size in SIZES),
        relative=_of(usual),
    )


def _of(step: Step) -> tuple[float, ...]:
    return tuple(step.paid_usd + volume * step.regret_usd for volume in VOLUMES)


def _steps(case: Case, rule: Rule, policy: Policy) -> Iterator[Step]:
    """Yield the state after the first batch and after every further sample, as long as any volume would ask for one."""
    meter, price, truth = case.meter(), case.machines.price_usd_per_hour, case.problem.truth(rule)
    longer = REQUEST_USD / (truth.usd_per_request() or REQUEST_USD)
    while True:
        posterior = case.posterior(meter)
        selection = Selection(rule=rule, latency=Predictions.of_posterior(posterior))
        batch = case.proposed(meter, selection, policy)
        saving = 0.0
        if not batch.machines and rule.measured_first and selection.unverified is not None:
            batch = Batch((selection.unverified,), "verifies the choice")
        worth = selection.usd_per_request()
        if batch.gains and worth is not None:
            saving = batch.gains[0] * worth * longer / (price[batch.machines[0]] * SAMPLE_S / 3600)
        if meter.sampled:
            yield Step(meter.paid * SAMPLE_S / 3600, _regret(case, truth, selection.best) * REQUEST_USD, saving)
        if not batch.machines or (policy.worth is not None and meter.sampled and saving * VOLUMES[-1] < 1):
            return
        case.measure(meter, batch, selection)


def _regret(case: Case, truth: Selection, chosen: int | None) -> float:
    """Return the relative regret of a choice where some machine meets the limits."""
    least = float(truth.objective[truth.best])
    if chosen is None or case.problem.latency_s[chosen] > truth.latency_budget_s[chosen] * (1 + TOLERANCE):
        return 1.0
    return max(float(truth.objective[chosen]) / least - 1, 0.0)


def total_rows(found: Sequence[Totals]) -> list[dict[str, Any]]:
    """Return a row for each kind and volume: mean total costs in USD, and ours over the least of a fixed size."""
    rows = []
    for kind in sorted({one.kind for one in found}):
        mine = [one for one in found if one.kind == kind]
        own, relative = (np.array(some).mean(0) for some in ([one.own for one in mine], [one.relative for one in mine]))
        fixed = np.array([one.fixed for one in mine]).mean(0)
        for v, volume in enumerate(VOLUMES):
            best = int(fixed[:, v].argmin())
            rows.append(
                {
                    "kind": kind,
                    "choices": len(mine),
                    "requests": volume,
                    "own_usd": float(own[v]),
                    "relative_usd": float(relative[v]),
                    "fixed_usd": {str(size): float(usd) for size, usd in zip(SIZES, fixed[:, v], strict=True)},
                    "best_size": SIZES[best],
                    "over_best": float(own[v] / fixed[best, v]),
                }
            )
    return rows
