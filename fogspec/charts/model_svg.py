"""Draw the latency, or a metric of the application, by vCPUs: every machine with its interval, a line for each GPU type."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import NormalDist, geometric_mean

import numpy as np

from fogspec.base.templates import render
from fogspec.base.text import line
from fogspec.catalog.machine import Machine
from fogspec.charts.axes import Axis, axis, number, seconds, wide
from fogspec.charts.chart import interval_of
from fogspec.charts.frame import (
    Frame,
    LimitLine,
    Mark,
    Obstacles,
    Segment,
    clipped,
    frame,
    path,
    place_labels,
    place_limits,
    segments,
)
from fogspec.charts.menu_chart import source_of
from fogspec.charts.menu_svg import LABELLED, LEFT, MARGIN, RIGHT, ROW, WIDTH, laid_out, to_page
from fogspec.charts.text import HEAD, LABEL, shortened, wrapped
from fogspec.choice.choose import Choice
from fogspec.choice.menu import LEVEL
from fogspec.choice.rule import latency_limit_s
from fogspec.model.fit import Models, Observation
from fogspec.numerics import families
from fogspec.numerics.kernels import median
from fogspec.numerics.observations import DEFAULT_NOISE
from fogspec.spec.schema import Application

HIGH = 268  # px, of the panel
MARKS = 80  # machines that are drawn individually
APART = 11.0  # px, between machines with equally many vCPUs
SIDE = 100.0  # px, that these take at most to either side
HUES = 3  # accelerators with a colour of their own
CURVE_POINTS = 60
FLAT, LESS = 1.1, 1.05  # ratios of latencies: as good as equal, and worth saying

Point = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Sized:
    """A machine: its vCPUs and its value with the ends of its interval."""

    name: str
    vcpus: float
    value: float
    low: float | None = None
    high: float | None = None
    measured: bool = False
    nested_in: str | None = None
    chosen: bool = False
    row: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """The machines with one accelerator, or without one; `curve` is the paper's fit."""

    name: str
    has_gpu: bool
    machines: Sequence[Sized]
    curve: Sequence[Point] = ()

    @property
    def levels(self) -> list[Point]:
        """The geometric mean of the values for each number of vCPUs, in their order."""
        counts = sorted({one.vcpus for one in self.machines})
        return [(n, geometric_mean([one.value for one in self.machines if one.vcpus == n])) for n in counts]


@dataclass(frozen=True, slots=True, kw_only=True)
class SizeChart:
    """A chart by vCPUs; `what` is the drawn quantity in words, `limit` its upper bound."""

    what: str
    y_label: str
    series: Sequence[Series]
    words: Callable[[float], str]
    facts: str = ""
    limit: float | None = None
    notes: Sequence[str] = field(default_factory=tuple)
    source: str = ""
    level: float = 0.9
    on_one_host: bool = False


def size_chart(
    application: Application, choice: Choice, models: Models, doubts: Sequence[str], metric: str | None = None
) -> SizeChart:
    """Return the chart of the latency, or of a metric, by vCPUs, with a series for each sampled GPU type."""
    spec = application.spec
    gpus = sorted({_gpu_of(one.machine) for one in models.spec.observations}, key=lambda gpu: gpu or ("", 0.0))
    series = [one for gpu in gpus if (one := _series(choice, models, gpu, metric)).machines]
    machines = [machine for one in series for machine in one.machines]
    measured = sum(one.measured for one in machines)
    statistic = spec.constraints.statistic
    unit = line(spec.metrics[metric].unit or "") if metric else ""
    what = line(metric) if metric else f"{statistic} latency"
    return SizeChart(
        what=line(metric) if metric else "latency",
        y_label=f"{what} in {unit}" if unit else what,
        series=series,
        words=number if metric else seconds,
        facts=f"{_upper(what)} of one request by vCPUs: {measured} "
        f"{'shapes of this host' if models.spec.measured_on_local else 'machines'} measured, "
        f"{len(machines) - measured} {'machines ' if models.spec.measured_on_local else ''}predicted",
        limit=spec.constraints.metrics.get(metric) if metric else latency_limit_s(application),
        notes=doubts,
        source=source_of(choice, prices=False),
        level=LEVEL,
        on_one_host=models.spec.measured_on_local,
    )


