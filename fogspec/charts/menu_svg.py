"""Draw the menu as SVG: latency against cost per request, the limits, and the machines that meet them."""

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from fogspec.base.templates import render
from fogspec.base.text import line
from fogspec.base.units import money, shown_cost
from fogspec.charts.axes import Axis
from fogspec.charts.chart import Bound, Chart, PlottedMachine, View, per_request, ranged, y_range, y_words
from fogspec.charts.frame import (
    Frame,
    LimitLine,
    Mark,
    Obstacles,
    Segment,
    below,
    clipped,
    corners,
    edge,
    frame,
    path,
    place_labels,
    place_limits,
    segments,
)
from fogspec.charts.text import HEAD, LABEL, shortened, width, wrapped
from fogspec.numerics.kernels import distinct

WIDTH, LEFT, RIGHT, MARGIN = 720, 66, 16, 16
NARROW = 380  # px, of a panel for a phone
HIGH = 302  # px, of the panel
ROW = 18
FINE, GRAINS, MANY = 2, (2, 4, 8), 800
ISO_POINTS = 48
LABELLED = 190.0  # px that a name takes at its mark


def draw(chart: Chart) -> str:
    """Return the chart as SVG text. Raise ValueError if there is no machine to draw."""
    if not chart.machines and not len(chart.crowd.y):
        raise ValueError("a menu without machines cannot be drawn")
    room = WIDTH - 2 * MARGIN
    title = wrapped(chart.title, room, HEAD, bold=True, most=3)
    facts = wrapped(chart.facts, room, most=3)
    roles = 8 + max((width(role, bold=True) for role, _ in chart.rows), default=0.0)
    rows = [
        (role if i == 0 else "", words)
        for role, text in chart.rows
        for i, words in enumerate(wrapped(text, room - roles, most=2))
    ]
    at = 28 + 22 * (len(title) - 1)
    lead_at = at + 23 if chart.lead else at
    facts_at = lead_at + 20
    rows_at = facts_at + ROW * (len(facts) - 1) + 23
    top = rows_at + ROW * len(rows) + 30
    notes = [text for note in chart.notes for text in wrapped(f"⚠ {note}", room, most=3)]
    view = per_request(chart)
    found = _frame(chart, view, *view.near(chart), top)
    legend, legend_y = _legend(chart, found), top + HIGH + 58
    source_at = legend_y + 22 * (1 + max((row for *_, row in legend), default=0))
    return render(
        "picture.svg.j2",
        title=title,
        lead=chart.lead,
        lead_at=lead_at,
        facts=[(facts_at + ROW * i, text) for i, text in enumerate(facts)],
        summary=_summary(chart),
        width=WIDTH,
        height=source_at + 16 + ROW * len(notes),
        left=MARGIN,
        rows=[(rows_at + ROW * i, role, words) for i, (role, words) in enumerate(rows)],
        words_left=round(MARGIN + roles, 1),
        frames=[found],
        broken=chart.broken,
        legend=legend,
        legend_y=legend_y,
        source=chart.source,
        source_y=source_at,
        notes=notes,
    )


def panel(chart: Chart, view: View, *, near: bool, id: str, broad: int = WIDTH) -> str:
    """Return one coordinate system of the chart as SVG to put into a page, whose marks, limits and iso line have names.

    `id` names the view; with `broad` below `WIDTH` px it is the picture for a phone.
    """
    ranges = view.near(chart) if near else (view.everything(chart)[0], y_range(chart))
    top = 34
    found = _frame(chart, view, *ranges, top, labelled=False, broad=broad)
    if broad < WIDTH and found.remark:
        lines, found.remark = wrapped(found.remark, broad - LEFT - RIGHT, most=3), ""
        top += ROW * len(lines)
        found = _frame(chart, view, *ranges, top, labelled=False, broad=broad)
        found.remark, found.above = "", [(14 + ROW * i, words) for i, words in enumerate(lines)]
    # The page has cards, from the numbers that it has anyway.
    return to_page(found, id, _summary(chart), broad, top=top, bounds=view.bounds, titles=False)


def to_page(
    found: Frame, id: str, summary: str, broad: int, *, top: int, bounds: Sequence[Bound] = (), titles: bool = True
) -> str:
    """Return a frame as SVG to put into a page; `titles` are shown where the pointer is."""
    return render(
        "panel.svg.j2",
        frame=found,
        id=id if broad == WIDTH else f"{id}-narrow",
        view=id,
        kind="wide" if broad == WIDTH else "narrow",
        width=broad,
        height=top + HIGH + 46,
        summary=summary,
        bounds=[(one.name, one.a, one.b, one.most) for one in bounds],
        titles=titles,
    )


