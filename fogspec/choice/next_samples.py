"""The adaptive sampler's next batch: the largest expected improvement per price, then the choice itself, then nothing."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fogspec.base.units import dollars
from fogspec.catalog.machine import Machine
from fogspec.catalog.table import Catalog, Floats
from fogspec.choice.choose import Choice, choose
from fogspec.choice.outlook import Outlook, chances, deciding, outlook
from fogspec.choice.rule import Utility
from fogspec.language.schema import Application
from fogspec.model.fit import NO_ARRIVALS, is_proxy, partition, targets
from fogspec.model.predict import PredictionSet, predict_from
from fogspec.numerics.acquisition import Policy, expected_gains, propose_batch
from fogspec.numerics.priors import PriorData
from fogspec.numerics.surrogate import Posterior
from fogspec.plan.initial_batch import NextBatch, SampleCosts, initial_batch, next_batch
from fogspec.results.schema import Arrivals, Measured


def next_samples(
    application: Application,
    offers: Catalog,
    records: Sequence[Measured],
    *,
    usd_per_sample: Floats,
    left_usd: float = np.inf,
    library: PriorData | None = None,
    batch: int = 1,
    arrivals: Mapping[str, Arrivals] = NO_ARRIVALS,
) -> NextBatch:
    """Return the offers to measure next, or none with the reason why sampling ends.

    `usd_per_sample` (n,) is the maximum cost of a sample of each offer; the whole batch fits into `left_usd`. Types (cloud,
    instance, accelerators) that could not be measured are not measured again; measured types are if a repeat is worth most.
    If no further sample pays off, the chosen machine is measured to verify it. `arrivals` are those of `Results`.
    """
    if not records:
        return initial_batch(offers, usd_per_sample, left_usd)
    known, unusable = partition(records, application.spec.constraints.statistic, arrivals)
    predicted = predict_from(
        known=known, unusable=unusable, offers=offers, targets=targets(application), catalog=None, library=library
    )
    failed = [one.machine for one in unusable]
    state = _State.of(application, predicted, failed, usd_per_sample)
    proxy = is_proxy(application, known)
    if all(proxy and one.machine.is_local for one in known):
        return state.again(left_usd)
    if not any(one.tells for one in known):
        why = "no sample tells how far its latency is from that of more requests: raise spec.benchmark.stop"
        return NextBatch((), (), why)
    return state.improving(left_usd, batch)


DECIDES = "no machine is sure enough to meet the limits: this one may be after one more sample"


@dataclass(frozen=True, slots=True)
class NextSample:
    """The sample of the largest expected improvement per price.

    `gain` is the expected relative improvement of the objective, `probability_better` the probability that the offer's type is
    better than the chosen one, `usd` the maximum cost.
    """

    row: int
    gain: float
    probability_better: float | None
    usd: float


def best_next_sample(
    application: Application, predicted: PredictionSet, failed: Collection[Machine], usd_per_sample: Floats
) -> NextSample | None:
    """Return the best further sample, whether or not it pays off; None if no type can be measured.

    While no machine qualifies it is the one that may settle that, with its chance as the gain; None if none may.
    """
    state = _State.of(application, predicted, failed, usd_per_sample)
    choice = choose(application, predicted)
    posterior = choice.latency.posterior
    if posterior is None or state.excluded.all():
        return None
    if not choice.feasible.any():
        settles, expected = state.deciding(choice, posterior, np.inf)
        if settles is None:
            return None
        one = settles
    else:
        expected = np.where(state.excluded, -1.0, expected_gains(posterior, _utility(predicted, choice)))
        # On this host all samples are free.
        one = int(np.argmax(expected / np.where(state.costs.usd > 0, state.costs.usd, 1.0)))
    row = int(state.costs.row[one])
    better = probability_better(predicted, choice, row)
    return NextSample(row, float(expected[one]), better, float(state.costs.usd[one]))


def outlook_of(
    application: Application,
    predicted: PredictionSet,
    choice: Choice,
    failed: Collection[Machine],
    usd_per_sample: Floats,
    left_usd: float,
) -> Outlook | None:
    """Return the outlook of a choice where `usd_per_sample` (n,) is the maximum cost of a sample of each offer.

    None where a machine is chosen, or none is on offer. A list of machines in the spec is kept to.
    """
    if choice.chosen is not None or not len(choice.offers):
        return None
    state = _State.of(application, predicted, failed, usd_per_sample)
    excluded, listed = state.excluded, {name.rpartition("/")[2] for name in application.spec.benchmark.machines}
    if listed:
        excluded = excluded | np.array([key[1] not in listed for key in predicted.types.keys])
    return outlook(predicted, choice, state.costs, excluded, left_usd)


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
    ) -> "_State":
        """Exclude types that failed, are unfit, or are not offered."""
        types, offered = predicted.types, len(usd_per_sample)
        beyond = np.full(len(types.of) - offered, float(usd_per_sample.mean()))
        costs = SampleCosts.of(types, np.concatenate([usd_per_sample, beyond]))
        failed_keys = {one.type_key for one in failed}
        unusable = np.array([key in failed_keys for key in types.keys]) | (costs.row >= offered)
        unusable[types.of[:offered][predicted.targets["latency"].unfit]] = True
        return cls(application, predicted, costs, unusable)

    def again(self, left_usd: float) -> NextBatch:
        """Return another initial batch among the types that were not tried, after nothing could be measured."""
        rows = self.costs.row[~self.excluded]
        if not len(rows):
            return NextBatch((), (), "every machine was tried or is ruled out, and none could be measured")
        found = initial_batch(self.predicted.offers.take(rows), self.costs.usd[~self.excluded], left_usd)
        return NextBatch(tuple(int(rows[row]) for row in found.rows), found.reasons, found.reason)

    def improving(self, left_usd: float, batch: int) -> NextBatch:
        """Return the batch of the largest expected improvement, else the choice if it was not measured."""
        choice = choose(self.application, self.predicted)
        posterior = choice.latency.posterior
        if posterior is None:
            raise ValueError("without a measured machine nothing can be improved")
        found = propose_batch(
            posterior,
            _utility(self.predicted, choice),
            sample_cost=self.costs.usd,
            left=left_usd,
            policy=Policy(batch=batch),
            excluded=self.excluded,
        )
        if found.machines:
            of = zip(found.machines, found.gains, strict=True)
            reasons = [self._reason(posterior, one, gain) for one, gain in of]
            batched = next_batch(found, self.costs, reasons, left_usd)
            return replace(batched, decided_above_s=self._decided_above_s(choice, posterior, found.machines))
        why = next_batch(found, self.costs, (), left_usd).reason
        if not choice.feasible.any() and (one := self.deciding(choice, posterior, left_usd)[0]) is not None:
            return NextBatch((int(self.costs.row[one]),), (DECIDES,), why)
        if (again := self._on_another_server(choice, posterior, why, left_usd)) is not None:
            return again
        return self._verifying(choice, why, left_usd)

    def _decided_above_s(self, choice: Choice, posterior: Posterior, types: Sequence[int]) -> tuple[float | None, ...]:
        """Return the latency above which each type is decided; None for repeats, which are to be precise."""
        above = choice.decided_above_s(self.costs.row[list(types)])
        if above is None:
            return (None,) * len(types)
        new = ~posterior.measured[list(types)] & np.isfinite(above)
        return tuple(float(value) if ok else None for value, ok in zip(above, new, strict=True))

    def _reason(self, posterior: Posterior, one: int, gain: float) -> str:
        again = "measured again, for one sample may err: " if posterior.measured[one] else ""
        price = dollars(float(self.costs.usd[one]))
        return f"{again}may better the choice by {gain:.1%} on average, for at most {price}"

    def deciding(self, choice: Choice, posterior: Posterior, left_usd: float) -> tuple[int | None, Floats]:
        """Return the type whose sample may let it qualify while no machine does, None if none may; and each type's chance."""
        possible = ~self.excluded & (self.costs.usd <= left_usd) & (posterior.samples < Policy().each)
        offers = np.where(self.excluded, 0, self.predicted.types.offer)
        chance = chances(choice, offers)
        return deciding(chance, self.costs.usd, possible), chance

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