def _series(choice: Choice, models: Models, gpu: tuple[str, float] | None, metric: str | None) -> Series:
    offers = choice.offers
    predictions = choice.metrics[metric] if metric else choice.latency
    name, count = gpu or ("", 0.0)
    rows = np.flatnonzero(
        (offers.gpu == name) & (offers.gpu_count == count) & choice.eligible & (predictions.value > 0)
    )
    # Neither depends on the region: one row of each instance type.
    _, first = (
        np.unique(predictions.type_index[rows], return_index=True) if predictions.posterior else (None, slice(None))
    )
    chosen = None if choice.chosen is None else str(offers.instance[choice.chosen])
    found, drawn = [], rows[first].tolist()
    few = len(drawn) <= MARKS
    of = {row for row in drawn if few or predictions.measured[row] or str(offers.instance[row]) == chosen}
    predictions.intervals(sorted(of), LEVEL)  # all at once: each is kept
    for row in drawn:
        own, is_chosen = str(offers.instance[row]), str(offers.instance[row]) == chosen
        measured = bool(predictions.measured[row])
        low, high = (interval_of(predictions, row) if row in of else None) or (None, None)
        found.append(
            Sized(
                name=line(own),
                vcpus=float(offers.vcpus[row]),
                value=float(predictions.value[row]),
                low=low,
                high=high,
                measured=measured,
                nested_in=predictions.where_nested(row),
                chosen=is_chosen,
                row=row,
            )
        )
    known = {one.name for one in found if one.measured or one.nested_in}
    found += [
        _sample(one, metric)
        for one in models.spec.observations
        if _gpu_of(one.machine) == gpu
        and one.values.get(metric or "latency", 0.0) > 0  # the axis is logarithmic
        and line(one.machine.instance) not in known
    ]
    curve = [] if metric else _curve(models, gpu, offers.vcpus[rows], offers.memory_gib[rows])
    return Series(
        name="no GPU" if gpu is None else f"{count:g} {line(name)}",
        has_gpu=gpu is not None,
        machines=found,
        curve=curve,
    )


def _curve(models: Models, gpu: tuple[str, float] | None, vcpus: np.ndarray, memory: np.ndarray) -> list[Point]:
    """Return the curve of the family with the best leave-one-out error (paper, section 2.C).

    Memory is the median memory per vCPU.
    """
    key = None if gpu is None else f"{gpu[0]}:{gpu[1]:g}"
    model = next((one for one in models.spec.models if one.gpu == key and one.target == "latency"), None)
    if model is None or not len(vcpus):
        return []
    at = np.geomspace(vcpus.min(), vcpus.max(), CURVE_POINTS)
    latency = families.predict(model.shape, list(model.coefficients.values()), at, at * median(memory / vcpus))
    return list(zip(at.tolist(), latency.tolist(), strict=True))


def _sample(one: Observation, metric: str | None) -> Sized:
    """Return a measured machine that is not a candidate."""
    value, t = one.values[metric or "latency"], NormalDist().inv_cdf((1 + LEVEL) / 2)
    error = DEFAULT_NOISE if one.error is None else one.error
    ends = (None, None) if metric else (value * math.exp(-t * error), value * math.exp(t * error))
    return Sized(
        name=line(one.machine.instance),
        vcpus=one.machine.cpus,
        value=value,
        low=ends[0],
        high=ends[1],
        measured=one.nested_in is None,
        nested_in=one.nested_in,
    )


def _gpu_of(machine: Machine) -> tuple[str, float] | None:
    return None if machine.gpu is None else (machine.gpu.name, float(machine.gpu.count))


