"""The picture of a model: latency, or a metric of the application, by vCPUs, with a line for each kind of GPU."""

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import NormalDist, geometric_mean

import numpy as np

from fogspec.base.text import line
from fogspec.base.units import shown
from fogspec.catalog.machine import Machine
from fogspec.charts.menu import interval_of, source_of
from fogspec.charts.picture import Axis, Dot, Frame, Limit, Point, picture
from fogspec.charts.text import seconds, shortened
from fogspec.choice.choose import Choice
from fogspec.choice.menu import LEVEL
from fogspec.choice.rule import latency_limit_s
from fogspec.language.schema import Application
from fogspec.model.fit import Fitted
from fogspec.numerics.observations import DEFAULT_NOISE

HIGH = 268  # px, of the frame
MARKS = 40  # machines that are drawn individually
APART, SIDE = 1.07, 1.5  # ratio between machines with equally many vCPUs, and of the last of them to their number
HUES = 3  # accelerators with a color of their own
FLAT, LESS = 1.1, 1.05  # ratios of latencies: as good as equal, and worth saying
WIDE = 2.0  # ratio of the ends of a range from which equal predictions say nothing


@dataclass(frozen=True, slots=True)
class Series:
    """The machines with one accelerator, or without one, as dots at their vCPUs."""

    name: str
    has_gpu: bool
    dots: Sequence[Dot]

    @property
    def levels(self) -> list[Point]:
        """The geometric mean of the values for each number of vCPUs, in their order."""
        values = defaultdict(list)
        for dot in self.dots:
            values[dot.x].append(dot.y)
        return [(vcpus, geometric_mean(values[vcpus])) for vcpus in sorted(values)]

    @property
    def ranges(self) -> dict[float, tuple[float, float]]:
        """The geometric means of the ends of the intervals for each number of vCPUs that has any."""
        ends = defaultdict(list)
        for dot in self.dots:
            if dot.ends:
                ends[dot.x].append((dot.ends[0][1], dot.ends[1][1]))
        return {
            vcpus: (geometric_mean(low), geometric_mean(high))
            for vcpus, pairs in ends.items()
            for low, high in [zip(*pairs, strict=True)]
        }


def model_picture(
    application: Application, choice: Choice, models: Fitted, doubts: Sequence[str], metric: str | None = None
) -> str | None:
    """Return the picture of the latency, or of a metric, by vCPUs with `doubts`; None if there is no machine to draw."""
    spec, words = application.spec, shown if metric else seconds
    gpus = sorted({_gpu_of(one.machine) for one in models.observations}, key=lambda gpu: gpu or ("", 0.0))
    series = [one for gpu in gpus if (one := _series(choice, models, gpu, metric, words)).dots]
    if not series:
        return None
    measured = [dot.measured for one in series for dot in one.dots]
    which = ("shapes of this host", "machines predicted") if models.measured_on_local else ("machines", "predicted")
    unit, what = line(spec.metrics[metric].unit or "") if metric else "", line(metric or "latency")
    label = what if metric else f"{spec.constraints.statistic} latency"
    counted = f"{sum(measured)} {which[0]} measured, {len(measured) - sum(measured)} {which[1]}"
    limit = spec.constraints.metrics.get(metric) if metric else latency_limit_s(application)
    return picture(
        finding(series, what),
        [model_frame(series, what, f"{label} in {unit}" if unit else label, words, limit)],
        facts=f"{_upper(label)} of one request by vCPUs: {counted}",
        source=source_of(choice, "Machines"),
        notes=doubts,
        high=HIGH,
    )


