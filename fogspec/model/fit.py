"""What was measured, as the models take it, and the curves of the paper's families over it.

Predictions come from the surrogate (`fogspec.model.predict`, ADR 0020), which is conditioned on `observations` and
`rejected`. The families of section 2.C are fitted beside it, one for each GPU type and target (the latency, or a metric of the
application), chosen by leave-one-out error (ADR 0008): for comparison and for shapes of one host; and by the largest R² for the
relaxed method (ADR 0131).
"""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from fogspec.base.clouds import LOCAL
from fogspec.base.quantities import Duration, Lean, Strict
from fogspec.catalog.machine import Machine
from fogspec.numerics import families
from fogspec.numerics.families import Fit, fit_all
from fogspec.numerics.kernels import distinct
from fogspec.numerics.observations import DEFAULT_NOISE
from fogspec.numerics.surrogate import VERSION
from fogspec.plan.schema import PlanMetadata
from fogspec.results.ranges import LATENCY_S
from fogspec.results.schema import Measured, Results
from fogspec.spec.schema import Application, Statistic

# Two servers of one type differ, whatever is measured on each: median coefficient of variation of repeated
# measurements over Spare Cores' public benchmarks (SpareCores/sc-inspector-data).
SERVER_ERROR = 0.015
MOST_ERROR = 10.0
MOST_MISSED = 1000.0
# The standard error of a quantile over that of the mean, of a normal variable: sqrt(p (1 - p)) / density.
ERROR_OF = {"mean": 1.0, "p50": 1.25, "p95": 2.11, "p99": 3.74}


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
    """One fitted curve of the paper's families; `coefficients` in the order of the formula.

    `vcpus` and `memory_gib` are the ranges that were sampled. Errors are relative, from leaving one sample out.
    """

    target: str
    gpu: str | None
    cpu_family: str
    memory_family: str
    formula: str
    coefficients: dict[str, float]
    n: int
    p: int
    r2: float | None
    loo_median_error: float | None
    loo_max_error: float | None
    paper: PaperFit | None
    vcpus: tuple[float, float]
    memory_gib: tuple[float, float]
    samples: list[str]
    warnings: list[str]

    @property
    def shape(self) -> families.Shape:
        """The families of this model."""
        return families.Shape(self.cpu_family, self.memory_family)


class Observation(Lean):
    """A machine that was measured: its values by target, and the latency's relative standard error, null if it is unknown.

    One that is `nested_in` a larger machine was measured on a part of it, and not itself (ADR 0025).
    """

    id: str
    machine: Machine
    values: dict[str, float]
    error: float | None
    nested_in: str | None = None

    ADDED = frozenset({"nested_in"})


class RejectedSample(Lean):
    """A sample without a value, and why.

    `excludes_machine`: the machine itself failed; `out_of_memory`: it ran out of memory, so machines with no more memory are
    ruled out too; `latency_lower_bound` comes from a run that was given up in its first request.
    """

    id: str
    machine: Machine
    reason: str
    excludes_machine: bool
    out_of_memory: bool = False
    latency_lower_bound: Duration | None = None
    nested_in: str | None = None

    ADDED = frozenset({"nested_in"})


class Predictor(Strict):
    """What predicts: the surrogate's version, and the digest of the machine library that it was given, if any."""

    surrogate: int
    priors: str | None


class ModelsBody(Strict):
    """What was fitted; `measured_on_local` says that the samples were shapes of one host, not machines on offer."""

    statistic: Statistic
    measured_on_local: bool
    predictor: Predictor
    models: list[Model]
    observations: list[Observation]
    rejected: list[RejectedSample]


class Models(Strict):
    """`kind: Models`: written by `compile` once there are results."""

    apiVersion: Literal["fogspec.dev/v1alpha1"] = "fogspec.dev/v1alpha1"
    kind: Literal["Models"] = "Models"
    metadata: PlanMetadata
    spec: ModelsBody


def fit(application: Application, results: Results, priors: str | None = None) -> Models:
    """Return the observations, and the families' curves of every target for each sampled GPU type.

    `priors` is the digest of the machine library that predictions are made with.
    """
    statistic = application.spec.constraints.statistic
    known, unusable = partition(results.spec.samples, statistic)
    groups: dict[str | None, list[Observation]] = {}
    for one in known:
        groups.setdefault(_gpu_key(one.machine), []).append(one)
    models = [
        _model(target, gpu, with_it)
        for gpu, group in sorted(groups.items(), key=lambda item: item[0] or "")
        for target in targets(application)
        if (with_it := [one for one in group if target in one.values])
    ]
    body = ModelsBody(
        statistic=statistic,
        measured_on_local=is_proxy(application, known),
        predictor=Predictor(surrogate=VERSION, priors=priors),
        models=models,
        observations=known,
        rejected=unusable,
    )
    return Models(metadata=PlanMetadata(name=application.metadata.name), spec=body)


def is_proxy(application: Application, known: Sequence[Observation]) -> bool:
    """Return True if shapes of this host were measured in place of the machines on offer."""
    return application.spec.infra != [LOCAL] and any(one.machine.is_local for one in known)


