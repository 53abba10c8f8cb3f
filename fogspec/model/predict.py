"""From what was measured to a prediction for every machine on offer, with its uncertainty.

The surrogate (`fogspec.numerics.surrogate`) is conditioned on all usable samples once for each target; a prediction is an
instance type's, wherever and however it is rented. Shapes of one host (`local/...`) say nothing of how fast machines
elsewhere are: from them the families' curves are read, marked as extrapolated and without interval.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fogspec.base.clouds import LOCAL
from fogspec.catalog.instance_types import InstanceTypes, instance_types, types_with_measured
from fogspec.catalog.machine import Machine, TypeKey
from fogspec.catalog.table import Catalog, Floats
from fogspec.model.fit import Model, Models, Observation, RejectedSample
from fogspec.numerics import families
from fogspec.numerics.nested import learnt_factor, nested_error
from fogspec.numerics.observations import DEFAULT_NOISE, observations
from fogspec.numerics.priors import PriorData, prior_for
from fogspec.numerics.surrogate import Posterior, Space, prepare

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Predictions:
    """Predictions of one target for each of n offers.

    `value` (n,) is NaN where nothing can be predicted; `type_index` (n,) is the place of each offer's type in the posterior.
    Types are `measured` if a machine of the type was measured, `extrapolated` outside of the sampled range, and `unfit` if a
    machine of the type failed, or one with at least as much memory ran out of it. Without a posterior there are only values.

    `nested_in` names, by type, the part of a larger machine that a type was measured on, which was not measured itself.

    `ranges` is the posterior of the prediction intervals: for the latency that of another server of each type, because the
    machine that is deployed is not the one that was measured. Probabilities and the choice are about the types.
    """

    value: Floats
    measured: Mask
    extrapolated: Mask
    unfit: Mask
    type_index: NDArray[np.intp]
    posterior: Posterior | None
    nested_in: Mapping[int, str] = field(default_factory=dict)
    varies_by_server: bool = False
    solved: dict[tuple[int, float], tuple[float, float]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @classmethod
    def of_values(cls, value: Floats) -> "Predictions":
        """Return predictions without probabilities."""
        none = np.zeros(len(value), dtype=bool)
        return cls(
            value=value,
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
    ) -> "Predictions":
        """Return the predictions of a posterior over N types for n offers; `unfit` is (N,).

        Without `type_index` (n,) the offers are the types. Metrics of the application do not vary by server.
        """
        at = np.arange(len(posterior.machines)) if type_index is None else type_index
        # Within what an exponential can hold: a lower bound alone may leave nearly everything open.
        value = np.exp(np.clip(posterior.mean, -600, 600))
        return cls(
            value=value[at],
            measured=posterior.measured[at],
            extrapolated=posterior.extrapolated[at],
            unfit=np.zeros(len(at), dtype=bool) if unfit is None else unfit[at],
            type_index=at,
            posterior=posterior,
            varies_by_server=varies_by_server,
        )

    @property
    def ranges(self) -> Posterior | None:
        """The posterior of the prediction intervals."""
        return self.posterior.elsewhere if self.posterior and self.varies_by_server else self.posterior

    def interval(self, row: int, level: float) -> tuple[float, float] | None:
        """Two-sided prediction interval of one offer, None where the model cannot say."""
        return self.intervals([row], level)[0]

    def intervals(self, rows: Sequence[int], level: float) -> list[tuple[float, float] | None]:
        """Return `interval` of several offers, which takes hardly longer than of one; each type's is kept."""
        ranges = self.ranges
        if ranges is None:
            return [None] * len(rows)
        types = self.type_index[list(rows)].tolist()
        # Only of these types: a bisection over a whole catalog takes a second.
        if new := sorted({one for one in types if (one, level) not in self.solved}):
            own = ranges.take(np.array(new))
            ends = (own.quantile((1 - level) / 2).tolist(), own.quantile((1 + level) / 2).tolist())
            self.solved.update({(one, level): (low, high) for one, low, high in zip(new, *ends, strict=True)})
        return [
            self.solved[one, level] if math.isfinite(self.value[row]) else None
            for row, one in zip(rows, types, strict=True)
        ]

    def where_nested(self, row: int) -> str | None:
        """Return the part of a larger machine that an offer was measured on, and not itself; None for other offers."""
        return self.nested_in.get(int(self.type_index[row]))

    def probability_below(self, row: int, bound: float) -> float | None:
        """Probability that one offer's true value is at most `bound`, None where the model cannot say."""
        if self.posterior is None or not math.isfinite(self.value[row]):
            return None
        return float(self.posterior.probability_below(bound)[self.type_index[row]])


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
        itself = {one.machine.type_key for one in known if one.nested_in is None}
        nested = {
            self.types.row(one.machine.type_key): one.nested_in
            for one in known
            if one.nested_in is not None and one.machine.type_key not in itself
        }
        return PredictionSet(
            self.offers,
            self.types,
            {name: replace(_predictions(name, one, unfit, of), nested_in=nested) for name, one in found.items()},
            self,
        )


