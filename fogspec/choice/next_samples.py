"""The adaptive sampler's next batch: the largest expected improvement per price, then the choice itself, then nothing."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fogspec.base.units import dollars
from fogspec.catalog.machine import Machine
from fogspec.catalog.table import Catalog, Floats
from fogspec.choice.choose import Choice, choose
from fogspec.choice.rule import Utility
from fogspec.model.fit import is_proxy, partition, targets
from fogspec.model.predict import PredictionSet, predict_from
from fogspec.numerics.acquisition import Policy, expected_gains, propose_batch
from fogspec.numerics.priors import PriorData
from fogspec.numerics.surrogate import Posterior
from fogspec.plan.initial_batch import NextBatch, SampleCosts, initial_batch, next_batch, parts_of
from fogspec.results.schema import Measured
from fogspec.spec.schema import Application


def next_samples(
    application: Application,
    offers: Catalog,
    records: Sequence[Measured],
    *,
    usd_per_sample: Floats,
    left_usd: float = np.inf,
    library: PriorData | None = None,
    batch: int = 1,
    paid_share: float = 1.0,
    excluded: Collection[tuple[str, str]] = (),
) -> NextBatch:
    """Return the offers to measure next, or none with the reason why sampling ends.

    `usd_per_sample` (n,) is the maximum cost of a sample of each offer, of which `paid_share` is expected to be paid; the whole
    batch fits into `left_usd`. Types (cloud, instance, accelerators) that could not be measured and those in `excluded` (cloud,
    instance) are not measured again; measured types are if a repeat is worth most. If no further sample pays off, the chosen
    machine is measured to verify it; with a volume only if that saves its price.
    """
    if not records:
        return initial_batch(offers, usd_per_sample, left_usd, library, application.spec.benchmark)
    known, unusable = partition(records, application.spec.constraints.statistic)
    predicted = predict_from(
        known=known, unusable=unusable, offers=offers, targets=targets(application), catalog=None, library=library
    )
    failed = [one.machine for one in unusable if one.nested_in is None]
    state = _State.of(application, predicted, failed, usd_per_sample, excluded)
    proxy = is_proxy(application, known)
    if all(proxy and one.machine.is_local for one in known):
        return state.again(left_usd, library)
    return state.improving(left_usd, batch, paid_share)


def worth_usd(application: Application, choice: Choice) -> float | None:
    """Return what the choice's objective is worth in USD over the volume of requests; None without a volume."""
    volume, usd = application.spec.benchmark.volume, choice.usd_per_request()
    return None if volume is None or usd is None else volume.requests * usd


@dataclass(frozen=True, slots=True)
class NextSample:
    """The sample of the largest expected improvement per price.

    `gain` is the expected relative improvement of the objective, `saves_usd` what it saves over the volume of requests if there
    is one, `probability_better` that of the offer's type being better than the chosen one, `usd` the maximum cost.
    """

    row: int
    gain: float
    saves_usd: float | None
    probability_better: float | None
    usd: float


def best_next_sample(
    application: Application, predicted: PredictionSet, failed: Collection[Machine], usd_per_sample: Floats
) -> NextSample | None:
    """Return the best further sample, whether or not it pays off; None if no type can be measured."""
    state = _State.of(application, predicted, failed, usd_per_sample, ())
    choice = choose(application, predicted)
    posterior = choice.latency.posterior
    if posterior is None or state.excluded.all():
        return None
    utility = _utility(predicted, choice)
    values = utility.loss(posterior)
    expected = np.where(state.excluded, -1.0, expected_gains(posterior, utility))
    one = int(np.argmax(expected / state.costs.usd))
    better = None
    if choice.chosen is not None:
        better = float(np.mean(values[:, one] < values[:, predicted.types.of[choice.chosen]]))
    gain, worth = float(expected[one]), worth_usd(application, choice)
    saves = None if worth is None else gain * worth
    return NextSample(int(state.costs.row[one]), gain, saves, better, float(state.costs.usd[one]))


def probability_better(predicted: PredictionSet, choice: Choice, row: int) -> float | None:
    """Return the probability that an offer's type meets the limits and is better than the chosen one; None if unknown."""
    if choice.latency.posterior is None or choice.chosen is None:
        return None
    values = _utility(predicted, choice).loss(choice.latency.posterior)
    of = predicted.types.of
    return float(np.mean(values[:, of[row]] < values[:, of[choice.chosen]]))


