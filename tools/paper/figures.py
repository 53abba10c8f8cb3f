"""The charts in docs/figures/: what the paper's Figures 3 to 5 show, from its own samples, and the menu of one application.

For each of the four applications: the latency models, the cost models, and the Pareto frontiers in latency and price per hour.
"""

from pathlib import Path

import numpy as np

from fogspec.base.templates import render
from fogspec.base.units import money, shown_percent
from fogspec.charts.axes import axis, number, seconds
from fogspec.charts.frame import Frame, Mark, frame
from fogspec.charts.menu_svg import laid_out
from fogspec.numerics import families
from fogspec.numerics.families import fit_all
from fogspec.numerics.pareto import pareto
from tools.generated import ROOT
from tools.paper.cases import TITLES, Case, OwnRun, cases, own_runs

FOLDER = ROOT / "docs" / "figures"
MENU = ROOT / "compiled" / "grasp-planning-recorded" / "menu.svg"  # the one in README, shown by the site as well
WIDTH, LEFT, WIDE, HIGH = 760, 18, 286, 190
TOP, STEP = 112, 286
SOURCE = "Samples: Chen et al., ICRA 2024, arXiv 2311.05600; AWS on-demand, us-east-1; both axes logarithmic"


def charts() -> dict[Path, str]:
    """Return every chart by path."""
    four, runs = cases(), own_runs()
    return {
        FOLDER / "paper-latency.svg": _page(
            "SLAM slows down beyond 16 vCPUs; the others get faster",
            [_by_vcpus(one, *_corner(i), of_cost=False) for i, one in enumerate(four)],
            [("measured meets", "measured"), ("gpu", "measured, with a T4"), ("curve", "paper's curve")],
        ),
        FOLDER / "paper-cost.svg": _page(
            "With 64 vCPUs a request costs more than with 2, in all four applications",
            [_by_vcpus(one, *_corner(i), of_cost=True) for i, one in enumerate(four)],
            [("measured meets", "measured"), ("gpu", "measured, with a T4"), ("curve", "paper's curve")],
        ),
        FOLDER / "paper-frontiers.svg": _page(
            "Predicted machines fill the gaps of the measured Pareto frontier",
            [_frontier(one, *_corner(i)) for i, one in enumerate(four)],
            [("measured meets", "measured"), ("predicted misses", "predicted"), ("diamond", "with GPU"),
             ("curve", "frontier of all machines"), ("paper", "frontier of the measured ones")],
        ),
        **({FOLDER / "paper-path-length.svg": _path_lengths(runs)} if runs else {}),
        FOLDER / "menu.svg": MENU.read_text("utf-8"),
    }  # fmt: skip


