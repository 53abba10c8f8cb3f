"""Place values on logarithmic axes, and format ticks and values."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from fogspec.base.units import shown
from fogspec.charts.text import width

STEPS = ((1, 1.5, 2, 3, 4, 5, 7), (1, 2, 5), (1, 3), (1,))
LEAST_SPAN = 0.32  # decades: about a factor of two, so that one machine alone still has ticks around it


@dataclass(frozen=True, slots=True)
class Axis:
    """A logarithmic axis from `start` to `end` px; `low` and `high` are logarithms to the base 10."""

    low: float
    high: float
    start: float
    end: float

    def at(self, value: float) -> float:
        """Return the position of a positive value, in px."""
        return self.place(math.log10(value))

    def place(self, log: float) -> float:
        """Return the position of a logarithm to the base 10, in px."""
        fraction = (log - self.low) / (self.high - self.low)
        return round(self.start + fraction * (self.end - self.start), 1)

    def clipped(self, value: float) -> float:
        """Return the position of a positive value in px, at the edge of the frame if it lies outside."""
        low, high = sorted((self.start, self.end))
        return min(max(self.at(value), low), high)

    def ticks(self, words: Callable[[float], str], room: Callable[[str], float]) -> list[tuple[float, str]]:
        """Return the positions and texts of round values, thinned until adjacent texts do not overlap."""
        found: list[tuple[float, str]] = []
        for stride in range(1, 20):
            for steps in STEPS if stride == 1 else STEPS[-1:]:
                decades = range(math.floor(self.low), math.ceil(self.high) + 1, stride)
                # Beyond these decades a float has no value that could be placed.
                whole = [10.0**d for d in decades if -300 <= d <= 300]
                values = [m * one for one in whole for m in steps if self.low <= math.log10(m * one) <= self.high]
                found = [(self.at(value), words(value)) for value in values]
                gaps = ((b[0] - a[0], room(a[1]), room(b[1])) for a, b in pairwise(found))
                if all(abs(gap) >= (left + right) / 2 for gap, left, right in gaps):
                    return found
        return found[:1]


def axis(values: Sequence[float], start: float, end: float) -> Axis:
    """Return an axis that shows these positive values with a margin; a single value is in the middle."""
    logs = [math.log10(value) for value in values]
    low, high = min(logs), max(logs)
    pad = max(0.07 * (high - low), (LEAST_SPAN - (high - low)) / 2, 0.03)
    return Axis(low - pad, high + pad, start, end)


def wide(text: str) -> float:
    """Return the room that a tick's text takes on a horizontal axis, in px."""
    return width(text) + 14


def tall(_text: str) -> float:
    """Return the height of a line of text on a vertical axis, in px."""
    return 20.0


def seconds(value: float) -> str:
    """Format a duration with three significant digits, such as `12 ms` or `1.65 s`."""
    if value < 0.0009995:
        return f"{shown(value * 1e6)} µs"
    return f"{shown(value * 1000)} ms" if value < 0.9995 else f"{shown(value)} s"


def number(value: float) -> str:
    """Format the value of an application's metric with three significant digits, such as `12.5`."""
    return shown(value)
