"""The menu as SVG: latency against the cost of a request and the price of an hour, the Pareto staircases, the limits,
the choice and what else stands out."""

import textwrap
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from fogspec.base.templates import render
from fogspec.base.units import short_dollars
from fogspec.charts.axes import CHARACTER
from fogspec.charts.chart import Chart, Crowd, Floats, PlottedMachine, View, per_hour, per_request, y_axis, y_words
from fogspec.charts.frame import Dot, Frame, frame, place_labels

WIDTH, LEFT, RIGHT = 760, 84, 18
TOP, FRAME_HEIGHT, GAP = 62, 238, 72
ROW = 20
FINE, COARSE, MANY = 2, 4, 3000


def draw(chart: Chart) -> str:
    """The chart as SVG text; raises ValueError when there is no machine to draw."""
    if not chart.machines and not len(chart.crowd.y):
        raise ValueError("a menu without machines cannot be drawn")
    named = [machine for machine in chart.machines if machine.role]
    subtitle = textwrap.wrap(chart.subtitle, 108)[:3]
    rows_at = TOP + 17 * (len(subtitle) - 1)
    top = rows_at + ROW * len(named) + 34
    second = top + FRAME_HEIGHT + GAP
    bottom = second + FRAME_HEIGHT
    notes = [line for note in chart.notes for line in textwrap.wrap(note, 112)][:3]
    return render(
        "picture.svg.j2", title=chart.title, subtitle=subtitle, summary=_summary(chart), width=WIDTH,
        height=bottom + 88 + 15 * len(notes), left=18,
        rows=[(rows_at + 14 + ROW * i, m.role, m.words) for i, m in enumerate(named)],
        words_left=18 + max([86.0, *(CHARACTER * len(m.role) + 14 for m in named)]),
        frames=[_frame(chart, per_request(chart), top), _frame(chart, per_hour(chart), second)],
        legend=_legend(chart), legend_y=bottom + 66, notes=notes,
    )  # fmt: skip


def _frame(chart: Chart, view: View, top: float) -> Frame:
    words = y_words(chart)
    found = frame(
        view.x_axis(chart, LEFT, WIDTH - RIGHT), y_axis(chart, top + FRAME_HEIGHT, top), f"{view.x_label} (log scale)",
        f"{chart.y_label} (log scale)", view.x_words, words, view.heading,
    )  # fmt: skip
    for a, b, limit in view.forbidden:
        found.forbid(a, b, limit)
    found.specks = _specks(found, view.column(chart), chart.crowd)
    ordered = sorted(chart.machines, key=lambda m: (_rank(m, view), getattr(m, view.x), m.y, m.name))
    dots = [(machine, _dot(found, machine, view, words)) for machine in ordered]
    found.dots = [dot for _, dot in dots]
    front = view.steps(chart)
    if front:
        found.lines.insert(0, ("stairs", _staircase(found, front)))
    named = sorted(
        (one for one in dots if one[0].role), key=lambda one: (one[0].role != "chosen", one[0].role, one[0].name)
    )
    labels = [(dot, f"{m.role}: {m.name}", "chosen" if m.role == "chosen" else "named") for m, dot in named]
    place_labels(found, labels, _levels(found, front))
    return found


def _levels(found: Frame, front: Sequence[tuple[float, float]]) -> list[tuple[float, float, float, float]]:
    """The staircase's level parts, which a text should not lie on."""
    corners = [(found.x.at(x), found.y.at(y)) for x, y in front]
    return [(x, y - 1, end, y + 1) for (x, y), (end, _) in pairwise([*corners, (found.x.end, 0.0)])]


def _rank(machine: PlottedMachine, view: View) -> int:
    """The later, the nearer to the eye."""
    return 3 if machine.role == "chosen" else 2 if machine.role else 1 if getattr(machine, view.front) else 0


def _dot(found: Frame, machine: PlottedMachine, view: View, words: Callable[[float], str]) -> Dot:
    front = getattr(machine, view.front)
    kind = (
        "chosen" if machine.role == "chosen" else "measured" if machine.measured else "front" if front else "predicted"
    )
    bar = (found.y.clipped(machine.low), found.y.clipped(machine.high)) if machine.low and machine.high else None
    title = (f"{machine.name}: {words(machine.y)}, {short_dollars(machine.cost_usd_per_request)} per request, "
             f"{short_dollars(machine.price_usd_per_hour)} per hour" + (", measured" if machine.measured else ""))  # fmt: skip
    at = found.x.at(getattr(machine, view.x)), found.y.at(machine.y)
    return Dot(*at, kind, 6.5 if kind == "chosen" else 4.2, title, bar)


def _specks(found: Frame, column: Floats, crowd: Crowd) -> list[tuple[str, str]]:
    """Every machine as a faint point; those that would fall on one another are drawn once."""
    cells: dict[int, list[int]] = {}
    grain = FINE
    for grain in (FINE, COARSE):
        px, py = (
            np.rint((axis.start + (np.log10(v) - axis.low) / (axis.high - axis.low) * (axis.end - axis.start)) / grain)
            for v, axis in ((column, found.x), (crowd.y, found.y))
        )
        key = np.unique((crowd.meets * 4096 + px.astype(np.int64)) * 4096 + py.astype(np.int64))
        cells = {meets: key[key // 4096**2 == meets].tolist() for meets in (0, 1)}
        if len(key) <= MANY:
            break
    return [
        (kind, "".join(f"M{one // 4096 % 4096 * grain} {one % 4096 * grain}h0" for one in cells[meets]))
        for meets, kind in ((0, "out"), (1, "in"))
        if cells[meets]
    ]


def _staircase(found: Frame, front: Sequence[tuple[float, float]]) -> str:
    path: list[str] = []
    for x, y in front:
        px, py = found.x.at(x), found.y.at(y)
        path.append(f"H{px:g}V{py:g}" if path else f"M{px:g} {found.y.end:g}V{py:g}")
    return "".join([*path, f"H{found.x.end:g}"])


def _legend(chart: Chart) -> list[tuple[str, str]]:
    found = [("measured", "measured")] if any(m.measured for m in chart.machines) else []
    if any(m.on_front or m.on_hourly_front for m in chart.machines):
        found.append(("front", "Pareto front"))
    if any(m.low for m in chart.machines):
        found.append(("bar", f"{chart.level:.0%} interval"))
    limited = any(bool(view.forbidden) for view in (per_request(chart), per_hour(chart)))
    if bool(chart.crowd.meets.any()):
        found.append(("in", "meets the limits" if limited else "any other machine"))
    if not bool(chart.crowd.meets.all()):
        found += [("out", "does not"), ("no", "over a limit")]
    return found


def _summary(chart: Chart) -> str:
    count = len(chart.crowd.y)
    machines = "1 machine" if count == 1 else f"{count:,} machines"
    chosen = next((m for m in chart.machines if m.role == "chosen"), None)
    if chosen is None:
        return f"{machines}, none is chosen"
    return (f"{machines}; chosen: {chosen.name}, {y_words(chart)(chosen.y)}, {short_dollars(chosen.cost_usd_per_request)} "
            f"per request, {short_dollars(chosen.price_usd_per_hour)} per hour")  # fmt: skip
