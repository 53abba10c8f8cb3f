"""The charts in docs/figures/, from the paper's own samples, and the menu of one application.

For each of the four applications: the latency models, and the Pareto frontiers in latency and price per hour.
"""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from fogspec.base.units import money, shown
from fogspec.charts.picture import Axis, Dot, Frame, picture
from fogspec.charts.text import seconds
from fogspec.numerics import families
from fogspec.numerics.families import fit_all
from fogspec.numerics.kernels import Floats
from fogspec.numerics.pareto import pareto
from fogspec_lab.generated import ROOT
from fogspec_lab.paper.cases import Case, OwnRun, cases, own_runs

FOLDER = ROOT / "docs" / "figures"
MENU = ROOT / "compiled" / "grasp-planning-recorded" / "menu.svg"  # the one in README, shown by the site as well
HIGH = 190  # px, of a frame
SOURCE = "Samples: Chen et al., ICRA 2024, arXiv 2311.05600; AWS on-demand, us-east-1"


def charts() -> dict[Path, str]:
    """Return every chart by path."""
    four = cases()
    return {
        FOLDER / "paper-latency.svg": _page(
            "SLAM slows down beyond 16 vCPUs; the others get faster",
            [_by_vcpus(one) for one in four],
            [("measured", "measured"), ("gpu-1", "measured, with a T4"), ("curve", "paper's curve")],
        ),
        FOLDER / "paper-frontiers.svg": _page(
            "Predicted machines fill the gaps of the measured Pareto frontier",
            [_frontier(one) for one in four],
            [("measured", "measured"), ("predicted", "predicted"), ("diamond", "with GPU"),
             ("curve", "frontier of all machines"), ("paper", "frontier of the measured ones")],
        ),
        FOLDER / "paper-path-length.svg": _path_lengths(own_runs()),
        FOLDER / "menu.svg": MENU.read_text("utf-8"),
    }  # fmt: skip


def stairs(x: Floats, y: Floats, frame: Frame) -> list[tuple[float, float]]:
    """Return the frontier through corners whose x rises and y falls, between the edges of a frame."""
    corners = [(float(a), float(b)) for a, b in zip(x, y, strict=True)]
    steps = [point for (_, b), (c, d) in pairwise(corners) for point in ((c, b), (c, d))]
    return [(corners[0][0], 10**frame.y.high), corners[0], *steps, (10**frame.x.high, corners[-1][1])]


def _page(title: str, frames: Sequence[Frame], legend: Sequence[tuple[str, str]], source: str = SOURCE) -> str:
    return picture(title, frames, facts=source, keys=legend, columns=2, high=HIGH)


def _path_lengths(runs: tuple[OwnRun, ...]) -> str:
    """Draw the latency and the path length of every sample by vCPUs, a row for each of our own applications."""
    frames = []
    for run in runs:
        for label, words, at in (("mean latency", seconds, 2), ("path length", shown, 3)):
            unit = f" in {run.unit}" if at == 3 and run.unit else ""
            points = [(one[0], float(one[1]), float(one[at])) for one in run.samples]
            vcpus = sorted({x for _, x, _ in points})
            frames.append(
                Frame(
                    x=Axis.over("vCPUs", "{:g}".format, vcpus, vcpus),
                    y=Axis.over(f"{label}{unit}", words, [y for *_, y in points]),
                    dots=[Dot(title=name, x=x, y=y, measured=True) for name, x, y in points],
                    heading=run.name.removeprefix("motion-planning-"),
                )
            )
    source = f"Our own runs, on {', '.join(dict.fromkeys(run.where for run in runs))}"
    return _page("Latency and path length by vCPUs, in our own runs", frames, [("measured", "measured")], source)


def _by_vcpus(case: Case) -> Frame:
    """Latency of every sample by vCPUs, and the family with the largest R² for each GPU type (2.C)."""
    known = case.models.observations
    values = np.array([k.values["latency"] for k in known])
    vcpus, memory = (np.array([getattr(k.machine, name) for k in known]) for name in ("cpus", "memory"))
    gpu = np.array([k.machine.gpu is not None for k in known])
    lines, fits = [], []
    for mine in (~gpu, gpu):
        if mine.any():
            best = families.select(fit_all(vcpus[mine], memory[mine], values[mine]), "r2")
            at = np.geomspace(vcpus[mine].min(), vcpus[mine].max(), 50)
            curve = best.predict(at, at * float(np.median(memory[mine] / vcpus[mine])))
            points = [(a, b) for a, b in zip(at.tolist(), curve.tolist(), strict=True) if b > 0]
            lines.append(("curve gpu-1" if mine is gpu else "curve", points))
            fits.append(best.r2)
    dots = [
        Dot(title=k.machine.instance, x=v, y=y, measured=True, diamond=has, hue="gpu-1" if has else "meets")
        for k, v, y, has in zip(known, vcpus.tolist(), values.tolist(), gpu.tolist(), strict=True)
    ]
    x = Axis.over("vCPUs", "{:g}".format, [2.0, 64.0], [2.0**e for e in range(1, 7)])
    y = Axis.over("mean latency", seconds, values.tolist())
    return Frame(x=x, y=y, dots=dots, lines=lines, heading=f"{case.title}, R² {fits[0]:.4f}")


def _frontier(case: Case) -> Frame:
    """Latency against the price per hour: the frontier of what was measured, and that of every machine predicted."""
    choice = case.open
    price, latency = choice.offers.price_usd_per_hour, choice.latency.value
    found = Frame(
        x=Axis.over("price per hour", money, price.tolist()),
        y=Axis.over("mean latency", seconds, latency.tolist()),
        heading=case.title,
    )
    is_measured = choice.latency.measured
    fronts = []
    for kind, rows in (("paper", np.flatnonzero(is_measured)), ("curve", np.arange(len(price)))):
        front = rows[pareto(price[rows], latency[rows])]
        fronts.append((kind, stairs(price[front], latency[front], found)))
    found.lines = fronts
    found.dots = [
        Dot(
            title=str(choice.offers.instance[row]),
            x=float(price[row]),
            y=float(latency[row]),
            measured=bool(is_measured[row]),
            hue="meets" if is_measured[row] else "misses",
            diamond=bool(choice.offers.gpu[row]),
        )
        for row in range(len(price))
    ]
    return found
