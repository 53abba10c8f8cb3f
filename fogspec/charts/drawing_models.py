"""From fitted models to the picture of latency by vCPUs."""

import math
from statistics import NormalDist

import numpy as np

from fogspec.catalog.machine import Machine
from fogspec.catalog.table import Floats
from fogspec.charts.model_svg import LatencyChart, Level, Panel, Sample
from fogspec.choice.choose import Choice
from fogspec.choice.menu import LEVEL
from fogspec.model.fit import Models, Observation
from fogspec.model.predict import Predictions
from fogspec.numerics import curves
from fogspec.spec.schema import Application

CURVE_POINTS = 60

Point = tuple[float, float]


def interval_of(predictions: Predictions, row: int) -> tuple[float, float] | None:
    """The interval that is drawn; None where the model cannot say."""
    found = predictions.interval(row, LEVEL)
    return None if found is None or not (found[0] > 0 and math.isfinite(found[1])) else found


def latency_chart(application: Application, choice: Choice, models: Models) -> LatencyChart:
    """Latency by vCPUs for each GPU type that was sampled."""
    statistic = application.spec.constraints.statistic
    gpus = sorted({_gpu_of(one.machine) for one in models.spec.observations}, key=lambda gpu: gpu or ("", 0.0))
    panels = [_panel(choice, models, gpu) for gpu in gpus]
    how = "shapes of one host" if models.spec.measured_on_local else "machines"
    return LatencyChart(
        title=f"{application.metadata.name}: latency by vCPUs",
        subtitle=f"{statistic} latency of one request; {len(models.spec.observations)} {how} measured",
        y_label=f"{statistic} latency", panels=panels, level=LEVEL,
    )  # fmt: skip


def _panel(choice: Choice, models: Models, gpu: tuple[str, float] | None) -> Panel:
    offers, value = choice.offers, choice.latency.value
    name, count = gpu or ("", 0.0)
    rows = np.flatnonzero((offers.gpu == name) & (offers.gpu_count == count) & choice.eligible)
    samples = [
        _sample(one) for one in models.spec.observations if _gpu_of(one.machine) == gpu and "latency" in one.values
    ]
    others = np.unique(np.column_stack([offers.vcpus[rows], value[rows]]), axis=0).tolist()
    heading = "machines without GPU" if gpu is None else f"machines with {count:g} {name}"
    curve, words = _curve(models, gpu, offers.vcpus[rows], offers.memory_gib[rows])
    return Panel(heading, _levels(choice, rows), samples, [(v, latency) for v, latency in others], curve, words)


def _curve(models: Models, gpu: tuple[str, float] | None, vcpus: Floats, memory: Floats) -> tuple[list[Point], str]:
    """The paper's family that leaves one out best (section 2.C), at the median memory per vCPU, and what it is."""
    key = None if gpu is None else f"{gpu[0]}:{gpu[1]:g}"
    model = next((one for one in models.spec.models if one.gpu == key and one.target == "latency"), None)
    if model is None or not len(vcpus):
        return [], ""
    at = np.geomspace(vcpus.min(), vcpus.max(), CURVE_POINTS)
    ratio = float(np.median(memory / vcpus))
    latency = curves.predict(model.shape, list(model.coefficients.values()), at, at * ratio)
    r2 = "" if model.r2 is None else f", R² {model.r2:.3f}"
    return list(zip(at.tolist(), latency.tolist(), strict=True)), f"paper's families: {model.formula}{r2}"


def _levels(choice: Choice, rows: np.ndarray) -> list[Level]:
    """For each number of vCPUs the median prediction, and what the intervals of all machines cover together.

    Not one machine's interval: where a few machines were measured, it would be narrow and leave out the others.
    """
    found = []
    for vcpus in np.unique(choice.offers.vcpus[rows]).tolist():
        here = rows[choice.offers.vcpus[rows] == vcpus]
        intervals = [one for row in _each_once(choice, here) if (one := interval_of(choice.latency, row))]
        low, high = (min(a for a, _ in intervals), max(b for _, b in intervals)) if intervals else (None, None)
        found.append(Level(vcpus, float(np.median(choice.latency.value[here])), low, high))
    return found


def _each_once(choice: Choice, rows: np.ndarray) -> list[int]:
    """One offer of each instance type: what a machine costs elsewhere does not change how fast it is."""
    _, first = np.unique(choice.latency.type_index[rows], return_index=True)
    found: list[int] = rows[first].tolist()
    return found


def _sample(one: Observation) -> Sample:
    latency, t = one.values["latency"], NormalDist().inv_cdf((1 + LEVEL) / 2)
    return Sample(
        one.machine.instance, one.machine.cpus, latency, latency * math.exp(-t * one.error),
        latency * math.exp(t * one.error),
    )  # fmt: skip


def _gpu_of(machine: Machine) -> tuple[str, float] | None:
    return None if machine.gpu is None else (machine.gpu.name, float(machine.gpu.count))