@dataclass(frozen=True)
class _State:
    """The state of a campaign over N types; `excluded` types are not measured again."""

    application: Application
    predicted: PredictionSet
    costs: SampleCosts
    excluded: NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        application: Application,
        predicted: PredictionSet,
        failed: Collection[Machine],
        usd_per_sample: Floats,
        excluded: Collection[tuple[str, str]],
    ) -> "_State":
        """Exclude types that failed, are unfit, are not offered, or are in `excluded`."""
        types, offered = predicted.types, len(usd_per_sample)
        beyond = np.full(len(types.of) - offered, float(usd_per_sample.mean()))
        costs = SampleCosts.of(types, np.concatenate([usd_per_sample, beyond]))
        failed_keys = {one.type_key for one in failed}
        unusable = np.array([key in failed_keys or key[:2] in excluded for key in types.keys]) | (costs.row >= offered)
        unusable[types.of[:offered][predicted.targets["latency"].unfit]] = True
        return cls(application, predicted, costs, unusable)

    def again(self, left_usd: float, library: PriorData | None) -> NextBatch:
        """Return another initial batch among the types that were not tried, after nothing could be measured."""
        rows = self.costs.row[~self.excluded]
        if not len(rows):
            return NextBatch((), (), "every machine was tried or is ruled out, and none could be measured")
        offers, benchmark = self.predicted.offers.take(rows), self.application.spec.benchmark
        found = initial_batch(offers, self.costs.usd[~self.excluded], left_usd, library, benchmark)
        parts = tuple(tuple(int(rows[row]) for row in some) for some in found.parts)
        return NextBatch(tuple(int(rows[row]) for row in found.rows), found.reasons, found.reason, parts)

    def improving(self, left_usd: float, batch: int, paid_share: float) -> NextBatch:
        """Return the batch of the largest expected improvement, else the choice if it was not measured."""
        choice = choose(self.application, self.predicted)
        posterior = choice.latency.posterior
        if posterior is None:
            raise ValueError("without a measured machine nothing can be improved")
        worth = worth_usd(self.application, choice)
        found = propose_batch(
            posterior,
            _utility(self.predicted, choice),
            sample_cost=self.costs.usd,
            left=left_usd,
            policy=Policy(batch=batch, worth=None if worth is None else worth / paid_share),
            excluded=self.excluded,
            nested=parts_of(self.application.spec.benchmark, self.predicted.types),
        )
        if found.machines:
            of = zip(found.machines, found.gains, strict=True)
            reasons = [self._reason(posterior, one, gain, worth) for one, gain in of]
            batched = next_batch(found, self.costs, reasons, left_usd)
            return replace(batched, decided_above_s=self._decided_above_s(choice, posterior, found.machines))
        why = next_batch(found, self.costs, (), left_usd).reason
        if (again := self._on_another_server(choice, posterior, why, left_usd)) is not None:
            return again
        volume = self.application.spec.benchmark.volume
        if volume is None:
            return self._verifying(choice, why, left_usd)
        row = choice.unverified
        beside = "" if row is None else f"; not even one of the choice, {choice.offers.instance[row]}"
        return NextBatch((), (), f"{why} on {volume.requests:,.0f} requests{beside}")

    def _decided_above_s(self, choice: Choice, posterior: Posterior, types: Sequence[int]) -> tuple[float | None, ...]:
        """Return the latency above which each type is decided; None for repeats, which are to be precise."""
        above = choice.decided_above_s(self.costs.row[list(types)])
        if above is None:
            return (None,) * len(types)
        new = ~posterior.measured[list(types)] & np.isfinite(above)
        return tuple(float(value) if ok else None for value, ok in zip(above, new, strict=True))

    def _reason(self, posterior: Posterior, one: int, gain: float, worth: float | None) -> str:
        again = "measured again, for one sample may err: " if posterior.measured[one] else ""
        saves = "" if worth is None else f", which saves {dollars(gain * worth)}"
        price = dollars(float(self.costs.usd[one]))
        return f"{again}may better the choice by {gain:.1%} on average{saves}, for at most {price}"

    def _on_another_server(self, choice: Choice, posterior: Posterior, why: str, left_usd: float) -> NextBatch | None:
        """Return the choice once more while it was measured on fewer servers than asked; None if that is enough."""
        asked = self.application.spec.benchmark.servers
        if choice.chosen is None:
            return None
        one = int(self.predicted.types.of[choice.chosen])
        measured = int(posterior.samples[one])
        if not 0 < measured < asked:
            return None
        name = choice.offers.instance[choice.chosen]
        if self.excluded[one]:
            return NextBatch((), (), f"{why}; the choice, {name}, could not be measured on another server")
        if self.costs.usd[one] > left_usd:
            cost = f"it may cost {dollars(float(self.costs.usd[one]))}"
            return NextBatch((), (), f"{why}; the choice, {name}, is not measured on another server: {cost}")
        reason = f"the choice on another server, number {measured + 1} of {asked}"
        return NextBatch((int(self.costs.row[one]),), (reason,), why)

    def _verifying(self, choice: Choice, why: str, left_usd: float) -> NextBatch:
        """Return the choice if it was not measured and the budget allows it."""
        row = choice.unverified
        if row is None:
            return NextBatch((), (), why)
        one = int(self.predicted.types.of[row])
        name = choice.offers.instance[row]
        if self.excluded[one]:
            return NextBatch((), (), f"{why}; the choice, {name}, could not be measured")
        if self.costs.usd[one] > left_usd:
            return NextBatch(
                (), (), f"{why}; the choice, {name}, is not verified: it may cost {dollars(float(self.costs.usd[one]))}"
            )
        return NextBatch((int(self.costs.row[one]),), ("verifies the choice",), why)


def _utility(predicted: PredictionSet, choice: Choice) -> Utility:
    """Return the value of each type at its cheapest offer; measured types that are not on offer have none."""
    offered = predicted.types.offer < len(choice.offers)
    return choice.utility(np.where(offered, predicted.types.offer, 0), offered)
