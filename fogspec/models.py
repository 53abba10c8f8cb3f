"""Fitted models: from what was measured to a prediction, with its uncertainty, for every machine on offer.

One model for each GPU type and target (the latency, or a metric of the application): section 2.C of the paper's
families, chosen by leave-one-out error (ADR 0008). A machine that was measured is predicted by its measurement.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fogspec.base.fields import Strict
from fogspec.catalog import Catalog, Floats, Texts
from fogspec.numerics import curves, fitting
from fogspec.numerics.families import Fit, fit_all
from fogspec.plan import MachineRef, PlanMetadata
from fogspec.results import Measured, Results
from fogspec.spec import Application, Statistic

Mask = NDArray[np.bool_]

# Two machines of one type differ: coefficient of variation of repeated measurements, median and 90th percentile
# over Spare Cores' public benchmarks (SpareCores/sc-inspector-data). The larger one where the spread is unknown.
MACHINE_DEVIATION = 0.015
UNKNOWN_DEVIATION = 0.045
NORMAL_DOF = 200
EXTRAPOLATION_SLACK = 1e-9


class Spread(Strict):
    """How wrong predictions are expected to be, from leaving one sample out; see `fogspec.numerics.fitting.Spread`."""

    relative: float
    absolute: float
    residual: float
    dof: int


class PaperFit(Strict):
    """What the paper's rule, the largest R², would have taken."""

    formula: str
    r2: float


class Model(Strict):
    """One fitted curve; `coefficients` in the order of the formula, `covariance` in the same order.

    `vcpus` and `memory_gib` are the ranges that were sampled. Errors are relative, from leaving one sample out.
    """

    target: str
    gpu: str | None
    cpu_family: str
    memory_family: str
    formula: str
    coefficients: dict[str, float]
    covariance: list[list[float]]
    spread: Spread | None
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
    def shape(self) -> curves.Shape:
        """The families of this model."""
        return curves.Shape(self.cpu_family, self.memory_family)


class Known(Strict):
    """A machine that was measured: its values by target, and the standard deviation of the latency as a share."""

    id: str
    machine: MachineRef
    values: dict[str, float]
    deviation: float


class Unusable(Strict):
    """A sample that no model uses, and why; `unfit` says that the machine itself was seen to fail."""

    id: str
    machine: MachineRef
    why: str
    unfit: bool


class ModelsBody(Strict):
    """What was fitted; `measured_on_local` says that the samples were shapes of one host, not machines on offer."""

    statistic: Statistic
    measured_on_local: bool
    models: list[Model]
    known: list[Known]
    unusable: list[Unusable]


class Models(Strict):
    """`kind: Models`: written by `compile` once there are results."""

    apiVersion: Literal["fogspec.dev/v1alpha1"] = "fogspec.dev/v1alpha1"
    kind: Literal["Models"] = "Models"
    metadata: PlanMetadata
    spec: ModelsBody


def fit(application: Application, results: Results) -> Models:
    """The models of everything that the application's limits and objective need, for each GPU type that was sampled."""
    statistic = application.spec.constraints.statistic
    known, unusable = [], []
    for record in results.spec.samples:
        entry = _known(record, statistic)
        if isinstance(entry, Known):
            known.append(entry)
        else:
            unusable.append(entry)
    wanted = _targets(application)
    groups: dict[str | None, list[Known]] = {}
    for one in known:
        groups.setdefault(_gpu_key(one.machine), []).append(one)
    models = [
        _model(target, gpu, with_it)
        for gpu, group in sorted(groups.items(), key=lambda item: item[0] or "")
        for target in wanted
        if (with_it := [one for one in group if target in one.values])
    ]
    body = ModelsBody(
        statistic=statistic, measured_on_local=any(k.machine.infra == "local" for k in known),
        models=models, known=known, unusable=unusable,
    )  # fmt: skip
    return Models(metadata=PlanMetadata(name=application.metadata.name), spec=body)


def _targets(application: Application) -> list[str]:
    spec = application.spec
    metrics = {*spec.constraints.metrics, *([spec.objective.metric] if spec.objective.metric else [])}
    return ["latency", *sorted(metrics)]


