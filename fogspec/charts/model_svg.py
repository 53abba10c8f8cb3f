"""Draw latency by vCPUs, one coordinate system for each GPU type: samples, predictions and their intervals."""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import NormalDist

import numpy as np

from fogspec.base.templates import render
from fogspec.catalog.machine import Machine
from fogspec.catalog.table import Floats
from fogspec.charts.axes import axis, seconds
from fogspec.charts.chart import interval_of
from fogspec.charts.frame import Dot, Frame, frame
from fogspec.choice.choose import Choice
from fogspec.choice.menu import LEVEL
from fogspec.model.fit import Models, Observation
from fogspec.numerics import families
from fogspec.numerics.observations import DEFAULT_NOISE
from fogspec.spec.schema import Application

WIDTH, LEFT, RIGHT = 760, 84, 18
TOP, FRAME_HEIGHT, GAP = 88, 230, 72
CURVE_POINTS = 60

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Level:
    """The prediction at a number of vCPUs: the median latency in seconds, and the span of all machines' intervals."""

    vcpus: float
    latency_s: float
    low_s: float | None = None
    high_s: float | None = None


@dataclass(frozen=True, slots=True)
class Sample:
    """A machine that was measured."""

    name: str
    vcpus: float
    latency_s: float
    low_s: float | None = None
    high_s: float | None = None
    nested_in: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """One GPU type: `others` are (vCPUs, latency in seconds) of every admissible machine; `curve` is the paper's fit."""

    heading: str
    levels: Sequence[Level]
    samples: Sequence[Sample]
    others: Sequence[tuple[float, float]] = ()
    curve: Sequence[tuple[float, float]] = ()
    curve_words: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class LatencyChart:
    """A chart with one panel for each GPU type; `level` is the level of the intervals."""

    title: str
    subtitle: str
    y_label: str
    panels: Sequence[Panel]
    level: float = 0.9
    notes: Sequence[str] = field(default_factory=tuple)


def latency_chart(application: Application, choice: Choice, models: Models, caveats: Sequence[str]) -> LatencyChart:
    """Return the chart of latency by vCPUs for each sampled GPU type; the first caveat is printed below it.

    Caveats about the chosen machine alone belong to the menu: they are left out unless all samples are extrapolated.
    """
    statistic = application.spec.constraints.statistic
    gpus = sorted({_gpu_of(one.machine) for one in models.spec.observations}, key=lambda gpu: gpu or ("", 0.0))
    panels = [_panel(choice, models, gpu) for gpu in gpus]
    how = "shapes of one host" if models.spec.measured_on_local else "machines"
    return LatencyChart(
        title=f"{application.metadata.name}: latency by vCPUs",
        subtitle=f"{statistic} latency of one request; {len(models.spec.observations)} {how} measured",
        y_label=f"{statistic} latency",
        panels=panels,
        level=LEVEL,
        notes=textwrap.wrap(caveats[0], 112) if caveats and models.spec.measured_on_local else (),
    )


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
    return Panel(
        heading=heading,
        levels=_levels(choice, rows),
        samples=samples,
        others=[(v, latency) for v, latency in others],
        curve=curve,
        curve_words=words,
    )


def _curve(models: Models, gpu: tuple[str, float] | None, vcpus: Floats, memory: Floats) -> tuple[list[Point], str]:
    """Return the curve of the family with the best leave-one-out error (paper, section 2.C) and its formula.

    Memory is the median memory per vCPU.
    """
    key = None if gpu is None else f"{gpu[0]}:{gpu[1]:g}"
    model = next((one for one in models.spec.models if one.gpu == key and one.target == "latency"), None)
    if model is None or not len(vcpus):
        return [], ""
    at = np.geomspace(vcpus.min(), vcpus.max(), CURVE_POINTS)
    ratio = float(np.median(memory / vcpus))
    latency = families.predict(model.shape, list(model.coefficients.values()), at, at * ratio)
    r2 = "" if model.r2 is None else f", R² {model.r2:.3f}"
    return list(zip(at.tolist(), latency.tolist(), strict=True)), f"paper's families: {model.formula}{r2}"


def _levels(choice: Choice, rows: np.ndarray) -> list[Level]:
    """Return the median prediction for each number of vCPUs, and the span of all machines' intervals.

    The interval of a single machine would be narrow where few machines were measured, and exclude the others.
    """
    choice.latency.intervals(_each_once(choice, rows), LEVEL)  # together, and each from there
    found = []
    for vcpus in np.unique(choice.offers.vcpus[rows]).tolist():
        here = rows[choice.offers.vcpus[rows] == vcpus]
        intervals = [one for row in _each_once(choice, here) if (one := interval_of(choice.latency, row))]
        low, high = (min(a for a, _ in intervals), max(b for _, b in intervals)) if intervals else (None, None)
        found.append(Level(vcpus, float(np.median(choice.latency.value[here])), low, high))
    return found


def _each_once(choice: Choice, rows: np.ndarray) -> list[int]:
    """Return one row of each instance type, because latency does not depend on the region."""
    _, first = np.unique(choice.latency.type_index[rows], return_index=True)
    found: list[int] = rows[first].tolist()
    return found


