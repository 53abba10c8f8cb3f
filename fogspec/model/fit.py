"""What was measured, as the models take it, and the curves of the paper's families over it.

Predictions come from the surrogate (`fogspec.model.predict`, ADR 0020), which is conditioned on `observations` and
`rejected`. The families of section 2.C are fitted beside it, one for each GPU type and target (the latency, or a metric of the
application), chosen by leave-one-out error (ADR 0008): for comparison and for shapes of one host; and by the largest R² for the
relaxed method (ADR 0005).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from pydantic import Field

from fogspec.base.clouds import LOCAL
from fogspec.base.quantities import Strict
from fogspec.base.units import rounded
from fogspec.catalog.machine import Machine
from fogspec.language import warned as codes
from fogspec.language.fingerprints import LIBRARY, RESULTS, SURROGATE, fitted_record
from fogspec.language.schema import Application, Statistic
from fogspec.language.warned import Warned, warned
from fogspec.numerics import families
from fogspec.numerics.families import Fit, fit_all
from fogspec.numerics.observations import DEFAULT_NOISE
from fogspec.numerics.surrogate import VERSION
from fogspec.numerics.waiting import Waiting, steepness
from fogspec.plan.schema import PlanMetadata
from fogspec.results.ranges import ERROR, LATENCY_S
from fogspec.results.resources import at_work, contended
from fogspec.results.schema import PUBLISHED, Arrivals, Measured, Results

# Two servers of one type differ, whatever is measured on each: median coefficient of variation of repeated
# measurements over Spare Cores' public benchmarks (SpareCores/sc-inspector-data).
SERVER_ERROR = 0.015
NO_ARRIVALS: Mapping[str, Arrivals] = MappingProxyType({})


class PaperFit(Strict):
    """The curve by the paper's rule, the largest R² (section 2.C): the relaxed method's own model."""

    cpu_family: str
    memory_family: str
    formula: str
    coefficients: dict[str, float]
    r2: float

    @property
    def shape(self) -> families.Shape:
        """The families of this curve."""
        return families.Shape(self.cpu_family, self.memory_family)


class Model(Strict):
    """One fitted curve of the paper's families to `n` samples; `coefficients` in the order of the formula.

    `vcpus` and `memory_gib` are the ranges that were sampled. Errors are relative, from leaving one sample out. `paper` is the
    curve of the largest R² where that is another one.
    """

    target: str
    gpu: str | None = None
    cpu_family: str
    memory_family: str
    formula: str
    coefficients: dict[str, float]
    n: int
    p: int
    r2: float | None = None
    loo_median_error: float | None = None
    loo_max_error: float | None = None
    paper: PaperFit | None = None
    vcpus: tuple[float, float]
    memory_gib: tuple[float, float]

    @property
    def shape(self) -> families.Shape:
        """The families of this model."""
        return families.Shape(self.cpu_family, self.memory_family)


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """A machine that was measured: its values by target, and their relative standard errors, as far as they are known.

    `busy_ratio` is that of `fogspec.catalog.cost.Costs`, `arrivals` what is known of its latency at the declared rate: `values`
    are those of requests as they were measured. Of the time in which a request was open, all of its vCPUs could have
    worked for `at_work` at most: with more of them, only that part becomes shorter. It is `published` where others measured it:
    their costs are those of machines alone.
    """

    id: str
    machine: Machine
    values: Mapping[str, float]
    errors: Mapping[str, float] = field(default_factory=dict)
    busy_ratio: float = 1.0
    at_work: float = 1.0
    arrivals: Arrivals | None = None
    published: bool = False

    def at_rate(self, latency_s: float) -> float:
        """Return the latency at the declared rate for one of requests as they were measured, as far as that is known."""
        if self.arrivals is None or self.arrivals.table is None:
            return latency_s
        busy_always_s = 1 / (self.arrivals.requests_per_s * self.busy_ratio)
        own = Waiting(np.array([self.arrivals.table]), np.zeros(1, dtype=np.int64), np.array([busy_always_s]))
        return float(own.at_rate(np.array([latency_s]))[0])

    @property
    def tells(self) -> bool:
        """Whether its requests say how far their latency is from that of more requests."""
        return self.errors.get("latency", 0.0) < ERROR.most


@dataclass(frozen=True, slots=True, kw_only=True)
class RejectedSample:
    """A sample without a value, and why: a warning of the code `sample_rejected`.

    `excludes_machine`: the machine itself failed; `out_of_memory`: it ran out of memory, so machines with no more memory are
    ruled out too; `latency_lower_bound` comes from a run that was given up in its first request.
    """

    id: str
    machine: Machine
    why: Warned
    excludes_machine: bool = False
    out_of_memory: bool = False
    latency_lower_bound: float | None = None


class PredictedTarget(Strict):
    """The predictions of one target.

    `models` were averaged, as many as `effective` equal weights; `amplitudes` are the standard deviations of the log value that
    they give to what makes machines differ. `widening` is the factor by which the sigma of machines that were not measured is
    larger for what the left-out ones err by.

    `machines` are mu and sigma, the mean and the standard deviation of the log value on a machine of a type. `left_out` are the
    measured log value, and mu and sigma as far as the other machines say.
    """

    models: int
    effective: float
    amplitudes: dict[str, float]
    widening: float
    machines: dict[str, tuple[float, float]]
    left_out: dict[str, tuple[float, float, float]] = Field({})


class ServerShift(Strict):
    """How servers of one type differ in a cloud: with probability `tail` by a normal variable of deviation `spread`."""

    tail: float
    spread: float


class SampleValues(Strict):
    """What a sample measured, by target."""

    id: str
    values: dict[str, float]


class ModelsBody(Strict):
    """What was fitted; `measured_on_local` says that the samples were shapes of one host, not machines on offer.

    The latency on another server of a type is exp of a mixture of two normals, (1 - tail) N(mu, sigma^2) + tail N(mu,
    sigma^2 + spread^2), with the `shift` of the machine's cloud; a metric is the first of them with tail 0. `predictions` are
    by target, of the machines that were measured and those in the menu: empty where curves of the families predict. `samples`
    are those that count.

    `inputs` is the record of all that it was fitted from (`fogspec.language.fingerprints.fitted_record`).
    """

    inputs: dict[str, Any]
    measured_on_local: bool = False
    models: list[Model] = Field([])
    samples: list[SampleValues] = Field([])
    shift: dict[str, ServerShift] = Field({})
    predictions: dict[str, PredictedTarget] = Field({})


class Models(Strict):
    """`kind: Models`: written by `compile` once there are results."""

    apiVersion: Literal["fogspec.dev/v1alpha1"] = "fogspec.dev/v1alpha1"
    kind: Literal["Models"] = "Models"
    metadata: PlanMetadata
    spec: ModelsBody


@dataclass(frozen=True, slots=True, kw_only=True)
class Fitted:
    """What models are made from, and the curves; `inputs` and `measured_on_local` are those of `ModelsBody`."""

    name: str
    inputs: dict[str, Any]
    measured_on_local: bool
    curves: Sequence[Model]
    observations: Sequence[Observation]
    rejected: Sequence[RejectedSample]

    def document(self, shift: Mapping[str, ServerShift], predictions: Mapping[str, PredictedTarget]) -> Models:
        """Return the document with these predictions; whatever else is known of a sample stands in the results."""
        body = ModelsBody(
            inputs=self.inputs,
            measured_on_local=self.measured_on_local,
            models=list(self.curves),
            samples=[SampleValues(id=one.id, values=dict(one.values)) for one in self.observations],
            shift=dict(shift),
            predictions=dict(predictions),
        )
        return Models(metadata=PlanMetadata(name=self.name), spec=body)


def fit(application: Application, results: Results, library: str | None = None) -> Fitted:
    """Return the observations, and the families' curves of every target for each sampled GPU type.

    `library` is the digest of the machine library that predictions are made with.
    """
    statistic = application.spec.constraints.statistic
    known, unusable = partition(results.spec.samples, statistic, results.arrivals)
    if results.spec.runner == PUBLISHED:
        known = [replace(one, published=True) for one in known]
    groups: dict[str | None, list[Observation]] = {}
    for one in known:
        groups.setdefault(one.machine.gpu_key, []).append(one)
    curves = [
        _model(target, gpu, with_it)
        for gpu, group in sorted(groups.items(), key=lambda item: item[0] or "")
        for target in targets(application)
        if (with_it := [one for one in group if target in one.values])
    ]
    return Fitted(
        name=application.metadata.name,
        inputs=fitted_record(application, fitted_from(results, library)),
        measured_on_local=is_proxy(application, known),
        curves=curves,
        observations=known,
        rejected=unusable,
    )


def fitted_from(results: Results | None, library: str | None) -> dict[str, Any]:
    """Return what the models depend on besides the spec, by name, None for what there is not."""
    return {RESULTS: None if results is None else results.integrity, LIBRARY: library, SURROGATE: VERSION}


def is_proxy(application: Application, known: Sequence[Observation]) -> bool:
    """Return True if shapes of this host were measured in place of the machines on offer."""
    return application.spec.infra != [LOCAL] and any(one.machine.is_local for one in known)


def partition(
    records: Sequence[Measured], statistic: Statistic, arrivals: Mapping[str, Arrivals] = NO_ARRIVALS
) -> tuple[list[Observation], list[RejectedSample]]:
    """Split the records, of which these `arrivals` are known by id, into observations and rejected samples."""
    entries = [_observation(record, statistic, arrivals.get(record.id)) for record in records]
    known = [one for one in entries if isinstance(one, Observation)]
    return known, [one for one in entries if isinstance(one, RejectedSample)]


def targets(application: Application) -> list[str]:
    """Return the targets: the latency, and the metrics in limits and the objective."""
    spec = application.spec
    metrics = {*spec.constraints.metrics, *([spec.objective.metric] if spec.objective.metric else [])}
    return ["latency", *sorted(metrics)]


def _observation(record: Measured, statistic: Statistic, arrivals: Arrivals | None) -> Observation | RejectedSample:
    # A run that answered nothing waited for its first request: that request takes longer than it waited.
    waited = record.latency_lower_bound if record.latency is None and record.latency_lower_bound else None

    def unusable(state: str, *, unfit: bool = False, **why: Any) -> RejectedSample:
        return RejectedSample(
            id=record.id,
            machine=record.machine,
            why=warned(codes.sample_rejected, sample=record.id, state=state, **why),
            excludes_machine=unfit,
            latency_lower_bound=waited,
            out_of_memory=record.reason == "out_of_memory",
        )

    if record.state != "ok" or record.latency is None:
        failed = ("crash", "out_of_memory", "no_response", "check", "out_of_range")
        unfit = record.state == "timeout" or record.reason in failed
        return unusable(record.reason or record.state, unfit=unfit, detail=record.detail or None)
    value = getattr(record.latency, statistic)
    if value is None:
        return unusable(record.state, statistic=statistic, requests=record.requests)
    if not LATENCY_S.holds(value):
        return unusable(record.state, latency_s=value)
    values = {"latency": value, **record.metrics}
    # Without the times of its requests: as if they had followed one another.
    busy_s = record.busy if record.busy is not None and LATENCY_S.holds(record.busy) else record.latency.mean
    return Observation(
        id=record.id,
        machine=record.machine,
        values=values,
        errors=_errors(record, statistic, _error_at_rate(arrivals, busy_s)),
        arrivals=arrivals,
        busy_ratio=rounded(busy_s / value, 9),
        at_work=rounded(at_work(record, busy_s), 4),
    )


def _error_at_rate(arrivals: Arrivals | None, busy_s: float) -> float:
    """Return which error of the latency of requests one after the other makes that at the rate err as its requests say."""
    if arrivals is None or arrivals.table is None:
        return 0.0
    work = busy_s * arrivals.requests_per_s
    return 0.0 if work >= 1 else min(arrivals.error / steepness(np.array(arrivals.table), work), ERROR.most)


def _errors(record: Measured, statistic: Statistic, at_rate: float) -> dict[str, float]:
    """Return the relative standard error of each target as a figure for all machines of the type, where it is known."""
    found = {} if record.metric_errors is None else dict.fromkeys(record.metrics, ERROR.most) | record.metric_errors
    known = record.errors is not None
    # By what others took of its CPUs, a contended sample may be off.
    lost = record.resources.outside or 0.0 if record.resources is not None and contended(record) else 0.0
    if known or lost:
        own = max(at_rate, (record.errors or {}).get(statistic, ERROR.most if known else DEFAULT_NOISE))
        found["latency"] = min(math.hypot(own, lost, SERVER_ERROR), ERROR.most)
    return {name: rounded(error, 5) for name, error in found.items()}


def _model(target: str, gpu: str | None, group: Sequence[Observation]) -> Model:
    vcpus = np.array([one.machine.cpus for one in group])
    memory = np.array([one.machine.memory for one in group])
    values = np.array([one.values[target] for one in group])
    fits = fit_all(vcpus, memory, values)
    best = families.select(fits)
    r2 = _finite(best.r2) if best.p > 1 else None
    return Model(
        target=target,
        gpu=gpu,
        cpu_family=best.shape.cpu,
        memory_family=best.shape.memory,
        formula=best.shape.formula(),
        coefficients=_coefficients(best),
        n=best.n,
        p=best.p,
        r2=r2,
        loo_median_error=_finite(best.loo_median),
        loo_max_error=_finite(best.loo_max),
        paper=_paper(fits, best.shape),
        vcpus=(float(vcpus.min()), float(vcpus.max())),
        memory_gib=(float(memory.min()), float(memory.max())),
    )


def _finite(value: float) -> float | None:
    return rounded(value, 5) if math.isfinite(value) else None


def _paper(fits: Sequence[Fit], own: families.Shape) -> PaperFit | None:
    best = families.select(fits, "r2")
    if not math.isfinite(best.r2) or best.shape == own:
        return None
    return PaperFit(
        cpu_family=best.shape.cpu,
        memory_family=best.shape.memory,
        formula=best.shape.formula(),
        coefficients=_coefficients(best),
        r2=rounded(best.r2, 5),
    )


def _coefficients(fit: Fit) -> dict[str, float]:
    return {name: rounded(value, 7) for name, value in zip(fit.shape.names, fit.coefficients, strict=True)}