def _known(record: Measured, statistic: Statistic) -> Known | Unusable:
    def unusable(why: str, unfit: bool) -> Unusable:
        return Unusable(id=record.id, machine=record.machine, why=why, unfit=unfit)

    if record.state != "ok" or record.latency is None:
        reason = (record.reason or record.state).replace("_", " ")
        unfit = record.state == "timeout" or record.reason in (
            "crash",
            "out_of_memory",
            "no_response",
            "check",
        )
        return unusable(f"{reason}: {record.detail}" if record.detail else reason, unfit)
    value = getattr(record.latency, statistic)
    if value is None:
        return unusable(f"{record.requests} requests are too few for a {statistic}", unfit=False)
    if not (math.isfinite(value) and value > 0):
        return unusable(f"a latency of {value:g} s is no latency", unfit=False)
    sd = record.latency.sd
    own = UNKNOWN_DEVIATION if sd is None else sd / record.latency.mean / math.sqrt(max(record.requests, 1))
    return Known(
        id=record.id, machine=record.machine, values={"latency": value, **record.metrics},
        deviation=_to(5, math.hypot(own, MACHINE_DEVIATION)),
    )  # fmt: skip


def _gpu_key(machine: MachineRef) -> str | None:
    return None if machine.gpu is None else f"{machine.gpu.name}:{machine.gpu.count:g}"


def _model(target: str, gpu: str | None, group: Sequence[Known]) -> Model:
    vcpus = np.array([one.machine.cpus for one in group])
    memory = np.array([one.machine.memory for one in group])
    values = np.array([one.values[target] for one in group])
    fits = fit_all(vcpus, memory, values)
    best = fitting.select(fits)
    spread = fitting.spread_of(best, values)
    named = zip(best.shape.names, best.coefficients, strict=True)
    r2 = _finite(best.r2) if best.p > 1 else None
    return Model(
        target=target, gpu=gpu, cpu_family=best.shape.cpu, memory_family=best.shape.memory,
        formula=best.shape.formula(), coefficients={name: _to(7, value) for name, value in named},
        covariance=[[_to(5, v) for v in row] for row in best.covariance],
        spread=None if spread is None else Spread(
            relative=_to(5, spread.relative), absolute=_to(5, spread.absolute), residual=_to(5, spread.residual),
            dof=spread.dof,
        ),
        n=best.n, p=best.p, r2=r2, loo_median_error=_finite(best.loo_median), loo_max_error=_finite(best.loo_max),
        paper=_paper(fits), vcpus=(float(vcpus.min()), float(vcpus.max())),
        memory_gib=(float(memory.min()), float(memory.max())),
        samples=[one.id for one in group], warnings=_warnings(best, spread, len(np.unique(vcpus))),
    )  # fmt: skip


def _finite(value: float) -> float | None:
    return _to(5, value) if math.isfinite(value) else None


def _to(digits: int, value: float) -> float:
    """Rounded to significant digits: what lies beyond differs between processors, and the file must not."""
    return float(f"{value:.{digits}g}")


def _paper(fits: Sequence[Fit]) -> PaperFit | None:
    best = fitting.select(fits, "r2")
    return PaperFit(formula=best.shape.formula(), r2=_to(5, best.r2)) if math.isfinite(best.r2) else None


def _warnings(best: Fit, spread: fitting.Spread | None, levels: int) -> list[str]:
    found = []
    if best.n < 5:
        found.append(f"{best.n} samples: R² of two-parameter curves says nothing here, even on noise it is high")
    if best.p == 1 and levels > 1:
        found.append("no curve predicts a left-out sample better than the mean: the model is a constant")
    if spread is None:
        found.append("too few samples to leave one out: predictions have no interval")
    elif math.isfinite(best.loo_max) and best.loo_max > fitting.WEAK_ERROR:
        found.append(f"a left-out sample is missed by up to {best.loo_max:.0%}, whatever R² says")
    return found


@dataclass(frozen=True, slots=True)
class Predictions:
    """For each of n offers: value (n,), its standard deviation as a share and degrees of freedom; NaN where none.

    `measured`: the value is this machine's own measurement; `extrapolated`: it lies outside what was sampled;
    `unfit`: the machine was measured and failed. Shapes of one host say nothing of how far off other machines are:
    predictions from them have no deviation.
    """

    value: Floats
    deviation: Floats
    dof: NDArray[np.int32]
    measured: Mask
    extrapolated: Mask
    unfit: Mask

    def interval(self, row: int, level: float) -> tuple[float, float] | None:
        """Two-sided prediction interval of one offer, None where the model cannot say."""
        if not math.isfinite(self.deviation[row]):
            return None
        low, high = fitting.interval(self.value[row], self.deviation[row], int(self.dof[row]), level, relative=True)
        return float(low), float(high)

    def probability_below(self, row: int, bound: float) -> float | None:
        """Probability that one offer's true value is at most `bound`, None where the model cannot say."""
        if not math.isfinite(self.deviation[row]):
            return None
        return float(
            fitting.probability_below(bound, self.value[row], self.deviation[row], int(self.dof[row]), relative=True)
        )


