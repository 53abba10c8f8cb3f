"""Sensitivity of the choice to its limits and samples, and the machines with the widest intervals."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fogspec.choice.choose import Choice, choose
from fogspec.language.schema import Application
from fogspec.model.fit import Fitted, Observation
from fogspec.model.predict import PredictionSet, PredictionSpace

LEVEL = 0.9
CONFIDENCES = (0.5, 0.8, 0.9, 0.95, 0.99)


@dataclass(frozen=True, slots=True, kw_only=True)
class Slack:
    """One limit at the choice.

    `value` is predicted; `required` is the lowest bound that the chosen machine meets with the required probability.
    `rules_out_alone` counts machines that only this limit excludes; `changes_at` is how far it
    would have to be relaxed for a better one of these, `changes_to`, to be chosen; None if none is better.
    """

    limit: str
    unit: str
    bound: float
    value: float
    required: float
    rules_out_alone: int
    changes_at: float | None
    changes_to: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Influence:
    """The effect of leaving one sample out on the choice and the predictions.

    `moves` is the median relative change over all machines, `missed_by` the relative error of the prediction of this
    machine from the others, `covered` whether the measurement lies in that prediction's interval at `LEVEL`.
    """

    id: str
    changes_to: str | None
    changes: bool
    moves: float
    missed_by: float
    covered: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class OtherConfidence:
    """What would be chosen with another confidence, and its cost and latency relative to those of the choice.

    `row` is None if no machine reaches this confidence; `cost` and `latency` are None then.
    """

    confidence: float
    row: int | None
    cost: float | None = None
    latency: float | None = None


@dataclass(frozen=True, slots=True)
class WideInterval:
    """A machine with a wide interval, as the ratio of its ends, among those that could be the choice."""

    row: int
    ratio: float


def slacks(choice: Choice) -> list[Slack]:
    """Return the slack of every limit at the chosen machine; empty without a choice."""
    row = choice.chosen
    if row is None:
        return []
    required = choice.required(choice.confidence)
    found = []
    for name, bound in choice.bounds.items():
        others = choice.eligible.copy()
        for other, limit in choice.bounds.items():
            if other != name:
                others &= required[other] <= limit
        alone = others & ~(required[name] <= bound)
        better = np.flatnonzero(alone & (choice.objective < choice.objective[row]))
        next_row = int(better[np.argmin(required[name][better])]) if len(better) else None
        found.append(
            Slack(
                limit=name,
                unit=choice.rule.unit_of(name),
                bound=bound,
                value=float(choice.values[name][row]),
                required=float(required[name][row]),
                rules_out_alone=int(alone.sum()),
                changes_at=None if next_row is None else float(required[name][next_row]),
                changes_to=None if next_row is None else str(choice.offers.instance[next_row]),
            )
        )
    return found


def other_confidences(choice: Choice) -> list[OtherConfidence]:
    """Return the nearest lower and the nearest higher of `CONFIDENCES` with another choice, as far as there are any.

    Empty without limits, probabilities or a choice.
    """
    row = choice.chosen
    required = choice.confidence
    if (
        row is None
        or choice.by_relaxation
        or not choice.bounds
        or required is None
        or choice.latency.distribution is None
    ):
        return []
    lower = [_at_confidence(choice, row, one) for one in reversed(CONFIDENCES) if one < required]
    higher = [_at_confidence(choice, row, one) for one in CONFIDENCES if one > required]
    return [one for some in (lower, higher) if (one := next((one for one in some if one.row != row), None))]


def _at_confidence(choice: Choice, row: int, confidence: float) -> OtherConfidence:
    other = replace(choice, rule=replace(choice.rule, confidence=confidence))
    found = other.chosen
    if found is None:
        return OtherConfidence(confidence=confidence, row=None)
    cost, latency = choice.cost_usd_per_request, choice.latency.value
    return OtherConfidence(
        confidence=confidence,
        row=found,
        cost=float(cost[found] / cost[row]) if cost[row] else 1.0,
        latency=float(latency[found] / latency[row]),
    )


@dataclass
class Refits:
    """Predictions from some of the samples, each combination of samples fitted once.

    `space` is that of the full model; None if curves predict, which are not refitted.
    """

    space: PredictionSpace | None
    models: Fitted
    targets: Sequence[str]
    _known: dict[tuple[str, ...], PredictionSet] = field(default_factory=dict)

    def of(self, samples: Sequence[Observation]) -> PredictionSet | None:
        """Return the predictions from these of the samples alone; None if curves predict."""
        if self.space is None:
            return None
        key = tuple(one.id for one in samples)
        if key not in self._known:
            self._known[key] = self.space.predicted(samples, self.models.rejected, self.targets)
        return self._known[key]


def influences(application: Application, models: Fitted, refits: Refits, choice: Choice) -> list[Influence]:
    """Return the influence of each sample: those that change the choice first, then those that move predictions most."""
    if len(models.observations) < 2:
        return []
    found = []
    for left_out in models.observations:
        predicted = refits.of([one for one in models.observations if one is not left_out])
        if predicted is not None:
            found.append(_influence(application, predicted, left_out, choice))
    return sorted(found, key=lambda one: (not one.changes, -round(one.moves, 6), one.id))


def _influence(application: Application, predicted: PredictionSet, left_out: Observation, choice: Choice) -> Influence:
    without = choose(application, predicted)
    both = np.isfinite(choice.latency.value) & np.isfinite(without.latency.value)
    moved = np.abs(np.log(without.latency.value[both] / choice.latency.value[both]))
    name = None if without.chosen is None else str(without.offers.instance[without.chosen])
    now = None if choice.chosen is None else str(choice.offers.instance[choice.chosen])
    missed, covered, value = float("nan"), False, left_out.values["latency"]
    if (known := left_out_prediction(predicted, left_out)) is not None:
        mean, low, high = known
        missed, covered = abs(mean / value - 1), low <= value <= high
    return Influence(
        id=left_out.id,
        changes_to=name,
        changes=name != now,
        moves=float(np.median(moved)) if both.any() else 0.0,
        missed_by=missed,
        covered=covered,
    )


def left_out_prediction(predicted: PredictionSet, one: Observation) -> tuple[float, float, float] | None:
    """Return the latency that other samples predict for this one, as it is measured, and the ends of its interval."""
    distribution = predicted.targets["latency"].distribution
    if distribution is None or predicted.space is None:
        return None
    own = distribution.alone.take(np.array([predicted.space.types.row(one.machine.type_key)]))
    low, high = own.interval(LEVEL)
    return float(own.value[0]), float(low[0]), float(high[0])


def widest_intervals(choice: Choice, count: int = 3) -> list[WideInterval]:
    """Return the machines with the widest intervals among those that might meet the limits, one offer of each type."""
    if choice.latency.distribution is None:
        return []
    low, high = choice.latency.distribution.alone.interval(LEVEL)
    of = choice.latency.type_index
    possible = choice.eligible & (low[of] <= choice.latency_budget_s)
    found: list[WideInterval] = []
    seen: set[int] = set()
    for row in np.flatnonzero(possible)[np.argsort(-np.round(high[of] / low[of], 6)[possible], kind="stable")].tolist():
        if of[row] not in seen and len(found) < count:
            seen.add(int(of[row]))
            found.append(WideInterval(row, float(high[of[row]] / low[of[row]])))
    return found


def parts(application: Application, choice: Choice, row: int) -> Sequence[tuple[str, float]]:
    """Return the terms of an offer's objective."""
    objective = application.spec.objective
    return (
        (objective.metric or "latency", objective.alpha * float(choice.metric_value[row]) / choice.scale.metric),
        ("cost", (1 - objective.alpha) * float(choice.cost_usd_per_request[row]) / choice.scale.cost),
    )
