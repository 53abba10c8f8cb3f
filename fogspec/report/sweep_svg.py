"""Draw an evaluation on a sweep: the true and the predicted frontier, and the quality of choices against their money."""

from collections.abc import Sequence

import numpy as np

from fogspec.base.templates import render
from fogspec.base.text import line
from fogspec.base.units import money
from fogspec.charts.axes import Axis, axis, number, seconds
from fogspec.charts.frame import Frame, Mark, Obstacles, frame, place_labels
from fogspec.charts.menu_svg import LABELLED, LEFT, MARGIN, RIGHT, ROW, WIDTH, laid_out
from fogspec.charts.text import HEAD, LABEL, shortened, wrapped
from fogspec.evaluation.campaign import Replayed
from fogspec.evaluation.scores import front
from fogspec.evaluation.sweeps import Sweep
from fogspec.numerics.kernels import Floats

HIGH, GAP = 250, 108


def draw(sweep: Sweep, shown: Replayed, others: Sequence[tuple[str, Replayed]]) -> str:
    """Return the chart as SVG: frontiers as `shown` predicts them, and each of the named campaigns by its money."""
    metric = sweep.problem.settings[0].rule.metric
    named = [(title, one) for title, one in others if one.regret is not None]
    without = [line(title) for title, one in others if one.regret is None]
    room = WIDTH - 2 * MARGIN
    title = wrapped(_title(shown), room, HEAD, bold=True, most=3)
    facts = wrapped(
        f"{line(sweep.problem.id)}: {len(sweep.names)} machines measured; frontiers as sampler {shown.campaign.sampler} "
        f"predicts them from {len(shown.sampled)} of these",
        room,
        most=3,
    )
    facts_at = 50 + 22 * (len(title) - 1)
    top = facts_at + ROW * (len(facts) - 1) + 60
    second = top + HIGH + GAP
    bottom = (second if named else top) + HIGH
    notes = wrapped(f"⚠ no choice, or one that breaks a limit: {', '.join(without)}", room, most=4) if without else []
    legend = [("measured meets", "sampled"), ("predicted meets", "not sampled"), ("curve", "true frontier")]
    return render(
        "picture.svg.j2",
        title=title,
        lead=[],
        facts=[(facts_at + ROW * i, text) for i, text in enumerate(facts)],
        summary=f"frontiers of {len(sweep.names)} machines, and {len(others)} campaigns by their price and quality",
        width=WIDTH,
        height=bottom + 96 + ROW * len(notes),
        left=MARGIN,
        rows=[],
        words_left=MARGIN,
        frames=[_frontiers(sweep, shown, metric, top), *([_quality(named, second)] if named else [])],
        broken=False,
        legend=laid_out([*legend, ("paper", "predicted frontier")], room),
        legend_y=bottom + 58,
        source="Both axes are logarithmic.",
        source_y=bottom + 80,
        notes=notes,
    )


def _title(shown: Replayed) -> str:
    """Return how good the choice is, and how much of a sweep's price it took."""
    sampler = shown.campaign.sampler
    if shown.regret is None:
        return f"Sampler {sampler} ends without a machine that meets the limits"
    best = (
        "chooses the best machine"
        if shown.regret < 0.0005
        else f"chooses a machine within {shown.regret:.1%} of the best"
    )
    return f"Sampler {sampler} {best}, for {shown.fraction:.0%} of a sweep's price"


def _frontiers(sweep: Sweep, shown: Replayed, metric: str | None, top: float) -> Frame:
    truth = sweep.problem.metrics[metric] if metric else sweep.problem.latency_s
    price = sweep.machines.price_usd_per_hour
    usable = np.isfinite(shown.predicted) & (shown.predicted > 0)
    values = [*truth.tolist(), *shown.predicted[usable].tolist()]
    x, y = axis(price.tolist(), LEFT, WIDTH - RIGHT), axis(values, top + HIGH, top)
    words = number if metric else seconds
    found = frame(
        x=x,
        y=y,
        x_label="price per hour (log scale) →",
        y_label=f"↑ {shortened(line(metric or 'latency'), 260)} (log scale)",
        x_words=money,
        y_words=words,
        heading="Frontiers",
    )
    found.lines.append(("curve", _stairs(x, y, price, truth)))
    if usable.any():
        found.lines.append(("paper", _stairs(x, y, price[usable], shown.predicted[usable])))
    found.marks = [
        Mark(
            x=x.at(float(price[i])),
            y=y.at(float(truth[i])),
            kind="measured meets" if i in shown.sampled else "predicted meets",
            radius=4.4,
            title=f"{line(name)}: {words(float(truth[i]))}",
        )
        for i, name in enumerate(sweep.names)
    ]
    return found


def _stairs(x: Axis, y: Axis, price: Floats, value: Floats) -> str:
    corners = [(x.at(float(price[row])), y.at(float(value[row]))) for row in front(value, price)]
    steps = "".join(f"H{a:g}V{b:g}" for a, b in corners[1:])
    return f"M{corners[0][0]:g} {y.end:g}V{corners[0][1]:g}{steps}H{x.end:g}"


def _quality(named: Sequence[tuple[str, Replayed]], top: float) -> Frame:
    """Return the objective of each choice over the best one's against the price of its samples over the sweep's."""
    points = [(title, 100 * one.fraction, 1 + (one.regret or 0.0)) for title, one in named]
    x = axis([cost for _, cost, _ in points], LEFT, WIDTH - RIGHT)
    y = axis([1.0, *(quality for _, _, quality in points)], top + HIGH, top)
    found = frame(
        x=x,
        y=y,
        x_label="price of the samples, percent of a full sweep (log scale) →",
        y_label="↑ objective of the choice over the best (log scale)",
        x_words=lambda percent: f"{percent:g}%",
        y_words=lambda ratio: f"{ratio:.3g}",
        heading="Quality against money",
    )
    marks = [
        Mark(x=x.at(cost), y=y.at(quality), kind="measured meets", radius=4.4, title=f"{line(title)}: {quality:.3f}")
        for title, cost, quality in points
    ]
    found.marks = marks
    wanted = [
        (mark, shortened(line(title), LABELLED, LABEL, bold=True), "named")
        for mark, (title, *_) in zip(marks, points, strict=True)
    ]
    place_labels(found, wanted, Obstacles.of(found))
    return found