def title_of(chart: SizeChart) -> str:
    """Return the finding: what an accelerator or more vCPUs do."""
    if chart.on_one_host:
        return f"{_upper(chart.what)} by vCPUs, extrapolated from one host"
    plain = [one for one in chart.series if not one.has_gpu]
    gpus = [one for one in chart.series if one.has_gpu]
    if plain and gpus and (said := _accelerated(plain[0], gpus)):
        return said
    levels = (plain or gpus)[0].levels
    if len(levels) < 2:
        return f"{_upper(chart.what)} of machines with {levels[0][0]:g} vCPUs"
    best_at, best = min(levels, key=lambda level: level[1])
    if max(value for _, value in levels) < FLAT * best:
        return f"More vCPUs do not change the {chart.what}"
    if best_at == levels[0][0]:
        return f"More vCPUs make the {chart.what} larger"
    if levels[-1][1] > LESS * best:
        return (
            f"More than {best_at:g} vCPUs make this application slower"
            if chart.what == "latency"
            else f"{_upper(chart.what)} is smallest with {best_at:g} vCPUs"
        )
    until = levels[0][0]
    for (a, one), (b, other) in pairwise(levels):
        if one / other < FLAT ** math.log2(b / a):
            break
        until = b
    if until == levels[0][0]:
        return f"{_upper(chart.what)} hardly falls with more vCPUs"
    fall = (levels[0][1] / dict(levels)[until]) ** (1 / math.log2(until / levels[0][0]))
    end = "" if until == levels[-1][0] else f", up to {until:g}"
    return f"{_upper(chart.what)} falls {fall:.1f} × with each doubling of vCPUs{end}"


def _accelerated(plain: Series, gpus: Sequence[Series]) -> str | None:
    """Return which few vCPUs with an accelerator are as fast as the best machine without one; None if none are."""
    best = min(plain.machines, key=lambda one: one.value)
    for one in gpus:
        fast = [m for m in one.machines if m.value <= (best.high or best.value)]
        least = min(fast, key=lambda m: m.vcpus, default=None)
        if least is not None and least.vcpus < best.vcpus:
            kind = one.name.removeprefix("1 ")
            article = "an" if kind[:1] in "AEFHILMNORSX8" else "a"
            with_one = f"With {one.name}" if kind == one.name else f"With {article} {kind}"
            return f"{with_one}, {least.vcpus:g} vCPUs are as fast as any CPU-only machine"
    return None


def _upper(what: str) -> str:
    """Return what begins a sentence; the name of a metric stays as it is written."""
    return what[:1].upper() + what[1:] if what.endswith("latency") else what


def draw(chart: SizeChart) -> str:
    """Return the chart as SVG text. Raise ValueError if there is no machine to draw."""
    if not any(one.machines for one in chart.series):
        raise ValueError("no model, no chart of one")
    room = WIDTH - 2 * MARGIN
    title = wrapped(title_of(chart), room, HEAD, bold=True, most=3)
    facts = wrapped(chart.facts, room, most=3)
    facts_at = 28 + 22 * (len(title) - 1) + 22
    top = facts_at + ROW * (len(facts) - 1) + 44
    found = _frame(chart, top)
    legend, legend_y = laid_out(_legend(chart), room), top + HIGH + 58
    source_at = legend_y + 22
    notes = [text for note in chart.notes for text in wrapped(f"⚠ {note}", room, most=3)]
    return render(
        "picture.svg.j2",
        title=title,
        lead=[],
        facts=[(facts_at + ROW * i, text) for i, text in enumerate(facts)],
        summary=_summary(chart),
        width=WIDTH,
        height=source_at + 16 + ROW * len(notes),
        left=MARGIN,
        rows=[],
        words_left=MARGIN,
        frames=[found],
        broken=False,
        legend=legend,
        legend_y=legend_y,
        source=chart.source,
        source_y=source_at,
        notes=notes,
    )


def panel(chart: SizeChart, id: str, broad: int = WIDTH) -> str:
    """Return the chart as SVG to put into a page, with the paper's curves; with `broad` below `WIDTH` px for a phone."""
    found = _frame(chart, 34, broad)
    for one in chart.series:
        inside = [(found.x.at(v), found.y.at(value)) for v, value in one.curve if value > 0]
        inside = [(px, py) for px, py in inside if found.y.end <= py <= found.y.start]
        if len(inside) > 1:
            found.lines.append(("paper", path(inside)))
    return to_page(found, id, _summary(chart), broad, top=34)


