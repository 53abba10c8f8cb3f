"""Describe the menu charts independently of the renderer: machines, limits, and the views of them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fogspec.base.units import REQUESTS_SHOWN, REQUESTS_TEXT, money
from fogspec.charts.axes import LEAST_SPAN, Axis, axis, number, seconds
from fogspec.choice.menu import LEVEL
from fogspec.model.predict import Predictions

Floats = NDArray[np.float64]

BEYOND = 2.1  # the axis ends at so many times a limit
AROUND = 4.0  # or, without a limit, at so many times the choice
WITHIN = 1.15  # or sooner, at so many times the last machine
FAR = 1.6  # a limit beyond so many times the last machine is off scale
NEAR = 10.0  # and one below the first machine divided by this


def interval_of(predictions: Predictions, row: int) -> tuple[float, float] | None:
    """Return the interval to draw; None if the model predicts none."""
    found = predictions.interval(row, LEVEL)
    return None if found is None or not (found[0] > 0 and math.isfinite(found[1])) else found


@dataclass(frozen=True, slots=True, kw_only=True)
class PlottedMachine:
    """A machine that is drawn individually; `y` is the latency in seconds, or the metric that replaces it.

    `role` labels a highlighted machine. `low` and `high` are the ends of the interval, `low_cost` and `high_cost` the costs of
    a request there. One that was measured on a part of a larger machine is `nested_in` that.
    """

    name: str
    y: float
    cost_usd_per_request: float
    price_usd_per_hour: float
    low: float | None = None
    high: float | None = None
    low_cost: float | None = None
    high_cost: float | None = None
    measured: bool = False
    meets: bool = True
    gpu: bool = False
    nested_in: str | None = None
    on_front: bool = False
    on_hourly_front: bool = False
    role: str = ""
    row: int | None = None


@dataclass(frozen=True, slots=True)
class Crowd:
    """All admissible machines, as columns (n,); `meets` is True for a machine that meets all limits."""

    y: Floats
    cost_usd_per_request: Floats
    price_usd_per_hour: Floats
    meets: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Chart:
    """A menu chart.

    `lead` is a line of texts of which some are bold, `rows` are machines beside the choice with what they are called, `notes`
    the warnings. A request of the choice costs as much in total as one of `y` / `iso_y` + `cost` / `iso_cost` equal to 1.
    `requests_per_hour` is set for provisioned billing, under which the cost does not depend on the latency: those that share
    the price of a paid hour. `broken` is true of a choice that violates a limit.
    """

    title: str
    y_label: str
    machines: Sequence[PlottedMachine]
    crowd: Crowd
    lead: Sequence[tuple[str, bool]] = ()
    facts: str = ""
    rows: Sequence[tuple[str, str]] = ()
    notes: Sequence[str] = field(default_factory=tuple)
    source: str = ""
    y_is: Literal["duration", "number"] = "duration"
    y_limits: Sequence[tuple[str, float]] = ()
    cost_limit_usd_per_request: float | None = None
    price_limit_usd_per_hour: float | None = None
    requests_per_hour: float | None = None
    iso: tuple[float, float] | None = None
    broken: bool = False
    level: float = 0.9


@dataclass(frozen=True, slots=True, kw_only=True)
class Bound:
    """A limit in a view: a·log10 x + b·log10 y at most `most`, and its label."""

    name: str
    words: str
    a: float
    b: float
    most: float


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """Machines by cost per request, or by price per hour; `x` is a field of `PlottedMachine`, `front` another."""

    heading: str
    x: Literal["cost_usd_per_request", "price_usd_per_hour"]
    front: Literal["on_front", "on_hourly_front"]
    x_label: str
    x_words: Callable[[float], str]
    bounds: Sequence[Bound]

    def column(self, chart: Chart) -> Floats:
        """Return the x values of all machines."""
        return chart.crowd.cost_usd_per_request if self.x == "cost_usd_per_request" else chart.crowd.price_usd_per_hour

    def steps(self, chart: Chart) -> list[tuple[float, float]]:
        """Return the corners (x, y) of the Pareto staircase, in order of x."""
        return sorted({(getattr(m, self.x), m.y) for m in chart.machines if getattr(m, self.front)})

    def limit(self, of_x: bool) -> float | None:
        """Return the smallest bound of x alone, or of y alone."""
        found = [10**one.most for one in self.bounds if (one.b == 0 if of_x else one.a == 0)]
        return min(found, default=None)

    def everything(self, chart: Chart) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the ranges of x and y that show all machines, and limits near them."""
        xs = _shown(self.column(chart), [getattr(m, self.x) for m in chart.machines], self.limit(of_x=True))
        return (min(xs), max(xs)), y_range(chart)

    def near(self, chart: Chart) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the ranges of x and y around the limits and the choice."""
        x, y = self.column(chart), chart.crowd.y
        kept = [m for m in chart.machines if m.role in ("chosen", "nearest")]
        x_most = _most(x, [getattr(m, self.x) for m in kept], self.limit(of_x=True))
        y_most = _most(y, [end for m in kept for end in (m.y, m.high) if end and end < 2 * m.y], self.limit(of_x=False))
        seen = (x <= x_most) & (y <= y_most)
        xs = [*x[seen].tolist(), *(getattr(m, self.x) for m in kept)]
        ys = [*y[seen].tolist(), *(end for m in kept for end in (m.y, m.low) if end and end > m.y / 2)]
        return (_least(xs, x_most, self.limit(of_x=True)), x_most), (_least(ys, y_most, self.limit(of_x=False)), y_most)


def per_request(chart: Chart) -> View:
    """Return the view by cost per request, in the unit that people are shown."""
    bounds = _y_bounds(chart)
    for cost in positive(chart.cost_limit_usd_per_request):
        bounds.append(
            Bound(name="cost", words=f"cost limit {money(cost * REQUESTS_SHOWN)}", a=1.0, b=0.0, most=math.log10(cost))
        )
    for price in positive(chart.price_limit_usd_per_hour):
        words = f"price limit {money(price)}/h"
        if per_hour := chart.requests_per_hour:
            bounds.append(Bound(name="price", words=words, a=1.0, b=0.0, most=math.log10(price / per_hour)))
        elif chart.y_is == "duration":
            bounds.append(Bound(name="price", words=words, a=1.0, b=-1.0, most=math.log10(price / 3600)))
    return View(
        heading="per request",
        x="cost_usd_per_request",
        front="on_front",
        x_label=f"cost per {REQUESTS_TEXT}",
        x_words=lambda usd: money(usd * REQUESTS_SHOWN),
        bounds=bounds,
    )


def per_hour(chart: Chart) -> View:
    """Return the view by price per hour, as in the paper; the cost limit is a slope in this view."""
    bounds = _y_bounds(chart)
    for price in positive(chart.price_limit_usd_per_hour):
        bounds.append(Bound(name="price", words=f"price limit {money(price)}/h", a=1.0, b=0.0, most=math.log10(price)))
    for cost in positive(chart.cost_limit_usd_per_request):
        if requests := chart.requests_per_hour:
            bounds.append(Bound(name="cost", words="cost limit", a=1.0, b=0.0, most=math.log10(cost * requests)))
        elif chart.y_is == "duration":
            bounds.append(Bound(name="cost", words="cost limit", a=1.0, b=1.0, most=math.log10(cost * 3600)))
    return View(
        heading="per hour",
        x="price_usd_per_hour",
        front="on_hourly_front",
        x_label="price per hour",
        x_words=money,
        bounds=bounds,
    )


def ranged(low_high: tuple[float, float], start: float, end: float) -> Axis:
    """Return an axis over a range, with a margin at its lower end and a least span."""
    low, high = math.log10(low_high[0]), math.log10(low_high[1])
    missing = max(0.0, LEAST_SPAN - (high - low))
    pad = 0.08 * (high - low + missing)
    return Axis(low - pad - missing / 2, high + missing / 2, start, end)


def y_axis(chart: Chart, start: float, end: float) -> Axis:
    """Return the vertical axis that shows all machines."""
    return axis(y_range(chart), start, end)


def y_range(chart: Chart) -> tuple[float, float]:
    """Return the range of all machines, with interval ends within a factor of four of their machine, and a limit near them."""
    ends = [v for m in chart.machines for v in (m.y, m.low, m.high) if v and m.y / 4 < v < 4 * m.y]
    values = _shown(chart.crowd.y, ends, min((bound for _, bound in chart.y_limits), default=None))
    return min(values), max(values)


def y_words(chart: Chart) -> Callable[[float], str]:
    """Return the function that formats y values."""
    return seconds if chart.y_is == "duration" else number


def positive(limit: float | None) -> list[float]:
    """Return the limit in a list, or no item if it is missing or a logarithmic axis cannot show it."""
    return [] if limit is None or limit <= 0 else [limit]


def _y_bounds(chart: Chart) -> list[Bound]:
    words = y_words(chart)
    return [
        Bound(name=name, words=f"{name} limit {words(limit)}", a=0.0, b=1.0, most=math.log10(limit))
        for name, limit in chart.y_limits
        if limit > 0
    ]


def _most(column: Floats, kept: Sequence[float], limit: float | None) -> float:
    """Return the upper end of an axis: beyond the limit or around what is kept, and not far beyond the last machine."""
    last = max([*column.tolist(), *kept], default=1.0) * WITHIN
    if limit is None:
        found = min(AROUND * max(kept, default=last), last)
    elif limit < FAR * last:
        found = min(BEYOND * limit, max(last, WITHIN * limit))
    else:
        found = last
    return max([found, *(value * WITHIN for value in kept)])


def _least(seen: Sequence[float], most: float, limit: float | None) -> float:
    """Return the lower end of an axis: the first machine, or a limit below it that is not far."""
    first = min(seen, default=most / 10)
    return limit / WITHIN if limit is not None and first / NEAR < limit < first else first


def _shown(column: Floats, others: Sequence[float], limit: float | None) -> list[float]:
    """Return the values that an axis must show; a limit far from every machine is excluded."""
    values = [*others, *([float(column.min()), float(column.max())] if len(column) else [])]
    low, high = min(values), max(values)
    return [low, high, *(bound for bound in positive(limit) if low / 10 < bound < high * 10)]