@dataclass(frozen=True)
class PredictionSet:
    """Predictions of every target for the offers; no `space` where the families' curves predict."""

    offers: Catalog
    types: InstanceTypes
    targets: Mapping[str, Predictions]
    space: PredictionSpace | None = None


def predict(
    models: Models,
    offers: Catalog,
    targets: Sequence[str],
    catalog: Catalog | None = None,
    library: PriorData | None = None,
) -> PredictionSet:
    """Predictions of these targets for every offer; `catalog` describes measured machines that are not offers."""
    body = models.spec
    if body.measured_on_local or not len(offers):
        return PredictionSet(
            offers, instance_types(offers), {name: _by_curves(models, offers, name) for name in targets}
        )
    return predict_from(
        known=body.observations,
        unusable=body.rejected,
        offers=offers,
        targets=targets,
        catalog=catalog,
        library=library,
    )


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


def counts(machine: Machine, offers: Catalog) -> bool:
    """Return True if a measurement on the machine informs the offers: local shapes inform only local offers."""
    return not machine.is_local or bool((offers.cloud == LOCAL).all())


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
    expected = nested_error(space.machines)[at]
    factor = _learnt(values, expected, target)
    errors = [_error(one, target, factor * more) for one, more in zip(values, expected.tolist(), strict=True)]
    return space.fit(
        observations(
            [*at, *(types.row(one.machine.type_key) for one in bounds)],
            [*(one.values[target] for one in values), *(one.latency_lower_bound or 0.0 for one in bounds)],
            [*errors, *(math.nan for _ in bounds)],
            [*(False for _ in values), *(True for _ in bounds)],
            [*(one.nested_in is not None for one in values), *(False for _ in bounds)],
        )
    )


def _error(one: Observation, target: str, nested: float) -> float:
    """Return the relative standard error of a target, NaN if it is unknown; `nested` is what being a part of a machine adds."""
    own = math.nan if target != "latency" or one.error is None else one.error
    return own if one.nested_in is None else math.hypot(DEFAULT_NOISE if math.isnan(own) else own, nested)


def _learnt(values: Sequence[Observation], expected: Floats, target: str) -> float:
    """Return the factor on the errors of nested measurements, from the types that were measured both ways."""
    own: dict[TypeKey, list[float]] = {}
    for one in values:
        if one.nested_in is None:
            own.setdefault(one.machine.type_key, []).append(math.log(one.values[target]))
    pairs = [
        (math.log(one.values[target]) - math.fsum(both) / len(both), more)
        for one, more in zip(values, expected.tolist(), strict=True)
        if one.nested_in is not None and (both := own.get(one.machine.type_key))
    ]
    return learnt_factor([deviation for deviation, _ in pairs], [error for _, error in pairs])


def _predictions(target: str, posterior: Posterior | None, unfit: Mask, type_index: NDArray[np.intp]) -> Predictions:
    if posterior is not None:
        return Predictions.of_posterior(posterior, unfit, type_index, varies_by_server=target == "latency")
    none = Predictions.of_values(np.full(len(type_index), np.nan))
    return replace(none, unfit=unfit[type_index], type_index=type_index)


def _by_curves(models: Models, offers: Catalog, target: str) -> Predictions:
    """Return predictions of the families' curves, for shapes of one host."""
    value = np.full(len(offers), np.nan)
    for model in models.spec.models:
        if model.target == target:
            rows = _with_gpu(offers, model)
            coefficients = list(model.coefficients.values())
            value[rows] = families.predict(model.shape, coefficients, offers.vcpus[rows], offers.memory_gib[rows])
    value[~(np.isfinite(value) & (value > 0))] = np.nan
    return Predictions.of_values(value)


def _with_gpu(offers: Catalog, model: Model) -> NDArray[np.intp]:
    name, _, count = (model.gpu or ":0").rpartition(":")
    return np.flatnonzero((offers.gpu == name) & (offers.gpu_count == float(count)))