def partition(records: Sequence[Measured], statistic: Statistic) -> tuple[list[Observation], list[RejectedSample]]:
    """Split the records into observations and rejected samples."""
    entries = [_observation(record, statistic) for record in records]
    known = [one for one in entries if isinstance(one, Observation)]
    return known, [one for one in entries if isinstance(one, RejectedSample)]


def targets(application: Application) -> list[str]:
    """Return the targets: the latency, and the metrics in limits and the objective."""
    spec = application.spec
    metrics = {*spec.constraints.metrics, *([spec.objective.metric] if spec.objective.metric else [])}
    return ["latency", *sorted(metrics)]


def _observation(record: Measured, statistic: Statistic) -> Observation | RejectedSample:
    # A run that answered nothing waited for its first request: that request takes longer than it waited.
    nested = record.nested_in
    waited = (
        record.latency_lower_bound if record.latency is None and record.latency_lower_bound and not nested else None
    )

    def unusable(why: str, unfit: bool) -> RejectedSample:
        return RejectedSample(
            id=record.id,
            machine=record.machine,
            reason=why,
            excludes_machine=unfit,
            latency_lower_bound=waited,
            out_of_memory=record.reason == "out_of_memory" and nested is None,
            nested_in=None if nested is None else nested.label,
        )

    if record.state != "ok" or record.latency is None:
        reason = (record.reason or record.state).replace("_", " ")
        # What fails in a part of a machine may run on a machine of that size.
        unfit = record.nested_in is None and (
            record.state == "timeout"
            or record.reason
            in (
                "crash",
                "out_of_memory",
                "no_response",
                "check",
                "out_of_range",
            )
        )
        return unusable(f"{reason}: {record.detail}" if record.detail else reason, unfit)
    value = getattr(record.latency, statistic)
    if value is None:
        return unusable(f"{record.requests} requests are too few for a {statistic}", unfit=False)
    if not LATENCY_S.holds(value):
        return unusable(f"a latency of {value:g} s is not a latency", unfit=False)
    values = {"latency": value, **record.metrics}
    return Observation(
        id=record.id,
        machine=record.machine,
        values=values,
        error=_error(record, statistic),
        nested_in=None if nested is None else nested.label,
    )


def _error(record: Measured, statistic: Statistic) -> float | None:
    """Return the relative standard error of the statistic as a figure for all machines of the type; None if it is unknown."""
    latency = record.latency
    known = latency is not None and latency.sd is not None
    if not known and record.nested_in is None:
        return None
    own = DEFAULT_NOISE
    if latency is not None and latency.sd is not None:
        own = ERROR_OF[statistic] * latency.sd / latency.mean / math.sqrt(max(record.requests, 1))
    if record.nested_in is not None and record.server is not None:
        # What the machine lost to others and to disks, a machine of that size may not lose.
        own = math.hypot(own, (record.server.steal or 0.0) + (record.server.io_wait or 0.0))
    # Beyond this the sample says nothing, whatever more it could.
    return _to(5, min(math.hypot(own, SERVER_ERROR), MOST_ERROR))


def _gpu_key(machine: Machine) -> str | None:
    return machine.gpu_key


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
        paper=_paper(fits),
        vcpus=(float(vcpus.min()), float(vcpus.max())),
        memory_gib=(float(memory.min()), float(memory.max())),
        samples=[one.id for one in group],
        warnings=_warnings(best, len(distinct(vcpus))),
    )


def _finite(value: float) -> float | None:
    return _to(5, value) if math.isfinite(value) else None


def _to(digits: int, value: float) -> float:
    """Round to significant digits, because later digits differ between processors and the file must not."""
    return float(f"{value:.{digits}g}")


def _paper(fits: Sequence[Fit]) -> PaperFit | None:
    best = families.select(fits, "r2")
    if not math.isfinite(best.r2):
        return None
    return PaperFit(
        cpu_family=best.shape.cpu,
        memory_family=best.shape.memory,
        formula=best.shape.formula(),
        coefficients=_coefficients(best),
        r2=_to(5, best.r2),
    )


def _coefficients(fit: Fit) -> dict[str, float]:
    return {name: _to(7, value) for name, value in zip(fit.shape.names, fit.coefficients, strict=True)}


def _warnings(best: Fit, levels: int) -> list[str]:
    found = []
    if best.n < 5:
        samples = "1 sample" if best.n == 1 else f"{best.n} samples"
        found.append(f"R² is not informative with {samples} and 2 parameters: it is high on noise too")
    if best.p == 1 and levels > 1:
        found.append("no curve has a lower leave-one-out error than the mean: the model is a constant")
    if math.isfinite(best.loo_max) and best.loo_max > families.WEAK_ERROR:
        worst = (
            f"up to {best.loo_max:.0%}"
            if best.loo_max < MOST_MISSED
            else f"more than {MOST_MISSED:.0f} times its value"
        )
        found.append(f"leave-one-out error of {worst}, whatever R² is")
    return found