def predict(models: Models, offers: Catalog, target: str = "latency") -> Predictions:
    """Predictions of one target for every offer; a value that is not positive is no prediction."""
    n = len(offers)
    found = Predictions(
        np.full(n, np.nan), np.full(n, np.nan), np.full(n, NORMAL_DOF, np.int32),
        np.zeros(n, bool), np.full(n, models.spec.measured_on_local), np.zeros(n, bool),
    )  # fmt: skip
    rows_of = _rows_by_gpu(offers)
    for model in models.spec.models:
        rows = rows_of.get(model.gpu)
        if model.target == target and rows is not None:
            _from_model(model, offers, rows, found)
    if not models.spec.measured_on_local:
        _from_measurements(models, offers, target, found)
    else:
        found.deviation[:] = np.nan
    found.value[~(np.isfinite(found.value) & (found.value > 0))] = np.nan
    return found


def _rows_by_gpu(offers: Catalog) -> Mapping[str | None, NDArray[np.intp] | slice]:
    has = offers.gpu_count > 0
    if not has.any():
        return {None: slice(None)}
    found: dict[str | None, NDArray[np.intp] | slice] = {None: np.flatnonzero(~has)}
    groups: dict[str, list[int]] = {}
    for row in np.flatnonzero(has).tolist():
        groups.setdefault(f"{offers.gpu[row]}:{offers.gpu_count[row]:g}", []).append(row)
    return {**found, **{key: np.array(rows) for key, rows in groups.items()}}


def _from_model(model: Model, offers: Catalog, rows: NDArray[np.intp] | slice, found: Predictions) -> None:
    vcpus, memory = offers.vcpus[rows], offers.memory_gib[rows]
    coefficients = list(model.coefficients.values())
    found.value[rows] = curves.predict(model.shape, coefficients, vcpus, memory)
    if model.spread is not None:
        spread = fitting.Spread(**model.spread.model_dump())
        found.deviation[rows] = np.hypot(
            fitting.deviations(model.shape, coefficients, model.covariance, spread, vcpus, memory, relative=True),
            MACHINE_DEVIATION,
        )
        found.dof[rows] = min(spread.dof, NORMAL_DOF)
    low, high = (1 - EXTRAPOLATION_SLACK, 1 + EXTRAPOLATION_SLACK)
    outside = (vcpus < model.vcpus[0] * low) | (vcpus > model.vcpus[1] * high) | (memory < model.memory_gib[0] * low)
    if model.memory_family != "constant":
        outside = outside | (memory > model.memory_gib[1] * high)
    found.extrapolated[rows] |= outside


def _from_measurements(models: Models, offers: Catalog, target: str, found: Predictions) -> None:
    """A measured machine is its measurement, wherever the same type is rented; one that failed stays out."""
    unfit = {_machine_key(one.machine): None for one in models.spec.unusable if one.unfit}
    known = {_machine_key(one.machine): one for one in models.spec.known if target in one.values}
    if not unfit and not known:
        return
    instances = {name for _, name in (*unfit, *known)}
    for row in _positions(offers.instance, instances):
        key = (str(offers.cloud[row]), str(offers.instance[row]))
        if (one := known.get(key)) is not None and _same_gpu(one.machine, offers, row):
            found.value[row], found.deviation[row] = one.values[target], one.deviation
            found.dof[row], found.measured[row], found.extrapolated[row] = NORMAL_DOF, True, False
        elif key in unfit:
            found.unfit[row] = True


def _machine_key(machine: MachineRef) -> tuple[str, str]:
    return machine.infra.split("/")[0], machine.instance


def _same_gpu(machine: MachineRef, offers: Catalog, row: int) -> bool:
    gpu = machine.gpu
    return str(offers.gpu[row]) == (gpu.name if gpu else "") and float(offers.gpu_count[row]) == (
        gpu.count if gpu else 0
    )


def _positions(column: Texts, wanted: set[str]) -> list[int]:
    return [row for row, text in enumerate(column.tolist()) if text in wanted]