def _frame(
    chart: Chart,
    view: View,
    x_range: tuple[float, float],
    y_range: tuple[float, float],
    top: float,
    *,
    labelled: bool = True,
    broad: int = WIDTH,
) -> Frame:
    words = y_words(chart)
    x, y = ranged(x_range, LEFT, broad - RIGHT), ranged(y_range, top + HIGH, top)
    found = frame(
        x=x,
        y=y,
        x_label=f"{view.x_label} (log scale) →",
        y_label=f"↑ {shortened(chart.y_label, 230)} (log scale)",
        x_words=view.x_words,
        y_words=words,
    )
    found.remark = _off_scale(chart, view, found)
    if view.bounds:
        inside = corners(found)
        for one in view.bounds:
            inside = below(inside, one.a, one.b, one.most)
        if len(inside) > 2:
            found.areas.append(("feasible", path((x.place(p), y.place(q)) for p, q in inside) + "Z"))
    for one in view.bounds:
        segment = edge(found, one.a, one.b, one.most)
        if segment is not None:
            found.limits.append(LimitLine(name=one.name, segment=segment, words=one.words))
    inside_iso = _iso_line(chart, view, found)
    if inside_iso:
        found.lines.append(("iso", path(inside_iso)))
    found.marks = _marks(chart, view, found)
    found.specks = _specks(chart, view, found, MANY * broad**3 // WIDTH**3)
    if labelled:
        obstacles = Obstacles.of(found, segments(inside_iso))
        place_limits(found, obstacles)
        place_labels(found, _wanted(chart, view, found), obstacles)
    return found


def _iso_line(chart: Chart, view: View, found: Frame) -> list[tuple[float, float]]:
    """Return the points in the frame at which a machine would be as good as the choice."""
    if chart.iso is None or view.x != "cost_usd_per_request":
        return []
    of_y, of_cost = chart.iso
    points = []
    for i in range(ISO_POINTS + 1):
        cost = 10 ** (found.x.low + (found.x.high - found.x.low) * i / ISO_POINTS)
        rest = 1 - cost / of_cost
        if rest > 0 and math.isfinite(of_y):
            points.append((found.x.at(cost), found.y.at(max(of_y * rest, 1e-300))))
    if not math.isfinite(of_y):
        points = [(found.x.at(of_cost), found.y.start), (found.x.at(of_cost), found.y.end)]
    inside = [one for pair in segments(points) if (one := clipped(pair, found.box))]
    return [*[(a, b) for a, b, _, _ in inside], *[(c, d) for _, _, c, d in inside[-1:]]]


def _marks(chart: Chart, view: View, found: Frame) -> list[Mark]:
    """Return the marks inside the frame, the less important ones first."""
    ordered = sorted(chart.machines, key=lambda m: (m.role == "chosen", bool(m.role), m.meets, m.measured, m.y, m.name))
    return [
        mark for machine in ordered if _inside(machine, view, found) for mark in [_mark(chart, machine, view, found)]
    ]


def _inside(machine: PlottedMachine, view: View, found: Frame) -> bool:
    x, y = math.log10(getattr(machine, view.x)), math.log10(machine.y)
    return found.x.low <= x <= found.x.high and found.y.low <= y <= found.y.high


def _mark(chart: Chart, machine: PlottedMachine, view: View, found: Frame) -> Mark:
    words = y_words(chart)
    where = "" if machine.nested_in is None else f" on {line(machine.nested_in)}"
    title = (
        f"{machine.name}: {words(machine.y)} ({'measured' if machine.measured or where else 'predicted'}{where}), "
        f"{shown_cost(machine.cost_usd_per_request)}, {money(machine.price_usd_per_hour)}/h"
        + ("" if machine.meets else "; misses a limit")
    )
    chosen = machine.role == "chosen"
    kinds = [
        "measured" if machine.measured else "predicted",
        "meets" if machine.meets else "misses",
        *(["broken" if chart.broken else "chosen"] if chosen else []),
    ]
    return Mark(
        x=found.x.at(getattr(machine, view.x)),
        y=found.y.at(machine.y),
        kind=" ".join(kinds),
        radius=7.0 if chosen else 4.8,
        title=title,
        diamond=machine.gpu,
        bar=_bar(machine, view, found),
        row=machine.row,
    )


def _bar(machine: PlottedMachine, view: View, found: Frame) -> Segment | None:
    """Return the interval in the frame: along cost ∝ latency where a request pays for its time, upright elsewhere."""
    if not machine.low or not machine.high:
        return None
    ends = machine.low_cost, machine.high_cost
    if view.x != "cost_usd_per_request" or not ends[0] or not ends[1] or not math.isfinite(ends[1]):
        ends = getattr(machine, view.x), getattr(machine, view.x)
    (one, other) = ends
    return clipped(
        (_at(found.x, one), _at(found.y, machine.low), _at(found.x, other), _at(found.y, machine.high)), found.box
    )


def _at(one: Axis, value: float | None) -> float:
    return one.at(min(max(value or 0.0, 1e-300), 1e300))


def _specks(chart: Chart, view: View, found: Frame, many: int) -> list[tuple[str, str]]:
    """Return the machines that have no mark as small points, about `many`; machines that would coincide are drawn once."""
    cells: dict[int, list[int]] = {}
    taken = {(round(mark.x / FINE), round(mark.y / FINE)) for mark in found.marks}
    grain, crowd = FINE, chart.crowd
    for grain in GRAINS:
        px, py = (
            np.rint((one.start + (np.log10(v) - one.low) / (one.high - one.low) * (one.end - one.start)) / grain)
            for v, one in ((view.column(chart), found.x), (crowd.y, found.y))
        )
        left, top, right, bottom = found.box
        seen = (px * grain >= left) & (px * grain <= right) & (py * grain >= top) & (py * grain <= bottom)
        key = distinct((crowd.meets[seen] * 4096 + px[seen].astype(np.int64)) * 4096 + py[seen].astype(np.int64))
        cells = {meets: key[key // 4096**2 == meets].tolist() for meets in (0, 1)}
        if len(key) <= many:
            break
    drawn = []
    for meets, kind in ((0, "misses"), (1, "meets")):
        places = [(cell // 4096 % 4096, cell % 4096) for cell in cells[meets]]
        if grain == FINE:
            places = [place for place in places if not _covered(place, taken)]
        if places:
            drawn.append((kind, "".join(f"M{px * grain} {py * grain}h0" for px, py in places)))
    return drawn


def _covered(place: tuple[int, int], taken: set[tuple[int, int]]) -> bool:
    return any((place[0] + dx, place[1] + dy) in taken for dx in (-1, 0, 1) for dy in (-1, 0, 1))


def _wanted(chart: Chart, view: View, found: Frame) -> list[tuple[Mark, str, str]]:
    """Return the labels of the highlighted machines in the frame, the choice first."""
    wanted = []
    by_row = {mark.row: mark for mark in found.marks}
    for machine in sorted((m for m in chart.machines if m.role), key=lambda m: (m.role != "chosen", m.role, m.name)):
        mark = by_row.get(machine.row) if machine.row is not None else _same(machine, view, found)
        if mark is not None:
            kinds = mark.kind.split()
            kind = next((one for one in ("broken", "chosen", "misses") if one in kinds), "named")
            wanted.append((mark, shortened(machine.name, LABELLED, LABEL, bold=True), kind))
    return wanted


def _same(machine: PlottedMachine, view: View, found: Frame) -> Mark | None:
    at = found.x.at(getattr(machine, view.x)), found.y.at(machine.y)
    return next((mark for mark in found.marks if (mark.x, mark.y) == at), None)


def _off_scale(chart: Chart, view: View, found: Frame) -> str:
    """Return what the axes leave out, counted."""
    x, y = np.log10(view.column(chart)), np.log10(chart.crowd.y)
    above, right = y > found.y.high, (x > found.x.high) & (y <= found.y.high)
    rest = ((x < found.x.low) | (y < found.y.low)) & ~above & ~right
    words, metric = y_words(chart), chart.y_is == "number"
    parts = []
    if above.any():
        what = "above" if metric else "slower"
        parts.append(f"{int(above.sum()):,} {what} (up to {words(float(chart.crowd.y.max()))})")
    if right.any():
        parts.append(f"{int(right.sum()):,} more expensive")
    if rest.any():
        parts.append(f"{int(rest.sum()):,} below")
    parts += [one.words for one in view.bounds if edge(found, one.a, one.b, one.most) is None]
    return f"off scale: {', '.join(parts)}" if parts else ""


def _legend(chart: Chart, found: Frame) -> list[tuple[str, str, float, int]]:
    """Return the keys that the picture uses: kind, words, position and row."""
    marks = found.marks
    kinds = Counter(kind for mark in marks for kind in mark.kind.split())
    items = [("measured meets", "measured")] if kinds["measured"] else []
    items += [("predicted meets", "predicted")] if kinds["predicted"] else []
    items += [("diamond", "with GPU")] if any(mark.diamond for mark in marks) else []
    if kinds["misses"] or any(kind == "misses" for kind, _ in found.specks):
        items.append(("measured misses", "misses a limit"))
    items += [("bar", f"{chart.level:.0%} interval")] if any(mark.bar for mark in marks) else []
    items += [("iso", "as good as the choice")] if found.lines else []
    return laid_out(items, WIDTH - 2 * MARGIN)


def laid_out(items: Sequence[tuple[str, str]], room: float) -> list[tuple[str, str, float, int]]:
    """Return the keys of a legend with their positions in px, in as many rows as they need."""
    at, row, placed = 0.0, 0, []
    for kind, words in items:
        sign = 30.0 if kind in ("iso", "curve", "paper") else 16.0
        long = sign + width(words)
        if at and at + long > room:
            at, row = 0.0, row + 1
        placed.append((kind, words, round(at, 1), row))
        at += long + 14
    return placed


def _summary(chart: Chart) -> str:
    """Return the text alternative of the chart."""
    count = len(chart.crowd.y)
    lead = "".join(words for words, _ in chart.lead)
    rows = [f"{role}: {words}" for role, words in chart.rows]
    total = f"{count:,} machine{'' if count == 1 else 's'} drawn"
    return ". ".join(part for part in (chart.title, lead, chart.facts, *rows, total, *chart.notes) if part)