def _corner(i: int) -> tuple[float, float]:
    return 74 + (i % 2) * (WIDE + 96), TOP + (i // 2) * STEP


def _page(title: str, frames: list[Frame], legend: list[tuple[str, str]], source: str = SOURCE, rows: int = 2) -> str:
    bottom = TOP + (rows - 1) * STEP + HIGH
    return render(
        "picture.svg.j2", title=[title], lead=[], facts=[(50, source)], summary=f"{title}: {', '.join(TITLES.values())}",
        width=WIDTH, height=bottom + 76, left=LEFT, rows=[], words_left=LEFT, frames=frames, broken=False,
        legend=laid_out(legend, WIDTH - 2 * LEFT), legend_y=bottom + 60, source="", source_y=0, notes=[],
    )  # fmt: skip


def _path_lengths(runs: tuple[OwnRun, ...]) -> str:
    """Draw the latency and the path length of every sample by vCPUs, a row for each of our own applications."""
    frames = []
    for i, run in enumerate(runs):
        top = TOP + i * STEP
        for column, (label, words, at) in enumerate((("mean latency", seconds, 2), ("path length", number, 3))):
            left = 74 + column * (WIDE + 96)
            vcpus, values = [one[1] for one in run.samples], [float(one[at]) for one in run.samples]
            x, y = axis(vcpus, left, left + WIDE), axis(values, top + HIGH, top)
            unit = f" in {run.unit}" if at == 3 and run.unit else ""
            found = frame(
                x=x,
                y=y,
                x_label="vCPUs →",
                y_label=f"↑ {label}{unit}",
                x_words=lambda v: f"{v:g}",
                y_words=words,
                heading=run.name.removeprefix("motion-planning-"),
            )
            found.x_ticks = [(x.at(count), f"{count:g}") for count in sorted(set(vcpus))]
            found.marks = [
                Mark(x=x.at(one[1]), y=y.at(float(one[at])), kind="measured meets", radius=4.4, title=one[0])
                for one in run.samples
            ]
            frames.append(found)
    source = f"Our own runs, on {', '.join(dict.fromkeys(run.where for run in runs))}; both axes logarithmic"
    return _page(_paths_title(runs), frames, [("measured meets", "measured")], source, len(runs))


def _paths_title(runs: tuple[OwnRun, ...]) -> str:
    """Return what more vCPUs change in our own runs, as ratios of the largest shape to the smallest."""
    ends = [(min(run.samples, key=lambda one: one[1]), max(run.samples, key=lambda one: one[1])) for run in runs]
    latency, length = (max(float(most[at]) / float(least[at]) for least, most in ends) for at in (2, 3))
    few, many = (sorted({one[i][1] for one in ends}) for i in (0, 1))
    if len(few) > 1 or len(many) > 1 or few == many:
        return "Latency and path length by vCPUs, in our own runs"
    saved = [f"{shown_percent(max(1 - ratio, 0.0))} of the {of}" for ratio, of in ((latency, "time"), (length, "path"))]
    return f"{many[0]:g} vCPUs save at least {' and '.join(saved)}"


def _by_vcpus(case: Case, left: float, top: float, *, of_cost: bool) -> Frame:
    """Latency or cost of every sample by vCPUs, and the family with the largest R² for each GPU type (2.C, 2.D)."""
    known = case.models.spec.observations
    factor = 1000 / 3600 if of_cost else 1.0
    values = np.array([k.values["latency"] * (k.machine.price * factor if of_cost else 1) for k in known])
    vcpus, memory = (np.array([getattr(k.machine, name) for k in known]) for name in ("cpus", "memory"))
    gpu = np.array([k.machine.gpu is not None for k in known])
    x, y = axis([2.0, 64.0], left, left + WIDE), axis(values.tolist(), top + HIGH, top)
    label = "cost per 1,000 requests" if of_cost else "mean latency"
    found = frame(
        x=x,
        y=y,
        x_label="vCPUs →",
        y_label=f"↑ {label}",
        x_words=lambda v: f"{v:g}",
        y_words=money if of_cost else seconds,
        heading=case.title,
    )
    found.x_ticks = [(x.at(2.0**e), str(2**e)) for e in range(1, 7)]
    for mine in (~gpu, gpu):
        if mine.any():
            best = families.select(fit_all(vcpus[mine], memory[mine], values[mine]), "r2")
            at = np.geomspace(vcpus[mine].min(), vcpus[mine].max(), 50)
            curve = best.predict(at, at * float(np.median(memory[mine] / vcpus[mine])))
            path = "L".join(
                f"{x.at(a):g} {y.clipped(b):g}" for a, b in zip(at.tolist(), curve.tolist(), strict=True) if b > 0
            )
            found.lines.append(("curve gpu-1" if mine is gpu else "curve", "M" + path))
            found.remark = found.remark or f"R² {best.r2:.4f}"
    found.marks = [
        Mark(
            x=x.at(v),
            y=y.at(value),
            kind="measured gpu-1" if has else "measured meets",
            radius=4.4,
            diamond=has,
            title=k.machine.instance,
        )
        for k, v, value, has in zip(known, vcpus.tolist(), values.tolist(), gpu.tolist(), strict=True)
    ]
    return found


def _frontier(case: Case, left: float, top: float) -> Frame:
    """Latency against the price per hour: the frontier of what was measured, and that of every machine predicted."""
    choice = case.open
    price, latency = choice.offers.price_usd_per_hour, choice.latency.value
    x, y = axis(price.tolist(), left, left + WIDE), axis(latency.tolist(), top + HIGH, top)
    found = frame(
        x=x,
        y=y,
        x_label="price per hour →",
        y_label="↑ mean latency",
        x_words=money,
        y_words=seconds,
        heading=case.title,
    )
    measured = np.flatnonzero(choice.latency.measured)
    for kind, rows in (("paper", measured), ("curve", np.arange(len(price)))):
        front = rows[pareto(price[rows], latency[rows])]
        corners = [(x.at(price[row]), y.at(latency[row])) for row in front]
        steps = "".join(f"H{a:g}V{b:g}" for a, b in corners[1:])
        found.lines.append((kind, f"M{corners[0][0]:g} {y.end:g}V{corners[0][1]:g}{steps}H{x.end:g}"))
    others = np.flatnonzero(~choice.latency.measured)
    found.marks = [
        Mark(
            x=x.at(price[row]),
            y=y.at(latency[row]),
            kind=kind,
            radius=4.4,
            title=str(choice.offers.instance[row]),
            diamond=bool(choice.offers.gpu[row]),
        )
        for kind, rows in (("predicted misses", others), ("measured meets", measured))
        for row in rows
    ]
    return found
