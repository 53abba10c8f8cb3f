"""From what was measured to a prediction for every machine on offer, with its uncertainty.

The surrogate (`fogspec.numerics.surrogate`) is conditioned on all usable samples once for each target; a prediction is an
instance type's, wherever and however it is rented. Shapes of one host (`local/...`) say nothing of how fast machines
elsewhere are: from them the families' curves are read, marked as extrapolated and without interval.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fogspec.base.clouds import LOCAL
from fogspec.base.units import rounded
from fogspec.catalog.instance_types import InstanceTypes, instance_types, types_with_measured
from fogspec.catalog.machine import Machine, TypeKey
from fogspec.catalog.table import Catalog, Floats
from fogspec.model.fit import (
    Fitted,
    Model,
    Models,
    Observation,
    PredictedTarget,
    RejectedSample,
    ServerShift,
)
from fogspec.numerics import families
from fogspec.numerics.ensemble import Ensemble
from fogspec.numerics.kernels import distinct, quantised
from fogspec.numerics.observations import observations
from fogspec.numerics.prediction import Prediction
from fogspec.numerics.priors import PriorData, prior_for
from fogspec.numerics.servers import OTHER, SHIFTS
from fogspec.numerics.surrogate import Posterior, Space, prepare
from fogspec.numerics.waiting import Waiting
from fogspec.results.resources import BOUND

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Predictions:
    """Predictions of one target for each of n offers.

    `value` (n,) is NaN where nothing can be predicted; `type_index` (n,) is the place of each offer's type in the posterior.
    Types are `measured` if a machine of the type was measured, `extrapolated` outside of the sampled range, and `unfit` if a
    machine of the type failed, or one with at least as much memory ran out of it. Without a posterior there are only values.

    Latencies are those at the declared rate, if there is one; the posterior is of requests one after the other.

    `distribution` is that of the value on another server of each type (N,), because the machine that is deployed is not the
    one that was measured; of a metric, which does not depend on the server, it is without the shift. Ranges and
    probabilities are read from it alone; the posterior is the sampler's.
    """

    value: Floats
    measured: Mask
    extrapolated: Mask
    unfit: Mask
    type_index: NDArray[np.intp]
    posterior: Posterior | None
    distribution: Prediction | None = None

    @property
    def alone(self) -> "Predictions":
        """The same with the distribution of requests one after the other."""
        return self if self.distribution is None else replace(self, distribution=self.distribution.alone)

    @classmethod
    def of_values(cls, value: Floats) -> "Predictions":
        """Return predictions without probabilities."""
        none = np.zeros(len(value), dtype=bool)
        return cls(
            value=quantised(value),
            measured=none,
            extrapolated=~none,
            unfit=none,
            type_index=np.zeros(len(value), dtype=np.intp),
            posterior=None,
        )

    @classmethod
    def of_posterior(
        cls,
        posterior: Posterior,
        unfit: Mask | None = None,
        type_index: NDArray[np.intp] | None = None,
        *,
        varies_by_server: bool = True,
        waiting: Waiting | None = None,
    ) -> "Predictions":
        """Return the predictions of a posterior over N types for n offers; `unfit` is (N,), as is `waiting`.

        Without `type_index` (n,) the offers are the types. Metrics of the application do not vary by server.
        """
        at = np.arange(len(posterior.machines)) if type_index is None else type_index
        distribution = posterior.prediction if varies_by_server else posterior.prediction.on_measured_server
        distribution = replace(distribution, waiting=waiting)
        return cls(
            value=distribution.value[at],
            measured=posterior.measured[at],
            extrapolated=posterior.extrapolated[at],
            unfit=np.zeros(len(at), dtype=bool) if unfit is None else unfit[at],
            type_index=at,
            posterior=posterior,
            distribution=distribution,
        )

    def interval(self, row: int, level: float) -> tuple[float, float] | None:
        """Two-sided prediction interval of one offer, None where the model cannot say."""
        if self.distribution is None or not math.isfinite(self.value[row]):
            return None
        low, high = self.distribution.interval(level)  # of all offers: one by one, each would take as long
        at = self.type_index[row]
        return float(low[at]), float(high[at])

    def probability_below(self, row: int, bound: float, *, measured_server: bool = False) -> float | None:
        """Probability that one offer's true value is at most `bound`, None where the model cannot say.

        It is for another server of the type, unless it shall be for the one that was measured.
        """
        one = self._of(row)
        if one is None:
            return None
        return float((one.on_measured_server if measured_server else one).probability_below(bound)[0])

    def _of(self, row: int) -> Prediction | None:
        """Return the distribution of one offer; None where there is none."""
        if self.distribution is None or not math.isfinite(self.value[row]):
            return None
        return self.distribution.take(self.type_index[[row]])


@dataclass(frozen=True)
class PredictionSpace:
    """Everything about the offers that does not depend on what was measured on them, made once.

    `types` are those of the offers and of the measured machines besides.
    """

    offers: Catalog
    types: InstanceTypes
    space: Space

    @classmethod
    def of(
        cls,
        offers: Catalog,
        machines: Sequence[Machine],
        catalog: Catalog | None = None,
        library: PriorData | None = None,
    ) -> "PredictionSpace":
        """`machines` are measured, and described by `catalog` where they are not offers."""
        measured = [one for one in machines if counts(one, offers)]
        types = types_with_measured(offers, measured, catalog)
        prior = None if library is None else prior_for(library, types.names, types.machines)
        return cls(offers, types, prepare(types.machines, prior))

    def predicted(
        self, known: Sequence[Observation], unusable: Sequence[RejectedSample], targets: Sequence[str]
    ) -> "PredictionSet":
        """Predictions of these targets for every offer, from this evidence."""
        known = [one for one in known if counts(one.machine, self.offers)]
        unusable = [one for one in unusable if counts(one.machine, self.offers)]
        little = max((one.machine.memory for one in unusable if one.out_of_memory), default=0.0)
        unfit = self.types.machines.memory_gib <= little
        unfit[[self.types.row(one.machine.type_key) for one in unusable if one.excludes_machine]] = True
        of = self.types.of[: len(self.offers)]
        found = {name: _conditioned(self.space, self.types, known, unusable, name) for name in targets}
        ratios = busy_ratios(known, self.types)
        waiting = _waiting(known, self.types, ratios)
        return PredictionSet(
            self.offers,
            self.types,
            {name: _predictions(name, one, unfit, of, waiting) for name, one in found.items()},
            ratios[of],
            self,
            None if waiting is None else waiting.take(of),
            alone(known),
        )


@dataclass(frozen=True)
class PredictionSet:
    """Predictions of every target for the offers; no `space` where the families' curves predict.

    `busy_ratio` (n,) is that of `fogspec.catalog.cost.Costs`. `waiting` is that of the offers at the declared rate, None where
    there is none or nothing is known of it. Costs are those of machines `alone`, without disk and address.
    """

    offers: Catalog
    types: InstanceTypes
    targets: Mapping[str, Predictions]
    busy_ratio: Floats
    space: PredictionSpace | None = None
    waiting: Waiting | None = None
    alone: bool = False


def predict(
    models: Fitted,
    offers: Catalog,
    targets: Sequence[str],
    catalog: Catalog | None = None,
    library: PriorData | None = None,
) -> PredictionSet:
    """Predictions of these targets for every offer; `catalog` describes measured machines that are not offers.

    The latency has neither ranges nor probabilities where no sample tells how far it is from that of more requests.
    """
    if models.measured_on_local or not len(offers):
        types = instance_types(offers)
        ratios = busy_ratios(models.observations, types)
        waiting = _waiting(models.observations, types, ratios)
        waiting = None if waiting is None else waiting.take(types.of)
        by_curves = {name: _by_curves(models, offers, name, waiting if name == "latency" else None) for name in targets}
        return PredictionSet(
            offers, types, by_curves, ratios[types.of], waiting=waiting, alone=alone(models.observations)
        )
    found = predict_from(
        known=models.observations,
        unusable=models.rejected,
        offers=offers,
        targets=targets,
        catalog=catalog,
        library=library,
    )
    if any(one.tells for one in models.observations):
        return found
    latency = replace(found.targets["latency"], posterior=None, distribution=None)
    return replace(found, targets={**found.targets, "latency": latency})


def predict_from(
    known: Sequence[Observation],
    unusable: Sequence[RejectedSample],
    offers: Catalog,
    targets: Sequence[str],
    catalog: Catalog | None = None,
    library: PriorData | None = None,
) -> PredictionSet:
    """Return predictions of these targets from observations and rejected samples."""
    machines = [*(one.machine for one in known), *(one.machine for one in unusable)]
    return PredictionSpace.of(offers, machines, catalog, library).predicted(known, unusable, targets)


def alone(known: Sequence[Observation]) -> bool:
    """Return whether costs are those of machines alone: as in what others published, which they are compared with."""
    return any(one.published for one in known)


def busy_ratios(known: Sequence[Observation], types: InstanceTypes) -> Floats:
    """Return the busy ratio (N,) of these types: as measured on the type, else the geometric mean of all.

    How requests overlap and fail, and what a percentile is of the mean, is the workload's, and differs little by machine.
    """
    found, of = _by_type({one.id: [one.busy_ratio] for one in known}, known, types)
    return np.asarray(found[of, 0])


def _waiting(known: Sequence[Observation], types: InstanceTypes, busy_ratio: Floats) -> Waiting | None:
    """Return how long requests wait at the declared rate on these types: as on the type, else as on all on average."""
    usable = {one.id: one.arrivals for one in known if one.arrivals is not None and one.arrivals.table is not None}
    rates = {one.requests_per_s for one in usable.values()}
    if not rates:
        return None
    # The latency at no work is 0, which has no logarithm.
    tables, of = _by_type({name: one.table[1:] for name, one in usable.items() if one.table}, known, types)
    return Waiting(np.pad(tables, ((0, 0), (1, 0))), of, 1 / (rates.pop() * busy_ratio))


def _by_type(
    rows: Mapping[str, Sequence[float]], known: Sequence[Observation], types: InstanceTypes
) -> tuple[Floats, NDArray[np.intp]]:
    """Return geometric means of rows of observations by their id, first those of all, and the place of each type's (N,).

    Without any, they are 1.
    """
    groups: dict[TypeKey | None, list[Sequence[float]]] = {None: list(rows.values()) or [[1.0]]}
    for one in known:
        if one.id in rows and one.machine.type_key in types:
            groups.setdefault(one.machine.type_key, []).append(rows[one.id])
    of = np.zeros(len(types), dtype=np.intp)
    for number, key in enumerate(groups):
        if key is not None:
            of[types.row(key)] = number
    logs = [
        [math.fsum(map(math.log, column)) / len(group) for column in zip(*group, strict=True)]
        for group in groups.values()
    ]
    return quantised(np.exp(np.array(logs))), of


def counts(machine: Machine, offers: Catalog) -> bool:
    """Return True if a measurement on the machine informs the offers: local shapes inform only local offers."""
    return not machine.is_local or bool((offers.cloud == LOCAL).all())


def with_predictions(models: Fitted, predicted: PredictionSet, rows: Sequence[int]) -> Models:
    """Return the document with the predictions of measured machines and of the offers in these rows, by cloud and name."""
    latency = predicted.targets["latency"]
    if predicted.space is None or latency.posterior is None:
        return models.document({}, {})
    types, measured = predicted.types, latency.posterior.measured
    at = distinct(np.concatenate([np.flatnonzero(measured), latency.type_index[list(rows)]])).tolist()
    keys = [types.key(row) for row in at]
    shifts = {key[0]: SHIFTS.get(key[0], OTHER) for key in keys}
    ensemble = predicted.space.space.ensemble
    found = {
        target: _predicted_target(one.posterior, ensemble, dict(zip(at, keys, strict=True)))
        for target, one in predicted.targets.items()
        if one.posterior is not None
    }
    shift = {cloud: ServerShift(tail=one.tail, spread=one.spread) for cloud, one in sorted(shifts.items())}
    return models.document(shift, found)


def _predicted_target(posterior: Posterior, ensemble: Ensemble, keys: Mapping[int, TypeKey]) -> PredictedTarget:
    weights, of, others = posterior.weights, posterior.prediction, posterior.left_out
    place = {} if others is None else {row: i for i, row in enumerate(others.at.tolist())}

    def normal(one: Prediction, i: int) -> tuple[float, float]:
        return float(one.mu[i]), float(one.sigma[i])

    names = {row: f"{key[0]}/{key[1]}" + (f" {key[2]}:{key[3]:g}" if key[2] else "") for row, key in keys.items()}
    return PredictedTarget(
        models=len(weights),
        effective=rounded(float(1 / (weights**2).sum()), 3),
        amplitudes={name: rounded(sd, 3) for name, sd in ensemble.amplitudes(weights).items()},
        widening=1.0 if others is None else others.factor,
        machines={name: normal(of, row) for row, name in names.items()},
        left_out={}
        if others is None
        else {
            name: (
                rounded(float(others.log_measured[i]), 6),
                *(rounded(one, 4) for one in normal(others.prediction, i)),
            )
            for row, name in names.items()
            if (i := place.get(row)) is not None
        },
    )


def _conditioned(
    space: Space,
    types: InstanceTypes,
    known: Sequence[Observation],
    unusable: Sequence[RejectedSample],
    target: str,
) -> Posterior | None:
    """Return the posterior of one target; None without an observation. Only the latency has lower bounds."""
    values = [one for one in known if one.values.get(target, 0.0) > 0]
    if not values:
        return None
    bounds = [one for one in unusable if one.latency_lower_bound] if target == "latency" else []
    at = [types.row(one.machine.type_key) for one in values]
    first = min(values, key=lambda one: one.machine.cpus)
    if target == "latency" and not any(one.machine.gpu for one in values) and first.at_work < BOUND:
        space = space.damped(first.at_work, types.row(first.machine.type_key))
    elif target != "latency" and len(set(at)) == 1:  # that a metric changes with the machine, no second one shows
        space = space.damped(0.0, at[0])
    errors = [one.errors.get(target, math.nan) for one in values]
    return space.fit(
        observations(
            [*at, *(types.row(one.machine.type_key) for one in bounds)],
            [*(one.values[target] for one in values), *(one.latency_lower_bound or 0.0 for one in bounds)],
            [*errors, *(math.nan for _ in bounds)],
            [*(False for _ in values), *(True for _ in bounds)],
        )
    )


def _predictions(
    target: str, posterior: Posterior | None, unfit: Mask, type_index: NDArray[np.intp], waiting: Waiting | None
) -> Predictions:
    if posterior is not None:
        if target != "latency":
            return Predictions.of_posterior(posterior, unfit, type_index, varies_by_server=False)
        return Predictions.of_posterior(posterior, unfit, type_index, waiting=waiting)
    none = Predictions.of_values(np.full(len(type_index), np.nan))
    return replace(none, unfit=unfit[type_index], type_index=type_index)


def _by_curves(models: Fitted, offers: Catalog, target: str, waiting: Waiting | None) -> Predictions:
    """Return predictions of the families' curves, for shapes of one host."""
    value = np.full(len(offers), np.nan)
    for model in models.curves:
        if model.target == target:
            rows = _with_gpu(offers, model)
            coefficients = list(model.coefficients.values())
            value[rows] = families.predict(model.shape, coefficients, offers.vcpus[rows], offers.memory_gib[rows])
    value[~(np.isfinite(value) & (value > 0))] = np.nan
    return Predictions.of_values(value if waiting is None else waiting.at_rate(value))


def _with_gpu(offers: Catalog, model: Model) -> NDArray[np.intp]:
    name, _, count = (model.gpu or ":0").rpartition(":")
    return np.flatnonzero((offers.gpu == name) & (offers.gpu_count == float(count)))
