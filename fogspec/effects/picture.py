"""The menu as a picture: cost against latency, the Pareto staircase, the limits and the choice.

A pure function of its arguments that gives the same bytes for the same chart; the SVG has no script, follows
the reader's light or dark setting, and is legible at 600 px.
"""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from fogspec.effects.templates import render

WIDTH, HEIGHT = 760, 480
LEFT, RIGHT, TOP, BOTTOM = 78, 20, 82, 76
LABEL_HEIGHT = 17


@dataclass(frozen=True, slots=True)
class Point:
    """One machine: latency in seconds with its interval, and cost in USD per request."""

    name: str
    latency_s: float
    cost_usd_per_request: float
    low_s: float | None = None
    high_s: float | None = None
    measured: bool = False
    on_front: bool = False
    role: Literal["", "chosen", "cheapest", "fastest"] = ""


@dataclass(frozen=True, slots=True)
class Chart:
    """What is drawn; limits are drawn as regions that are not allowed."""

    title: str
    subtitle: str
    latency_label: str
    points: Sequence[Point]
    latency_limit_s: float | None = None
    cost_limit_usd_per_request: float | None = None
    warning: str | None = None


@dataclass(frozen=True, slots=True)
class _Axis:
    low: float
    high: float
    start: float
    end: float

    def at(self, value: float) -> float:
        share = (math.log10(value) - self.low) / (self.high - self.low)
        return round(self.start + share * (self.end - self.start), 1)

    def within(self, value: float | None) -> float | None:
        """Where a limit is drawn; None for no limit, and for one beyond everything that is shown."""
        return None if value is None or math.log10(value) > self.high else self.clipped(value)

    def clipped(self, value: float) -> float:
        """Where a value is drawn, at the frame's edge if it lies outside."""
        low, high = sorted((self.start, self.end))
        return min(max(self.at(value), low), high)

    def ticks(self) -> list[float]:
        """1, 2 and 5 of each decade, thinned so that the labels do not touch."""
        for steps in ((1, 1.5, 2, 3, 4, 5, 7), (1, 2, 5), (1, 3), (1,)):
            found = [m * 10.0**d for d in range(math.floor(self.low), math.ceil(self.high) + 1) for m in steps
                     if self.low <= math.log10(m * 10.0**d) <= self.high]  # fmt: skip
            if len(found) <= 8:
                return found
        return found[:: math.ceil(len(found) / 8)]


def draw(chart: Chart) -> str:
    """The chart as SVG text; raises ValueError when there is no point to draw."""
    if not chart.points:
        raise ValueError("a menu without machines cannot be drawn")
    x, y = _axes(chart)
    points = sorted(chart.points, key=lambda p: (p.role != "", p.measured, p.cost_usd_per_request, p.name))
    return render(
        "menu.svg.j2",
        chart=chart, width=WIDTH, height=HEIGHT, x=x, y=y,
        x_ticks=[(x.at(t), money(t)) for t in x.ticks()],
        y_ticks=[(y.at(t), seconds(t)) for t in y.ticks()],
        dots=[_dot(p, x, y) for p in points],
        staircase=_staircase([p for p in points if p.on_front], x, y),
        labels=_labels([p for p in points if p.role], x, y),
        limit_y=y.within(chart.latency_limit_s),
        limit_x=x.within(chart.cost_limit_usd_per_request),
        summary=_summary(chart), warning=textwrap.wrap(chart.warning or "", 118)[:2],
    )  # fmt: skip


def money(usd: float) -> str:
    """`$0.0015`, with three significant digits and no exponent."""
    digits = max(0, 2 - math.floor(math.log10(usd))) if usd > 0 else 0
    text = f"{usd:.{digits}f}"
    return "$" + (text.rstrip("0").rstrip(".") if "." in text else text)


def seconds(value: float) -> str:
    """`12 ms` or `1.5 s`."""
    return f"{value * 1000:.3g} ms" if value < 0.9995 else f"{value:.4g} s"