def _series(
    choice: Choice, models: Fitted, gpu: tuple[str, float] | None, metric: str | None, words: Callable[[float], str]
) -> Series:
    offers, predictions = choice.offers, choice.metrics[metric] if metric else choice.latency
    name, number = gpu or ("", 0.0)
    chosen = None if choice.chosen is None else str(offers.instance[choice.chosen])

    def dot(name: str, vcpus: float, value: float, ends: tuple[float, float] | None, measured: bool) -> Dot:
        title, hue = f"{line(name)}: {vcpus:g} vCPUs, {words(value)}", "chosen" if name == chosen else "meets"
        of = ((vcpus, ends[0]), (vcpus, ends[1])) if ends else None
        return Dot(
            title=title, x=vcpus, y=value, ends=of, measured=measured, diamond=gpu is not None, hue=hue, name=line(name)
        )

    rows = np.flatnonzero(
        (offers.gpu == name) & (offers.gpu_count == number) & choice.eligible & (predictions.value > 0)
    )
    if predictions.posterior:  # neither depends on the region: one row of each instance type
        rows = rows[np.unique(predictions.type_index[rows], return_index=True)[1]]
    few, known = len(rows) <= MARKS, rows[predictions.measured[rows] | (offers.instance[rows] == chosen)]
    found = [
        dot(
            str(offers.instance[row]),
            float(offers.vcpus[row]),
            float(predictions.value[row]),
            interval_of(predictions, row) if few or row in known else None,
            bool(predictions.measured[row]),
        )
        for row in rows.tolist()
    ]
    measured = {one.name for one in found if one.measured}
    t = NormalDist().inv_cdf((1 + LEVEL) / 2)
    for one in models.observations:  # and measured machines that are no candidates
        value, own = one.values.get(metric or "latency", 0.0), one.machine.instance
        if _gpu_of(one.machine) == gpu and value > 0 and line(own) not in measured:
            wide = math.exp(t * one.errors.get("latency", DEFAULT_NOISE))
            if metric:
                found.append(dot(own, one.machine.cpus, value, None, True))
            else:
                low, value, high = map(one.at_rate, (value / wide, value, value * wide))
                found.append(dot(own, one.machine.cpus, value, (low, high), True))
    return Series("no GPU" if gpu is None else f"{number:g} {line(name)}", gpu is not None, found)


def _gpu_of(machine: Machine) -> tuple[str, float] | None:
    return None if machine.gpu is None else (machine.gpu.name, float(machine.gpu.count))


def _upper(what: str) -> str:
    """Return what begins a sentence; the name of a metric stays as it is written."""
    return what[:1].upper() + what[1:] if what.endswith("latency") else what


def finding(series: Sequence[Series], quantity: str) -> str:
    """Return the finding about a quantity, the latency or a metric, as a sentence."""
    plain = [one for one in series if not one.has_gpu]
    gpus = [one for one in series if one.has_gpu]
    if plain and gpus and (said := _accelerated(plain[0], gpus)):
        return said
    levels, fast, what = (plain or gpus)[0].levels, quantity == "latency", _upper(quantity)
    (first, start), (last, end) = levels[0], levels[-1]
    best_at, best = min(levels, key=lambda level: level[1])
    if len(levels) < 2:
        return f"{what} of machines with {first:g} vCPUs"
    flat = max(value for _, value in levels) < FLAT * best
    if not _known((plain or gpus)[0].ranges, first, last if best_at == first else best_at, flat):
        return f"Too little is known to say how the {quantity} changes with more vCPUs"
    if flat:
        return "More vCPUs do not help this application" if fast else f"More vCPUs do not change the {quantity}"
    if best_at == first:
        return "More vCPUs make this application slower" if fast else f"More vCPUs make the {quantity} larger"
    if end > LESS * best:
        slower = f"More than {best_at:g} vCPUs make this application slower"
        return slower if fast else f"{what} is smallest with {best_at:g} vCPUs"
    falls = ((a, b, one / other) for (a, one), (b, other) in pairwise(levels))
    until = next((a for a, b, ratio in falls if ratio < FLAT ** math.log2(b / a)), last)
    if until == first:
        return f"{what} hardly falls with more vCPUs"
    fall = (start / dict(levels)[until]) ** (1 / math.log2(until / first))
    return f"{what} falls {fall:.1f} × with each doubling of vCPUs{'' if until == last else f', up to {until:g}'}"


