"""Draw an evaluation on a sweep: the true and the predicted frontier, and the quality of choices against their money."""

from collections.abc import Sequence

import numpy as np

from fogspec.base.templates import render
from fogspec.base.units import short_dollars
from fogspec.charts.axes import Axis, axis, number, seconds
from fogspec.charts.frame import Dot, Frame, frame, place_labels
from fogspec.evaluation.campaign import Replayed
from fogspec.evaluation.scores import front
from fogspec.evaluation.sweeps import Sweep
from fogspec.numerics.kernels import Floats

WIDTH, LEFT, RIGHT, TOP, HIGH, GAP = 760, 84, 18, 96, 238, 84


def draw(sweep: Sweep, shown: Replayed, others: Sequence[tuple[str, Replayed]]) -> str:
    """Return the chart as SVG: frontiers as `shown` predicts them, and each of the named campaigns by its money."""
    second = TOP + HIGH + GAP
    metric = sweep.problem.settings[0].rule.metric
    named = [(title, one) for title, one in others if one.regret is not None]
    without = [title for title, one in others if one.regret is None]
    notes = [f"no choice, or one that breaks a limit: {', '.join(without)}"] if without else []
    return render(
        "picture.svg.j2",
        title=f"{sweep.problem.id}: predicted against true",
        subtitle=[
            f"{len(sweep.names)} machines measured; frontiers as sampler {shown.campaign.sampler} predicts them "
            f"from {len(shown.sampled)} samples"
        ],
        summary=f"frontiers of {len(sweep.names)} machines, and {len(others)} campaigns by their price and quality",
        width=WIDTH,
        height=second + HIGH + 88 + 15 * len(notes),
        left=18,
        rows=[],
        frames=[_frontiers(sweep, shown, metric), *([_quality(named, second)] if named else [])],
        legend=[
            ("measured", "sampled"),
            ("front", "not sampled"),
            ("curve", "true frontier"),
            ("paper", "predicted frontier"),
        ],
        legend_y=second + HIGH + 66,
        notes=notes,
    )


def _frontiers(sweep: Sweep, shown: Replayed, metric: str | None) -> Frame:
    truth = sweep.problem.metrics[metric] if metric else sweep.problem.latency_s
    price = sweep.machines.price_usd_per_hour
    usable = np.isfinite(shown.predicted) & (shown.predicted > 0)
    values = [*truth.tolist(), *shown.predicted[usable].tolist()]
    x, y = axis(price.tolist(), LEFT, WIDTH - RIGHT), axis(values, TOP + HIGH, TOP)
    words = number if metric else seconds
    found = frame(
        x=x,
        y=y,
        x_label="price per hour (log scale)",
        y_label=f"{metric or 'latency'} (log scale)",
        x_words=short_dollars,
        y_words=words,
        heading="frontiers",
    )
    found.lines.append(("curve", _stairs(x, y, price, truth)))
    if usable.any():
        found.lines.append(("paper", _stairs(x, y, price[usable], shown.predicted[usable])))
    found.dots = [
        Dot(
            x=x.at(float(price[i])),
            y=y.at(float(truth[i])),
            kind="measured" if i in shown.sampled else "front",
            radius=4.2,
            title=f"{name}: {words(float(truth[i]))}",
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
        x_label="price of the samples, percent of a full sweep (log scale)",
        y_label="objective of the choice over the best (log scale)",
        x_words=lambda percent: f"{percent:g} %",
        y_words=lambda ratio: f"{ratio:.3g}",
        heading="quality against money",
    )
    dots = [
        (Dot(x=x.at(cost), y=y.at(quality), kind="measured", radius=4.2, title=f"{title}: {quality:.3f}"), title)
        for title, cost, quality in points
    ]
    found.dots = [dot for dot, _ in dots]
    place_labels(found, [(dot, title, "named") for dot, title in dots])
    return found