def left_out_panel(points: Sequence[tuple[str, float, float, float, float]], id: str, broad: int = WIDTH) -> str:
    """Return predicted against measured seconds as SVG to put into a page.

    A point is a name, the measured value, the value that all other samples predict, and the ends of its interval.
    """
    values = [
        value for _, measured, *rest in points for value in (measured, *rest) if value > 0 and math.isfinite(value)
    ]
    x, y = axis([one[1] for one in points], LEFT, broad - RIGHT), axis(values, 34 + HIGH, 34)
    found = frame(
        x=x,
        y=y,
        x_label="measured (log scale) →",
        y_label="↑ predicted from all other samples (log scale)",
        x_words=seconds,
        y_words=seconds,
    )
    same = clipped((x.start, y.place(x.low), x.end, y.place(x.high)), found.box)
    found.lines += [("curve", path([same[:2], same[2:]]))] if same else []
    found.marks = [
        Mark(
            x=x.at(measured),
            y=y.clipped(value),
            kind="measured meets",
            radius=4.4,
            title=f"{line(name)}: measured {seconds(measured)}, predicted {seconds(value)}",
            bar=(x.at(measured), y.clipped(low), x.at(measured), y.clipped(high)),
        )
        for name, measured, value, low, high in points
    ]
    return to_page(found, id, f"{len(points)} samples, predicted from all others against measured", broad, top=34)


def _frame(chart: SizeChart, top: float, broad: int = WIDTH) -> Frame:
    counts = sorted({machine.vcpus for one in chart.series for machine in one.machines})
    x, y = _x_axis(chart, counts, broad), axis(_heights(chart), top + HIGH, top)
    found = frame(
        x=x,
        y=y,
        x_label="vCPUs (log scale) →",
        y_label=f"↑ {shortened(chart.y_label, 260)} (log scale)",
        x_words=lambda v: f"{v:g}",
        y_words=chart.words,
    )
    found.x_ticks = _ticks(x, counts)
    places = _beside(chart, x)
    shown: list[tuple[Series, str, Sized, float]] = []
    crowd = sum(len(one.machines) for one in chart.series) > MARKS
    reading: list[Segment] = []
    for at, one in enumerate(chart.series):
        hue = f" gpu-{(at - (not chart.series[0].has_gpu)) % HUES + 1}" if one.has_gpu else ""
        if len(levels := one.levels) > 1:
            points = [(x.at(v), y.clipped(value)) for v, value in levels]
            found.lines.append((f"curve{hue}", path(points)))
            reading += segments(points)
        specks = [m for m in one.machines if crowd and not (m.measured or m.chosen)]
        if specks:
            cells = sorted({(round(x.at(m.vcpus)), round(y.clipped(m.value))) for m in specks})
            found.specks.append((f"meets{hue}", "".join(f"M{px} {py}h0" for px, py in cells)))
        shown += [(one, hue, m, places[id(m)]) for m in one.machines if not crowd or m.measured or m.chosen]
    marks = {id(m): _mark(chart, m, hue, at, y) for _, hue, m, at in shown}
    order = sorted(shown, key=lambda item: (item[2].chosen, item[2].measured, item[2].vcpus, item[2].name))
    found.marks = [marks[id(m)] for _, _, m, _ in order]
    if chart.limit is not None and chart.limit > 0 and y.end < (at_limit := y.at(chart.limit)) < y.start:
        found.areas.append(("feasible", f"M{x.start:g} {at_limit:g}H{x.end:g}V{y.start:g}H{x.start:g}Z"))
        words = f"{shortened(chart.what, 150)} limit {chart.words(chart.limit)}"
        found.limits.append(LimitLine(name=chart.what, segment=(x.start, at_limit, x.end, at_limit), words=words))
    elif chart.limit is not None:
        found.remark = f"off scale: {shortened(chart.what, 150)} limit {chart.words(chart.limit)}"
    obstacles = Obstacles.of(found, reading)
    place_limits(found, obstacles)
    wanted = [
        (marks[id(m)], shortened(m.name, LABELLED, LABEL, bold=True), "chosen") for _, _, m, _ in shown if m.chosen
    ][:1]
    if len(chart.series) > 1 or chart.series[0].has_gpu:
        for one in chart.series:
            own = [(m, hue) for series, hue, m, _ in shown if series is one]
            if own:
                last, hue = max(own, key=lambda item: (item[0].vcpus, not item[0].chosen, item[0].value))
                wanted.append((marks[id(last)], shortened(one.name, 140, LABEL, bold=True), hue.strip() or "plain"))
    place_labels(found, wanted, obstacles)
    return found