def _known(ranges: Mapping[float, tuple[float, float]], a: float, b: float, flat: bool) -> bool:
    """Return whether the ranges at two numbers of vCPUs, if there are any, bear out equal values, or different ones."""
    if a not in ranges or b not in ranges:
        return True
    (low, high), (other_low, other_high) = ranges[a], ranges[b]
    return max(high / low, other_high / other_low) < WIDE if flat else high < other_low or other_high < low


def _accelerated(plain: Series, gpus: Sequence[Series]) -> str | None:
    """Return which few vCPUs with an accelerator are as fast as the best machine without one; None if none are."""
    best = min(plain.dots, key=lambda dot: dot.y)
    for one in gpus:
        fast = [dot.x for dot in one.dots if dot.y <= (best.ends[1][1] if best.ends else best.y)]
        if min(fast, default=math.inf) < best.x:
            kind = one.name.removeprefix("1 ")
            article = "" if kind == one.name else "an " if kind[:1] in "AEFHILMNORSX8" else "a "
            return f"With {article}{kind}, {min(fast):g} vCPUs are as fast as any CPU-only machine"
    return None


def model_frame(
    series: Sequence[Series], quantity: str, label: str, words: Callable[[float], str], limit: float | None
) -> Frame:
    """Return the machines by vCPUs, with the lines of their means, and with the limit if it is near them."""
    machines = [dot for one in series for dot in one.dots]
    vcpus, heights = sorted({dot.x for dot in machines}), [dot.y for dot in machines]
    chosen = next((dot for dot in machines if dot.hue == "chosen"), None)
    dots, lines, specks = list[Dot](), list[tuple[str, Sequence[Point]]](), []
    for at, one in enumerate(series):
        hue = f"gpu-{(at - (not series[0].has_gpu)) % HUES + 1}" if one.has_gpu else "meets"
        kept = [dot for dot in one.dots if len(machines) <= MARKS or dot.measured or dot.hue == "chosen"]
        last = max(kept, key=lambda dot: (dot.x, dot.hue != "chosen", dot.y), default=None)
        of_all = one.name if len(series) > 1 or one.has_gpu else ""
        names = {id(last): of_all, id(chosen): chosen.name if chosen else ""}
        painted = [
            replace(dot, hue="chosen" if dot.hue == "chosen" else hue, name=names.get(id(dot), "")) for dot in kept
        ]
        dots += _beside(painted, vcpus)
        if len(one.levels) > 1:
            lines.append((f"curve {hue}", one.levels))
        if len(kept) < len(one.dots):
            rest = [dot for dot in one.dots if dot not in kept]
            specks.append((hue, np.array([dot.x for dot in rest]), np.array([dot.y for dot in rest])))
    heights += [end for dot in dots for _, end in dot.ends or () if dot.y / 4 < end < 4 * dot.y]
    near = [limit] if limit and min(heights) / 4 < limit < 4 * max(heights) else []
    said = f"{shortened(quantity, 150)} limit {words(limit)}" if limit and limit > 0 else ""
    return Frame(
        x=Axis.over("vCPUs", "{:g}".format, [*vcpus, *(dot.x for dot in dots)], vcpus),
        y=Axis.over(shortened(label, 230), words, [*heights, *near]),
        dots=dots,
        limits=[Limit(said, 0, 1, math.log10(most)) for most in near],
        lines=lines,
        specks=specks,
        remark=f"off scale: {said}" if said and not near else "",
    )


def _beside(dots: Sequence[Dot], counts: Sequence[float]) -> list[Dot]:
    """Return dots with equally many vCPUs side by side, and apart from the next number."""
    found = []
    for vcpus in counts:
        here = sorted((dot for dot in dots if dot.x == vcpus), key=lambda dot: dot.title)
        near = min((b / a for a, b in pairwise(counts) if vcpus in (a, b)), default=2.0)
        step = min(APART, near ** (0.8 / max(len(here), 1)), SIDE ** (2 / max(len(here), 1)))
        for i, dot in enumerate(here):
            x = vcpus * step ** (i - (len(here) - 1) / 2)
            found.append(replace(dot, x=x, ends=dot.ends and ((x, dot.ends[0][1]), (x, dot.ends[1][1]))))
    return found
