"""Campaigns over problems: every setting once, scored, in a few processes, and summed up by kind."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fogspec.base.errors import UsageError
from fogspec.base.workers import processes
from fogspec.numerics.priors import PriorData, prior_for
from fogspec_lab.evaluation.methods import METHODS, OWN_METHOD
from fogspec_lab.evaluation.replay import Bill, Case, Noise, Timing
from fogspec_lab.evaluation.samplers import SAMPLERS
from fogspec_lab.evaluation.scores import Score, calibration, median_error, score, summary
from fogspec_lab.evaluation.suites import KINDS, Problem, Suite, read_suite
from fogspec_lab.evaluation.sweeps import USD_PER_FREE_VCPU_HOUR, Sweep
from fogspec_lab.libraries import library_named
from fogspec_lab.tables import Table


@dataclass(frozen=True, slots=True)
class Campaign:
    """Sampler and method; `method` None is the sampler's own. With `path` every batch's choice is scored, not only the last."""

    sampler: str = "adaptive"
    method: str | None = None
    noise: str = "realistic"
    seed: int = 0
    path: bool = False

    @property
    def reads_with(self) -> str:
        """The method's name."""
        return self.method or OWN_METHOD[self.sampler]

    def as_dict(self) -> dict[str, Any]:
        """Return what tells this campaign from others."""
        return {"sampler": self.sampler, "method": self.reads_with, "noise": self.noise, "seed": self.seed}


