"""Latency by vCPUs, a coordinate system for each GPU type: what was sampled, what is predicted and how surely."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from fogspec.base.templates import render
from fogspec.charts.axes import axis, seconds
from fogspec.charts.frame import Dot, Frame, frame

WIDTH, LEFT, RIGHT = 760, 84, 18
TOP, FRAME_HEIGHT, GAP = 88, 230, 72


@dataclass(frozen=True, slots=True)
class Level:
    """What is predicted at a number of vCPUs: the median latency in seconds, and the span of all machines' intervals."""

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


@dataclass(frozen=True, slots=True)
class Panel:
    """One GPU type: `others` are (vCPUs, latency in seconds) of every admissible machine; `curve` is the paper's fit."""

    heading: str
    levels: Sequence[Level]
    samples: Sequence[Sample]
    others: Sequence[tuple[float, float]] = ()
    curve: Sequence[tuple[float, float]] = ()
    curve_words: str = ""


@dataclass(frozen=True, slots=True)
class LatencyChart:
    """What is drawn; `level` is that of the intervals."""

    title: str
    subtitle: str
    y_label: str
    panels: Sequence[Panel]
    level: float = 0.9
    notes: Sequence[str] = field(default_factory=tuple)


def draw(chart: LatencyChart) -> str:
    """The chart as SVG text; raises ValueError when there is nothing to draw."""
    if not chart.panels:
        raise ValueError("no model, no picture of one")
    step = FRAME_HEIGHT + GAP
    frames = [_frame(panel, TOP + step * i, chart.y_label) for i, panel in enumerate(chart.panels)]
    bottom = TOP + step * len(frames) - GAP
    return render(
        "picture.svg.j2", title=chart.title, subtitle=[chart.subtitle], width=WIDTH, height=bottom + 88 + 15 * len(chart.notes),
        left=18, rows=[], frames=frames, legend=_legend(chart), legend_y=bottom + 66, notes=chart.notes,
        summary="; ".join(f"{p.heading}: {len(p.samples)} samples" for p in chart.panels),
    )  # fmt: skip


def _frame(panel: Panel, top: float, y_label: str) -> Frame:
    x_values = [*(v for v, _ in panel.others), *(a.vcpus for a in panel.levels), *(b.vcpus for b in panel.samples)]
    x = axis(x_values, LEFT, WIDTH - RIGHT)
    found = frame(x, axis(_heights(panel), top + FRAME_HEIGHT, top), "vCPUs (log scale)", f"{y_label} (log scale)",
                  lambda v: f"{v:g}", seconds, panel.heading)  # fmt: skip
    found.x_ticks = [(x.at(2.0**e), f"{2**e}" if e >= 0 else f"{2.0**e:g}") for e in range(-2, 12)
                     if x.low <= x.high and x.start <= x.at(2.0**e) <= x.end]  # fmt: skip
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
        found.dots.append(Dot(x.at(one.vcpus), found.y.at(one.latency_s), "measured", 4.2, title, bar))
    found.remark = panel.curve_words
    return found


def _heights(panel: Panel) -> list[float]:
    """What the axis shows: every value, and intervals as far as a factor of six from theirs."""
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
