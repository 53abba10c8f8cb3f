"""The pictures in docs/figures/: what the paper's Figures 3 to 5 show, from its own samples, and a menu.

For each of the four applications: the latency models, the cost models, and the Pareto frontiers in latency and price of
an hour. Written by `make figures-svg`; `--check` compares and ends with 1 where a file would differ.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fogspec.base.layout import Layout
from fogspec.base.templates import render
from fogspec.base.units import short_dollars
from fogspec.catalog.filters import filter_offers
from fogspec.catalog.sources import load_catalog
from fogspec.charts import menu_svg, model_svg
from fogspec.charts.axes import axis, seconds
from fogspec.charts.frame import Dot, Frame, frame
from fogspec.choice.choose import Choice, choose
from fogspec.model.fit import Models, fit, targets
from fogspec.model.predict import predict
from fogspec.numerics import families
from fogspec.numerics.families import fit_all
from fogspec.numerics.pareto import pareto
from fogspec.results.io import read_results
from fogspec.spec.loader import load
from fogspec.spec.schema import Application, Constraints
from tools.generated import write_or_check

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "figures"
TITLES = {
    "grasp-planning": "Dex-Net",
    "vslam": "SLAM",
    "motion-planning-cubicles": "Cubicles",
    "motion-planning-apartment": "Apartment",
}
SPECS = ("grasp-planning", "vslam", "motion-planning")
SHOWN = "motion-planning-cubicles"
WIDTH, HEIGHT, WIDE, HIGH = 760, 654, 286, 196
SOURCE = "samples: Chen et al., ICRA 2024, arXiv 2311.05600; AWS on-demand, us-east-1; both axes logarithmic"


@dataclass(frozen=True, slots=True)
class Case:
    """One application with everything that its pictures show; `open` is the choice without limits."""

    application: Application
    models: Models
    choice: Choice
    open: Choice


def cases() -> Iterator[Case]:
    """The paper's applications, measured by its authors."""
    for spec in SPECS:
        for one in load([str(ROOT / "specs" / f"{spec}.yaml")]):
            application = one.application
            results = read_results(Layout.of(one.path, application.metadata.name))
            assert results is not None
            clouds = tuple({entry.split("/")[0] for entry in application.spec.infra})
            catalog = load_catalog(None, clouds)
            offers = filter_offers(catalog, application.spec.hardware, application.spec.infra).offers
            models = fit(application, results)
            predicted = predict(models, offers, targets(application), catalog)
            free = application.spec.model_copy(update={"constraints": Constraints()})
            unlimited = application.model_copy(update={"spec": free})
            yield Case(application, models, choose(application, predicted), choose(unlimited, predicted))


def files() -> dict[Path, str]:
    """Every picture by path."""
    found = {one.application.metadata.name: one for one in cases()}
    four = [found[name] for name in TITLES]
    shown = found[SHOWN]
    return {
        FOLDER / "paper-latency.svg": _page(
            "Latency models", [_by_vcpus(one, *_corner(i), of_cost=False) for i, one in enumerate(four)],
            [("measured", "measured"), ("front", "measured, with a T4"), ("curve", "largest R² (the paper)")],
        ),
        FOLDER / "paper-cost.svg": _page(
            "Cost models", [_by_vcpus(one, *_corner(i), of_cost=True) for i, one in enumerate(four)],
            [("measured", "measured"), ("front", "measured, with a T4"), ("curve", "largest R² (the paper)")],
        ),
        FOLDER / "paper-frontiers.svg": _page(
            "Pareto frontiers", [_frontier(one, *_corner(i)) for i, one in enumerate(four)],
            [("measured", "measured, frontier dotted"), ("in", "predicted"), ("curve", "frontier of all machines")],
        ),
        FOLDER / "menu.svg": menu_svg.draw(menu_svg.menu_chart(shown.application, shown.choice, [])),
        FOLDER / "latency.svg": model_svg.draw(model_svg.latency_chart(shown.application, shown.choice, shown.models, [])),
    }  # fmt: skip


def _corner(i: int) -> tuple[float, float]:
    return 74 + (i % 2) * (WIDE + 96), 96 + (i // 2) * (HIGH + 80)


def _page(title: str, frames: list[Frame], legend: list[tuple[str, str]]) -> str:
    return render(
        "picture.svg.j2", title=title, subtitle=[SOURCE], summary=f"{title} of {', '.join(TITLES.values())}",
        width=WIDTH, height=HEIGHT, left=18, rows=[], frames=frames, legend=legend, legend_y=HEIGHT - 18, notes=[],
    )  # fmt: skip


def _by_vcpus(case: Case, left: float, top: float, *, of_cost: bool) -> Frame:
    """Latency or cost of every sample by vCPUs, and the family with the largest R² for each GPU type (2.C, 2.D)."""
    known = case.models.spec.observations
    factor = 1e6 / 3600 if of_cost else 1.0
    values = np.array([k.values["latency"] * (k.machine.price * factor if of_cost else 1) for k in known])
    vcpus, memory = (np.array([getattr(k.machine, name) for k in known]) for name in ("cpus", "memory"))
    gpu = np.array([k.machine.gpu is not None for k in known])
    x, y = axis(vcpus.tolist(), left, left + WIDE), axis(values.tolist(), top + HIGH, top)
    label = "USD per million requests" if of_cost else "mean latency"
    name = TITLES[case.application.metadata.name]
    found = frame(
        x=x,
        y=y,
        x_label="vCPUs",
        y_label=label,
        x_words=lambda v: f"{v:g}",
        y_words=short_dollars if of_cost else seconds,
        heading=name,
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
            found.lines.append(("curve", "M" + path))
            found.remark = found.remark or f"R² {best.r2:.4f}"
    found.dots = [
        Dot(x=x.at(v), y=y.at(value), kind="front" if has else "measured", radius=4.2, title=k.machine.instance)
        for k, v, value, has in zip(known, vcpus.tolist(), values.tolist(), gpu.tolist(), strict=True)
    ]
    return found


def _frontier(case: Case, left: float, top: float) -> Frame:
    """Latency against the price of an hour: the frontier of what was measured, and that of every machine predicted."""
    choice = case.open
    price, latency = choice.offers.price_usd_per_hour, choice.latency.value
    x, y = axis(price.tolist(), left, left + WIDE), axis(latency.tolist(), top + HIGH, top)
    found = frame(
        x=x,
        y=y,
        x_label="price of an hour",
        y_label="mean latency",
        x_words=short_dollars,
        y_words=seconds,
        heading=TITLES[case.application.metadata.name],
    )
    measured = np.flatnonzero(choice.latency.measured)
    for kind, rows in (("paper", measured), ("curve", np.arange(len(price)))):
        front = rows[pareto(price[rows], latency[rows])]
        corners = [(x.at(price[row]), y.at(latency[row])) for row in front]
        steps = "".join(f"H{a:g}V{b:g}" for a, b in corners[1:])
        found.lines.append((kind, f"M{corners[0][0]:g} {y.end:g}V{corners[0][1]:g}{steps}H{x.end:g}"))
    others = np.flatnonzero(~choice.latency.measured)
    found.specks.append(("in", "".join(f"M{x.at(price[row]):g} {y.at(latency[row]):g}h0" for row in others)))
    found.dots = [
        Dot(
            x=x.at(price[row]),
            y=y.at(latency[row]),
            kind="measured",
            radius=4.2,
            title=str(choice.offers.instance[row]),
        )
        for row in measured
    ]
    return found


if __name__ == "__main__":
    sys.exit(write_or_check(files(), sys.argv[1:], "make figures-svg"))
