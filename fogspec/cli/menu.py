"""Implement `fogspec menu`: show the choices of a measured application, also under other constraints."""

import shutil
from pathlib import Path

import click

from fogspec.base.console import has_color, say_json, say_text
from fogspec.base.errors import Infeasible, UsageError
from fogspec.base.units import UnitError
from fogspec.cli.options import CATALOG, COLOR, OUTPUT, PRIORS, SPEC, load_named


@click.command()
@SPEC
@click.option("--alpha", type=click.FloatRange(0, 1), help="1 = only latency counts, 0 = only cost counts")
@click.option("--latency", metavar="2s", help="another limit on the latency of one request; none for no limit")
@click.option("--cost", metavar="'$0.001/request'", help="another limit on the cost of one request; none for no limit")
@click.option("--name", help="the application, where the file has several")
@CATALOG
@PRIORS
@OUTPUT
@COLOR
def command(
    spec: str,
    alpha: float | None,
    latency: str | None,
    cost: str | None,
    name: str | None,
    catalog_path: str | None,
    priors: Path | None,
    output: str,
    color: bool | None,
) -> None:
    """Show the choices and the Pareto front of SPEC, a spec or the name of an application in specs/.

    Nothing is measured anew and nothing is written.
    """
    from fogspec.report.menu import menu_view, show

    inputs = load_named(spec, name, catalog_path, priors)
    try:
        views = [menu_view(one, alpha, latency, cost) for one in inputs]
    except UnitError as wrong:
        raise UsageError(str(wrong), *([f"write {wrong.fix}"] if wrong.fix else [])) from None
    menus = [one.menu for one in views]
    if output == "json":
        say_json([menu.model_dump(mode="json") for menu in menus])
    else:
        width = shutil.get_terminal_size().columns
        if color is None:
            color = has_color()
        say_text("\n\n".join(show(one.menu, one.plot(width, color)) for one in views), color=color)
    if infeasible := [menu.metadata.name for menu in menus if menu.spec.balanced is None]:
        raise Infeasible(f"{', '.join(infeasible)}: no machine meets the limits")