def _x_axis(chart: SizeChart, counts: Sequence[float], broad: int) -> Axis:
    """Return the axis of vCPUs, with room at its ends for the machines that are side by side there."""
    found = axis(counts, LEFT, broad - RIGHT)
    most = max(sum(one.vcpus == count for one in series.machines) for series in chart.series for count in counts)
    side = min(APART * most / 2, SIDE) + 8
    least = min(found.at(counts[0]) - found.start, found.end - found.at(counts[-1]))
    if least >= side or len(counts) < 2:
        return found
    scale = math.log10(counts[-1] / counts[0]) / (found.end - found.start - 2 * side)
    pad = side * scale
    return Axis(math.log10(counts[0]) - pad, math.log10(counts[-1]) + pad, found.start, found.end)


def _ticks(x: Axis, counts: Sequence[float]) -> list[tuple[float, str]]:
    """Return the numbers of vCPUs that machines have, powers of two first, as far as they do not overlap."""
    found: list[tuple[float, str]] = []
    for count in sorted(counts, key=lambda n: (not math.log2(n).is_integer(), n)):
        at, words = x.at(count), f"{count:g}"
        if all(abs(at - other) >= (wide(words) + wide(text)) / 2 - 4 for other, text in found):
            found.append((at, words))
    return sorted(found)


def _beside(chart: SizeChart, x: Axis) -> dict[int, float]:
    """Return the position of each machine: those with equally many vCPUs of a series side by side."""
    counts = sorted({machine.vcpus for one in chart.series for machine in one.machines})
    gaps = [x.at(b) - x.at(a) for a, b in pairwise(counts)] or [120.0]
    found = {}
    for one in chart.series:
        for count in counts:
            here = sorted((m for m in one.machines if m.vcpus == count), key=lambda m: m.name)
            near = [gap for (a, b), gap in zip(pairwise(counts), gaps, strict=False) if count in (a, b)] or [120.0]
            step = min(APART, 0.8 * min(near) / max(len(here), 1), 2 * SIDE / max(len(here), 1))
            for i, machine in enumerate(here):
                found[id(machine)] = round(x.at(count) + (i - (len(here) - 1) / 2) * step, 1)
    return found


def _mark(chart: SizeChart, one: Sized, hue: str, at: float, y: Axis) -> Mark:
    bar = None
    if one.low and one.high:
        bar = (at, y.clipped(one.low), at, y.clipped(one.high))
    where = "" if one.nested_in is None else f" on {line(one.nested_in)}, not itself"
    how = "measured" if one.measured or where else "predicted"
    return Mark(
        x=at,
        y=y.clipped(one.value),
        kind=f"{'measured' if one.measured else 'predicted'} {'chosen' if one.chosen else hue.strip() or 'meets'}",
        radius=7.0 if one.chosen else 4.4,
        title=f"{one.name}: {one.vcpus:g} vCPUs, {chart.words(one.value)}, {how}{where}",
        diamond=bool(hue),
        bar=bar,
        row=one.row,
    )


def _heights(chart: SizeChart) -> list[float]:
    """Return the values on the axis: all machines, interval ends within a factor of four, and a limit near them."""
    values = [machine.value for one in chart.series for machine in one.machines]
    ends = [
        end
        for one in chart.series
        for m in one.machines
        for end in (m.low, m.high)
        if end and m.value / 4 < end < 4 * m.value
    ]
    found = [value for value in (*values, *ends) if value > 0]
    limit = chart.limit
    return [*found, limit] if limit and min(found) / 4 < limit < 4 * max(found) else found


def _legend(chart: SizeChart) -> list[tuple[str, str]]:
    machines = [machine for one in chart.series for machine in one.machines]
    found = [("measured meets", "measured")] if any(one.measured for one in machines) else []
    found += [("predicted meets", "predicted")] if not all(one.measured for one in machines) else []
    found += [("diamond", "with GPU")] if any(one.has_gpu for one in chart.series) else []
    found += [("upright", f"{chart.level:.0%} interval")] if any(one.low for one in machines) else []
    return [*found, ("curve", "geometric mean")] if any(len(one.levels) > 1 for one in chart.series) else found


def _summary(chart: SizeChart) -> str:
    counted = "; ".join(f"{one.name}: {len(one.machines)} machines" for one in chart.series)
    return ". ".join([title_of(chart), chart.facts, counted, *chart.notes])