@dataclass(frozen=True, slots=True)
class Result:
    """One problem and setting of a campaign: the sampled and chosen machines by name, the bill and the score.

    `path` is the score after each batch, of one batch after each sample; it is empty unless the campaign has one.
    """

    campaign: Campaign
    id: str
    setting: str
    chosen: str | None
    sampled: tuple[str, ...]
    bill: Bill
    score: Score
    path: tuple[Score, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return all that is needed to score the choice again, and to bill its samples: seconds include set-up."""
        return {
            **self.campaign.as_dict(),
            "id": self.id,
            "setting": self.setting,
            "chosen": self.chosen,
            "sampled": list(self.sampled),
            "seconds": [round(one, 1) for one in self.bill.seconds],
            "batch": list(self.bill.batch),
        }


def run(problem: Problem, table: Table, library: PriorData | None, campaign: Campaign) -> list[Result]:
    """Return the results of all settings of one problem; the problem's own suite is left out of the library."""
    case, names = _case(problem, table, library, campaign), [table.names[row] for row in problem.rows]
    sample, answer = SAMPLERS[campaign.sampler], METHODS[campaign.reads_with]
    results = []
    for setting in problem.settings:
        rule, meter = setting.rule, sample(case, setting.rule, campaign.seed)
        done = answer(case, rule, meter)
        scored = score(problem, rule, case.machines, done)
        counts = meter.steps if campaign.path else ()
        path = tuple(score(problem, rule, case.machines, answer(case, rule, meter.until(count))) for count in counts)
        chosen = None if done.chosen is None else names[done.chosen]
        sampled = tuple(names[i] for i in done.bill.sampled)
        results.append(Result(campaign, problem.id, setting.name, chosen, sampled, done.bill, scored, path))
    return results


def _case(problem: Problem, table: Table, library: PriorData | None, campaign: Campaign) -> Case:
    machines = table.machines.take(problem.rows)
    names = [table.names[row] for row in problem.rows]
    prior = None if library is None else prior_for(library, names, machines, leave_out=[problem.suite])
    return Case.of(problem, machines, prior, Noise.of(problem, campaign.noise, campaign.seed), Timing())


@dataclass(frozen=True, slots=True, kw_only=True)
class Replayed:
    """One campaign on a sweep: what it did and what that scores, and its row in a table."""

    campaign: Campaign
    report: dict[str, Any]
    row: dict[str, Any]


def replays(sweep: Sweep, sampler: str) -> bool:
    """Return whether a sampler can be replayed on a sweep: CherryPick weighs no metrics."""
    return not (sampler == "cherrypick" and sweep.problem.metrics)


def replay_sweep(sweep: Sweep, library: PriorData | None, campaign: Campaign) -> Replayed:
    """Return one campaign on a sweep (the paper, section 4), whose samples run to their end.

    `library` is the library's digest if it says anything of the machines. Raise UsageError for
    a sampler that this sweep cannot replay.
    """
    problem, names = sweep.problem, sweep.names
    prior = prior_for(library, names, sweep.machines) if library else None
    noise = Noise.of(problem, "none", 0) if campaign.noise == "none" else sweep.repeats
    case = Case.of(problem, sweep.machines, prior, noise, sweep.timing)
    rule = problem.settings[0].rule
    if not replays(sweep, campaign.sampler):
        raise UsageError(
            f"sampler {campaign.sampler} weighs the latency only, and this spec has metrics", "--sampler adaptive"
        )
    done = METHODS[campaign.reads_with](case, rule, SAMPLERS[campaign.sampler](case, rule, campaign.seed))
    bill = done.bill
    scored, best = score(problem, rule, sweep.machines, done), problem.truth(rule).best
    predicted = {"latency": np.exp(done.log_latency), **done.metrics}
    errors = {name: median_error(predicted[name], truth, bill.sampled) for name, truth in problem.metrics.items()}
    report = {
        "library": library.digest if prior and library else None,
        "not_admitted": list(sweep.left_out),
        "not_measured": list(sweep.unmeasured),
        "prices": f"free machines count as ${USD_PER_FREE_VCPU_HOUR:g} per vCPU and hour" if sweep.free else None,
        "machines": len(names),
        "chosen": None if done.chosen is None else names[done.chosen],
        "best": None if best is None else names[best],
        "sampled": [names[i] for i in bill.sampled],
        "samples": scored.samples,
        "full_sweep_usd": bill.sweep_usd,
        **scored.as_dict(),
        "metrics": {name: {"mdape": error} for name, error in errors.items()},
    }
    return Replayed(campaign=campaign, report=report, row=summary(problem.kind, [scored]))


def by_kind(results: Iterable[Result]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return a row of scores and one of calibration for each kind of problem."""
    rows: list[dict[str, Any]] = []
    calibrations: list[dict[str, Any]] = []
    everything: Sequence[Result] = list(results)
    for kind in KINDS:
        mine = [one for one in everything if one.score.kind == kind]
        if mine:
            scores = [one.score for one in mine]
            rows.append(summary(kind, scores))
            calibrations.append({"kind": kind, "bins": calibration(scores)})
    return rows, calibrations


def evaluate(
    suite: Path, library: str | None, kinds: Sequence[str], campaigns: Sequence[Campaign], *, workers: int = 2
) -> Iterator[list[Result]]:
    """Yield the results of each campaign on each problem of these kinds (all if empty), as they end.

    The order is the same for any number of workers, and so are the numbers. Linear algebra runs in one thread a process: two
    processes of two threads are slower than two of one, and sums would depend on the machine. Raise DiagnosticError and
    InvalidInput for errors in the files.
    """
    data = _Data.read(suite, library)
    wanted = [i for i, problem in enumerate(data.suite.problems) if not kinds or problem.kind in kinds]
    # The longest first: the other process does not wait for one at the end.
    wanted.sort(key=lambda i: -len(data.suite.problems[i].rows))
    jobs = [(campaign, i) for campaign in campaigns for i in wanted]
    if jobs:
        with processes(workers, _start, (suite, library)) as pool:
            yield from pool.map(_run, *zip(*jobs, strict=True))


@dataclass
class _Data:
    """The files that each process reads once."""

    suite: Suite
    library: PriorData | None

    @classmethod
    def read(cls, suite: Path, library: str | None) -> "_Data":
        return cls(read_suite(suite), library_named(library))


_data: list[_Data] = []  # of this process


def _start(suite: Path, library: str | None) -> None:
    _data[:] = [_Data.read(suite, library)]


def _run(campaign: Campaign, index: int) -> list[Result]:
    (data,) = _data
    return run(data.suite.problems[index], data.suite.table, data.library, campaign)
