"""A campaign over problems: every setting of every problem once, scored, and summed up by kind."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from fogspec.evaluation.answering import METHODS, OWN_METHOD
from fogspec.evaluation.replay import Case, Noise
from fogspec.evaluation.samplers import SAMPLERS
from fogspec.evaluation.scores import Score, calibration, score, summary
from fogspec.evaluation.suite import KINDS, Problem
from fogspec.model.tables import Table
from fogspec.numerics.priors import Library, prior_for


@dataclass(frozen=True, slots=True)
class Campaign:
    """How problems are worked on; `method` None is the sampler's own."""

    sampler: str = "adaptive"
    method: str | None = None
    noise: str = "realistic"
    seed: int = 0

    @property
    def reads_with(self) -> str:
        """The method's name."""
        return self.method or OWN_METHOD[self.sampler]


@dataclass(frozen=True, slots=True)
class Ended:
    """One problem and setting: what was sampled and chosen, by name, and its score."""

    id: str
    setting: str
    chosen: str | None
    sampled: tuple[str, ...]
    score: Score

    def line(self) -> dict[str, Any]:
        """What anybody needs to score the choice anew."""
        return {"id": self.id, "setting": self.setting, "chosen": self.chosen, "sampled": list(self.sampled)}


def run(problem: Problem, table: Table, library: Library | None, campaign: Campaign) -> list[Ended]:
    """All settings of one problem; the problem's own suite is left out of the library."""
    machines = table.machines.take(problem.rows)
    names = [table.names[row] for row in problem.rows]
    prior = None if library is None else prior_for(library, names, machines, leave_out=[problem.suite])
    case = Case.of(problem, machines, prior, Noise.of(problem, campaign.noise, campaign.seed))
    sample, answer = SAMPLERS[campaign.sampler], METHODS[campaign.reads_with]
    ended = []
    for setting in problem.settings:
        done = answer(case, setting, sample(case, setting, campaign.seed))
        scored = score(problem.kind, done, problem.latency_s, machines.price_usd_per_hour, case.objective(setting))
        chosen = None if done.chosen is None else names[done.chosen]
        ended.append(Ended(problem.id, setting.name, chosen, tuple(names[i] for i in done.sampled), scored))
    return ended


def by_kind(ended: Iterable[Ended]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """A row of scores and one of calibration for each kind of problem."""
    rows: list[dict[str, Any]] = []
    calibrations: list[dict[str, Any]] = []
    everything: Sequence[Ended] = list(ended)
    for kind in KINDS:
        mine = [one for one in everything if one.score.kind == kind]
        if mine:
            scores = [one.score for one in mine]
            rows.append(summary(kind, len({one.id for one in mine}), scores))
            calibrations.append({"kind": kind, "bins": calibration(scores)})
    return rows, calibrations
