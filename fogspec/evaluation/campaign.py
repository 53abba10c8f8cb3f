"""Campaigns over problems: every setting once, scored, in a few processes, and summed up by kind."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from fogspec.base.errors import UsageError
from fogspec.base.workers import processes
from fogspec.evaluation.methods import METHODS, OWN_METHOD
from fogspec.evaluation.replay import Case, Noise, Timing
from fogspec.evaluation.samplers import SAMPLERS
from fogspec.evaluation.scores import Score, calibration, median_error, r2, score, staircase_deviation, summary
from fogspec.evaluation.suites import KINDS, Problem, Suite, read_suite
from fogspec.evaluation.sweeps import USD_PER_FREE_VCPU_HOUR, Sweep
from fogspec.evaluation.volumes import Totals, total_rows, totals
from fogspec.model.priors import read_priors
from fogspec.model.tables import Table
from fogspec.numerics.kernels import Floats
from fogspec.numerics.priors import PriorData, prior_for


@dataclass(frozen=True, slots=True)
class Campaign:
    """Sampler and method; `method` None is the sampler's own."""

    sampler: str = "adaptive"
    method: str | None = None
    noise: str = "realistic"
    seed: int = 0

    @property
    def reads_with(self) -> str:
        """The method's name."""
        return self.method or OWN_METHOD[self.sampler]


@dataclass(frozen=True, slots=True)
class Result:
    """One problem and setting: the sampled and chosen machines by name, and the score."""

    id: str
    setting: str
    chosen: str | None
    sampled: tuple[str, ...]
    score: Score

    def as_dict(self) -> dict[str, Any]:
        """Return all that is needed to score the choice again."""
        return {"id": self.id, "setting": self.setting, "chosen": self.chosen, "sampled": list(self.sampled)}


def run(problem: Problem, table: Table, library: PriorData | None, campaign: Campaign) -> list[Result]:
    """Return the results of all settings of one problem; the problem's own suite is left out of the library."""
    case, names = _case(problem, table, library, campaign), [table.names[row] for row in problem.rows]
    sample, answer = SAMPLERS[campaign.sampler], METHODS[campaign.reads_with]
    results = []
    for setting in problem.settings:
        done = answer(case, setting.rule, sample(case, setting.rule, campaign.seed))
        scored = score(problem, setting.rule, case.machines, done)
        chosen = None if done.chosen is None else names[done.chosen]
        results.append(Result(problem.id, setting.name, chosen, tuple(names[i] for i in done.sampled), scored))
    return results


def _case(problem: Problem, table: Table, library: PriorData | None, campaign: Campaign) -> Case:
    machines = table.machines.take(problem.rows)
    names = [table.names[row] for row in problem.rows]
    prior = None if library is None else prior_for(library, names, machines, leave_out=[problem.suite])
    return Case.of(problem, machines, prior, Noise.of(problem, campaign.noise, campaign.seed), Timing())


@dataclass(frozen=True, slots=True, kw_only=True)
class Replayed:
    """One campaign on a sweep: its scores, and what it predicted (N,) of the objective's metric.

    `fraction` is the price of the samples over that of the whole sweep; `regret` is None for a choice that breaks a limit, or
    for none.
    """

    campaign: Campaign
    report: dict[str, Any]
    row: dict[str, Any]
    predicted: Floats
    sampled: tuple[int, ...]
    fraction: float
    regret: float | None


def replays(sweep: Sweep, sampler: str) -> bool:
    """Return whether a sampler can be replayed on a sweep: CherryPick weighs no metrics, and a sweep has no nested shapes."""
    return sampler != "nested" and not (sampler == "cherrypick" and sweep.problem.metrics)


def replay_sweep(sweep: Sweep, library: PriorData | None, window_s: float, campaign: Campaign) -> Replayed:
    """Return one campaign on a sweep (the paper, section 4); a sample is paid for `window_s` seconds.

    `priors` is the library's digest if it says anything of the machines. Raise UsageError for
    a sampler that this sweep cannot replay.
    """
    problem, names = sweep.problem, sweep.names
    prior = prior_for(library, names, sweep.machines) if library else None
    noise = Noise.of(problem, "none", 0) if campaign.noise == "none" else sweep.repeats
    case = Case.of(problem, sweep.machines, prior, noise)
    rule = problem.settings[0].rule
    if not replays(sweep, campaign.sampler):
        why = "needs measurements of parts of machines" if campaign.sampler == "nested" else "weighs the latency only"
        raise UsageError(
            f"sampler {campaign.sampler} {why}, which a sweep of this spec does not have", "--sampler adaptive"
        )
    done = METHODS[campaign.reads_with](case, rule, SAMPLERS[campaign.sampler](case, rule, campaign.seed))
    price, usd = sweep.machines.price_usd_per_hour, window_s / 3600
    scored, best = score(problem, rule, sweep.machines, done), problem.truth(rule).best
    predicted = {"latency": np.exp(done.log_latency), **done.metrics}
    known = {"latency": problem.latency_s, **problem.metrics}
    of_metrics = {
        name: {
            "mdape": median_error(predicted[name], truth, done.sampled),
            "r2": r2(predicted[name], truth),
            "frontier_deviation": staircase_deviation(predicted[name], truth, price),
        }
        for name, truth in known.items()
    }
    report = {
        "priors": library.digest if prior and library else None,
        "not_admitted": list(sweep.left_out),
        "not_measured": list(sweep.unmeasured),
        "prices": f"free machines count as ${USD_PER_FREE_VCPU_HOUR:g} per vCPU and hour" if sweep.free else None,
        "machines": len(names),
        "chosen": None if done.chosen is None else names[done.chosen],
        "best": None if best is None else names[best],
        "sampled": [names[i] for i in done.sampled],
        "samples": scored.samples,
        "cost_usd": done.paid * usd,
        "full_sweep_usd": float(price.sum()) * usd,
        **scored.as_dict(),
        **{name: value for name, value in of_metrics.pop("latency").items() if name != "mdape"},
        "metrics": of_metrics,
    }
    return Replayed(
        campaign=campaign,
        report=report,
        row=summary(problem.kind, 1, [scored]),
        predicted=predicted[rule.metric or "latency"],
        sampled=done.sampled,
        fraction=scored.bench,
        regret=float(scored.regret) if np.isfinite(scored.regret) else None,
    )