def _axes(chart: Chart) -> tuple[_Axis, _Axis]:
    costs = [p.cost_usd_per_request for p in chart.points]
    latencies = [v for p in chart.points for v in (p.latency_s, p.low_s, p.high_s) if v and v < 4 * p.latency_s]
    if chart.cost_limit_usd_per_request and chart.cost_limit_usd_per_request < 10 * max(costs):
        costs.append(chart.cost_limit_usd_per_request)
    if chart.latency_limit_s and chart.latency_limit_s < 10 * max(latencies):
        latencies.append(chart.latency_limit_s)
    return _axis(costs, LEFT, WIDTH - RIGHT), _axis(latencies, HEIGHT - BOTTOM, TOP)


def _axis(values: Sequence[float], start: float, end: float) -> _Axis:
    low, high = math.log10(min(values)), math.log10(max(values))
    pad = max(0.08 * (high - low), 0.04)
    return _Axis(low - pad, high + pad, start, end)


def _dot(point: Point, x: _Axis, y: _Axis) -> dict[str, object]:
    kind = (
        "chosen" if point.role == "chosen" else "measured" if point.measured else "front" if point.on_front else "other"
    )
    bar = None
    if (point.measured or point.role) and point.low_s and point.high_s:
        bar = (y.clipped(point.low_s), y.clipped(point.high_s))
    return {"x": x.at(point.cost_usd_per_request), "y": y.at(point.latency_s), "kind": kind, "bar": bar,
            "title": f"{point.name}: {seconds(point.latency_s)}, {money(point.cost_usd_per_request)} per request"
                     + (", measured" if point.measured else "")}  # fmt: skip


def _staircase(front: Sequence[Point], x: _Axis, y: _Axis) -> str:
    ordered = sorted(front, key=lambda p: (p.cost_usd_per_request, p.latency_s))
    path: list[str] = []
    for point in ordered:
        px, py = x.at(point.cost_usd_per_request), y.at(point.latency_s)
        path.append(f"M{px} {TOP} V{py}" if not path else f"H{px} V{py}")
    return " ".join([*path, f"H{WIDTH - RIGHT}"]) if path else ""


def _labels(named: Sequence[Point], x: _Axis, y: _Axis) -> list[dict[str, object]]:
    """Texts beside the named machines, moved up or down until no two overlap."""
    taken: list[tuple[float, float, float, float]] = []
    labels: list[dict[str, object]] = []
    for point in sorted(named, key=lambda p: p.role != "chosen"):
        words = f"{point.role}: {point.name}"
        width = 7.3 * len(words)
        px, py = x.at(point.cost_usd_per_request), y.at(point.latency_s)
        right = px + 12 + width < WIDTH - RIGHT
        left_edge = px + 12 if right else px - 12 - width
        spot = next(ty for shift in range(40) for ty in (py - shift * 6 - 8, py + shift * 6 + 14)
                    if ty - LABEL_HEIGHT / 2 > TOP + 4 and ty < HEIGHT - BOTTOM - 4
                    and not _overlaps((left_edge, ty - 13, left_edge + width, ty + 4), taken))  # fmt: skip
        taken.append((left_edge, spot - 13, left_edge + width, spot + 4))
        labels.append({"x": round(px + 12 if right else px - 12, 1), "y": round(spot, 1),
                       "anchor": "start" if right else "end", "words": words, "role": point.role})  # fmt: skip
    return labels


def _overlaps(box: tuple[float, float, float, float], taken: Sequence[tuple[float, float, float, float]]) -> bool:
    return any(box[0] < o[2] and o[0] < box[2] and box[1] < o[3] and o[1] < box[3] for o in taken)


def _summary(chart: Chart) -> str:
    chosen = next((p for p in chart.points if p.role == "chosen"), None)
    if chosen is None:
        return f"{_machines(chart)}, none meets the limits"
    return (f"{_machines(chart)}; chosen: {chosen.name}, {seconds(chosen.latency_s)}, "
            f"{money(chosen.cost_usd_per_request)} per request")  # fmt: skip


def _machines(chart: Chart) -> str:
    return "1 machine" if len(chart.points) == 1 else f"{len(chart.points)} machines"
