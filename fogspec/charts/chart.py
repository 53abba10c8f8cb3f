"""Describe the menu charts independently of the renderer: machines, limits, and the two views of them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fogspec.base.units import short_dollars
from fogspec.charts.axes import Axis, axis, number, requests_unit, seconds
from fogspec.choice.menu import LEVEL
from fogspec.model.predict import Predictions

Floats = NDArray[np.float64]


def interval_of(predictions: Predictions, row: int) -> tuple[float, float] | None:
    """Return the interval to draw; None if the model predicts none."""
    found = predictions.interval(row, LEVEL)
    return None if found is None or not (found[0] > 0 and math.isfinite(found[1])) else found


@dataclass(frozen=True, slots=True, kw_only=True)
class PlottedMachine:
    """A machine that is drawn individually; `y` is the latency in seconds, or the metric that replaces it.

    `role` labels a highlighted machine, and `words` describes it in the list of highlighted machines. One that was measured on
    a part of a larger machine is `nested_in` that.
    """

    name: str
    y: float
    cost_usd_per_request: float
    price_usd_per_hour: float
    low: float | None = None
    high: float | None = None
    measured: bool = False
    nested_in: str | None = None
    on_front: bool = False
    on_hourly_front: bool = False
    role: str = ""
    words: str = ""


@dataclass(frozen=True, slots=True)
class Crowd:
    """All admissible machines, as columns (n,); `meets` is True for a machine that meets all limits."""

    y: Floats
    cost_usd_per_request: Floats
    price_usd_per_hour: Floats
    meets: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Chart:
    """A menu chart; limits are drawn as forbidden regions.

    `requests_per_hour` is set for provisioned billing, under which the cost does not depend on the latency: those that share
    the price of a paid hour.
    """

    title: str
    subtitle: str
    y_label: str
    machines: Sequence[PlottedMachine]
    crowd: Crowd
    y_is: Literal["duration", "number"] = "duration"
    y_limit: float | None = None
    cost_limit_usd_per_request: float | None = None
    price_limit_usd_per_hour: float | None = None
    requests_per_hour: float | None = None
    level: float = 0.9
    notes: Sequence[str] = field(default_factory=tuple)


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """One of the two views: machines by cost per request, or by price per hour.

    `x` and `front` are names of fields of `PlottedMachine`. Each (a, b, c) in `forbidden` forbids the region
    a·log10 x + b·log10 y > c.
    """

    heading: str
    x: Literal["cost_usd_per_request", "price_usd_per_hour"]
    front: Literal["on_front", "on_hourly_front"]
    x_label: str
    x_words: Callable[[float], str]
    forbidden: Sequence[tuple[float, float, float]]
    limit: float | None

    def column(self, chart: Chart) -> Floats:
        """Return the x values of all machines."""
        return chart.crowd.cost_usd_per_request if self.x == "cost_usd_per_request" else chart.crowd.price_usd_per_hour

    def steps(self, chart: Chart) -> list[tuple[float, float]]:
        """Return the corners (x, y) of the Pareto staircase, in order of x."""
        return sorted({(getattr(m, self.x), m.y) for m in chart.machines if getattr(m, self.front)})

    def x_axis(self, chart: Chart, start: float, end: float) -> Axis:
        """Return the horizontal axis, which includes a limit near the machines."""
        return axis(_shown(self.column(chart), [getattr(m, self.x) for m in chart.machines], self.limit), start, end)


def per_request(chart: Chart) -> View:
    """Return the view by cost per request, for a number of requests that keeps the figures short."""
    costs = [*chart.crowd.cost_usd_per_request.tolist(), *positive(chart.cost_limit_usd_per_request)]
    factor, unit = requests_unit(costs or [m.cost_usd_per_request for m in chart.machines])
    forbidden = _y_limits(chart) + [(1.0, 0.0, math.log10(cost)) for cost in positive(chart.cost_limit_usd_per_request)]
    for price in positive(chart.price_limit_usd_per_hour):
        if per_hour := chart.requests_per_hour:
            forbidden.append((1.0, 0.0, math.log10(price / per_hour)))
        elif chart.y_is == "duration":
            forbidden.append((1.0, -1.0, math.log10(price / 3600)))
    return View(
        heading="per request",
        x="cost_usd_per_request",
        front="on_front",
        x_label=f"cost of {unit}",
        x_words=lambda usd: short_dollars(usd * factor),
        forbidden=forbidden,
        limit=chart.cost_limit_usd_per_request,
    )


def per_hour(chart: Chart) -> View:
    """Return the view by price per hour, as in the paper; the cost limit is a slope in this view."""
    forbidden = _y_limits(chart) + [(1.0, 0.0, math.log10(price)) for price in positive(chart.price_limit_usd_per_hour)]
    for cost in positive(chart.cost_limit_usd_per_request):
        if requests := chart.requests_per_hour:
            forbidden.append((1.0, 0.0, math.log10(cost * requests)))
        elif chart.y_is == "duration":
            forbidden.append((1.0, 1.0, math.log10(cost * 3600)))
    return View(
        heading="per hour",
        x="price_usd_per_hour",
        front="on_hourly_front",
        x_label="price of an hour",
        x_words=short_dollars,
        forbidden=forbidden,
        limit=chart.price_limit_usd_per_hour,
    )


def y_axis(chart: Chart, start: float, end: float) -> Axis:
    """Return the vertical axis: all machines, and interval ends within a factor of four of their machine."""
    ends = [v for m in chart.machines for v in (m.y, m.low, m.high) if v and m.y / 4 < v < 4 * m.y]
    return axis(_shown(chart.crowd.y, ends, chart.y_limit), start, end)


def y_words(chart: Chart) -> Callable[[float], str]:
    """Return the function that formats y values."""
    return seconds if chart.y_is == "duration" else number


def positive(limit: float | None) -> list[float]:
    """Return the limit in a list, or no item if it is missing or a logarithmic axis cannot show it."""
    return [] if limit is None or limit <= 0 else [limit]


def _y_limits(chart: Chart) -> list[tuple[float, float, float]]:
    return [(0.0, 1.0, math.log10(limit)) for limit in positive(chart.y_limit)]


def _shown(column: Floats, others: Sequence[float], limit: float | None) -> list[float]:
    """Return the values that an axis must show; a limit far from every machine is excluded."""
    values = [*others, *([float(column.min()), float(column.max())] if len(column) else [])]
    low, high = min(values), max(values)
    return [low, high, *(bound for bound in positive(limit) if low / 10 < bound < high * 10)]