def by_kind(results: Iterable[Result]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return a row of scores and one of calibration for each kind of problem."""
    rows: list[dict[str, Any]] = []
    calibrations: list[dict[str, Any]] = []
    everything: Sequence[Result] = list(results)
    for kind in KINDS:
        mine = [one for one in everything if one.score.kind == kind]
        if mine:
            scores = [one.score for one in mine]
            rows.append(summary(kind, len({one.id for one in mine}), scores))
            calibrations.append({"kind": kind, "bins": calibration(scores)})
    return rows, calibrations


def evaluate(
    suite: Path, priors: Path | None, kinds: Sequence[str], campaigns: Sequence[Campaign], *, workers: int = 2
) -> tuple[list[list[Result]], str]:
    """Return the results of each campaign on the problems of these kinds (all if empty), and the priors' digest or ''.

    The numbers do not depend on the number of workers. Linear algebra runs in one thread a process: two processes of two
    threads are slower than two of one, and sums would depend on the machine. Raise DiagnosticError and InvalidInput for
    errors in the files.
    """
    data = _Data.read(suite, priors)
    found = _in_processes(run, data, suite, priors, kinds, campaigns, workers)
    return [[one for ended in of_it for one in ended] for of_it in found], data.library.digest if data.library else ""


def evaluate_volumes(
    suite: Path, priors: Path | None, kinds: Sequence[str], seed: int, noise: str, *, workers: int = 2
) -> list[dict[str, Any]]:
    """Return the rows of total costs by kind and volume; arguments and errors as of `evaluate`."""
    data = _Data.read(suite, priors)
    campaign = Campaign(noise=noise, seed=seed)
    (found,) = _in_processes(all_totals, data, suite, priors, kinds, [campaign], workers)
    return total_rows([one for ended in found for one in ended])


def all_totals(problem: Problem, table: Table, library: PriorData | None, campaign: Campaign) -> list[Totals]:
    """Return the total costs of all settings of one problem in which cost has a weight."""
    case = _case(problem, table, library, campaign)
    found = (totals(case, setting.rule) for setting in problem.settings)
    return [one for one in found if one is not None]


T = TypeVar("T")
Job = Callable[[Problem, Table, PriorData | None, Campaign], list[T]]


def _in_processes(
    job: Job[T],
    data: "_Data",
    suite: Path,
    priors: Path | None,
    kinds: Sequence[str],
    campaigns: Sequence[Campaign],
    workers: int,
) -> list[list[list[T]]]:
    """Return what the job returns by campaign and problem."""
    wanted = [i for i, problem in enumerate(data.suite.problems) if not kinds or problem.kind in kinds]
    # The longest first: the other process does not wait for one at the end.
    order = sorted(wanted, key=lambda i: -len(data.suite.problems[i].rows))
    jobs = [(campaign, i) for campaign in campaigns for i in order]
    if not jobs:
        return [[] for _ in campaigns]
    with processes(workers, _start, (suite, priors)) as pool:
        found = dict(zip(jobs, pool.map(partial(_run, job), *zip(*jobs, strict=True)), strict=True))
    return [[found[campaign, i] for i in wanted] for campaign in campaigns]


@dataclass
class _Data:
    """The files that each process reads once."""

    suite: Suite
    library: PriorData | None

    @classmethod
    def read(cls, suite: Path, priors: Path | None) -> "_Data":
        return cls(read_suite(suite), read_priors(priors) if priors else None)


_data: list[_Data] = []  # of this process


def _start(suite: Path, priors: Path | None) -> None:
    _data[:] = [_Data.read(suite, priors)]


def _run(job: Job[T], campaign: Campaign, index: int) -> list[T]:
    (data,) = _data
    return job(data.suite.problems[index], data.suite.table, data.library, campaign)