def _sample(one: Observation) -> Sample:
    latency, t = one.values["latency"], NormalDist().inv_cdf((1 + LEVEL) / 2)
    error = DEFAULT_NOISE if one.error is None else one.error
    return Sample(
        one.machine.instance,
        one.machine.cpus,
        latency,
        latency * math.exp(-t * error),
        latency * math.exp(t * error),
        one.nested_in,
    )


def _gpu_of(machine: Machine) -> tuple[str, float] | None:
    return None if machine.gpu is None else (machine.gpu.name, float(machine.gpu.count))


def draw(chart: LatencyChart) -> str:
    """Return the chart as SVG text. Raise ValueError if there is no panel to draw."""
    if not chart.panels:
        raise ValueError("no model, no picture of one")
    step = FRAME_HEIGHT + GAP
    frames = [_frame(panel, TOP + step * i, chart.y_label) for i, panel in enumerate(chart.panels)]
    bottom = TOP + step * len(frames) - GAP
    return render(
        "picture.svg.j2",
        title=chart.title,
        subtitle=[chart.subtitle],
        width=WIDTH,
        height=bottom + 88 + 15 * len(chart.notes),
        left=18,
        rows=[],
        frames=frames,
        legend=_legend(chart),
        legend_y=bottom + 66,
        notes=chart.notes,
        summary="; ".join(f"{p.heading}: {len(p.samples)} samples" for p in chart.panels),
    )


def _frame(panel: Panel, top: float, y_label: str) -> Frame:
    x_values = [*(v for v, _ in panel.others), *(a.vcpus for a in panel.levels), *(b.vcpus for b in panel.samples)]
    x = axis(x_values, LEFT, WIDTH - RIGHT)
    found = frame(
        x=x,
        y=axis(_heights(panel), top + FRAME_HEIGHT, top),
        x_label="vCPUs (log scale)",
        y_label=f"{y_label} (log scale)",
        x_words=lambda v: f"{v:g}",
        y_words=seconds,
        heading=panel.heading,
    )
    found.x_ticks = [
        (x.at(2.0**e), f"{2**e}" if e >= 0 else f"{2.0**e:g}")
        for e in range(-2, 12)
        if x.low <= x.high and x.start <= x.at(2.0**e) <= x.end
    ]
    band = [one for one in panel.levels if one.low_s and one.high_s]
    if len(band) > 1:
        upper = [(x.at(one.vcpus), found.y.clipped(one.high_s or 0)) for one in band]
        lower = [(x.at(one.vcpus), found.y.clipped(one.low_s or 0)) for one in reversed(band)]
        found.areas.append(("band", _path([*upper, *lower]) + "Z"))
    if panel.others:
        cells = sorted({(round(x.at(v)), round(found.y.clipped(latency))) for v, latency in panel.others})
        found.specks.append(("out", "".join(f"M{px} {py}h0" for px, py in cells)))
    if panel.curve:
        visible = [(x.at(v), found.y.at(latency)) for v, latency in panel.curve if latency > 0]
        inside = [(px, py) for px, py in visible if found.y.end <= py <= found.y.start]
        if len(inside) > 1:
            found.lines.append(("paper", _path(inside)))
    if len(panel.levels) > 1:
        found.lines.append(
            ("curve", _path([(x.at(one.vcpus), found.y.clipped(one.latency_s)) for one in panel.levels]))
        )
    for one in sorted(panel.samples, key=lambda s: (s.vcpus, s.latency_s, s.name)):
        bar = (found.y.clipped(one.low_s), found.y.clipped(one.high_s)) if one.low_s and one.high_s else None
        title = f"{one.name}: {one.vcpus:g} vCPUs, {seconds(one.latency_s)}, measured"
        title += "" if one.nested_in is None else f" on {one.nested_in}, not itself"
        kind = "measured" if one.nested_in is None else "predicted"
        found.dots.append(
            Dot(x=x.at(one.vcpus), y=found.y.at(one.latency_s), kind=kind, radius=4.2, title=title, bar=bar)
        )
    found.remark = panel.curve_words
    return found


def _heights(panel: Panel) -> list[float]:
    """Return the values on the axis: all latencies, and interval ends within a factor of six of their latency."""
    drawn = [(one.latency_s, one.low_s, one.high_s) for one in panel.levels]
    drawn += [(one.latency_s, one.low_s, one.high_s) for one in panel.samples]
    values = [latency for latency, _, _ in drawn] + [latency for _, latency in panel.others]
    ends = [end for at, low, high in drawn for end in (low, high) if end and at / 6 < end < at * 6]
    return [value for value in (*values, *ends) if value > 0]


def _path(points: Sequence[tuple[float, float]]) -> str:
    return "M" + "L".join(f"{x:g} {y:g}" for x, y in points)


def _legend(chart: LatencyChart) -> list[tuple[str, str]]:
    found = [("measured", "measured"), ("curve", "predicted (median)")]
    if any(one.low_s for panel in chart.panels for one in panel.levels):
        found.append(("band", f"{chart.level:.0%} intervals of all machines"))
    found.append(("out", "a machine"))
    if any(panel.curve for panel in chart.panels):
        found.append(("paper", "paper's families"))
    return found
