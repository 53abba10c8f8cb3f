"""Implement `fogspec menu`: show the choices of a measured application, also under other constraints."""

import math
from typing import TYPE_CHECKING

import click

from fogspec.base.console import columns, say_json, say_text
from fogspec.base.errors import UsageError
from fogspec.base.text import shell_command
from fogspec.base.units import parse_cost_usd_per_request, parse_duration_s
from fogspec.cli.next_steps import next_command, say_next
from fogspec.cli.options import OUTPUT, SPEC, load_named, quantity, raise_together

if TYPE_CHECKING:
    from fogspec.compile.inputs import Inputs
    from fogspec.report.menu import Changes


def _number(_context: click.Context, _parameter: click.Parameter, value: float | None) -> float | None:
    if value is not None and math.isnan(value):
        raise click.BadParameter("nan is not a number from 0 to 1")
    return value


@click.command()
@SPEC
@click.option(
    "--alpha",
    type=click.FloatRange(0, 1),
    callback=_number,
    help="weight of latency: 1 only latency, 0 only cost  [default: the spec]",
)
@click.option(
    "--latency", metavar="2s", help="limit on the latency of one request; none for no limit  [default: the spec]"
)
@click.option(
    "--cost",
    metavar="'$0.001/request'",
    help="limit on the cost of one request; none for no limit  [default: the spec]",
)
@click.option(
    "--metric",
    metavar="NAME",
    help="quantity in the objective: latency, or a metric of spec.metrics  [default: the spec]",
)
@click.option(
    "--limit",
    "bounds",
    multiple=True,
    metavar="NAME=35",
    help="limit on a metric; NAME=none for no limit; repeatable",
)
@click.option("--name", help="application, if the spec has several")
@OUTPUT
def command(
    spec: str,
    alpha: float | None,
    latency: str | None,
    cost: str | None,
    metric: str | None,
    bounds: tuple[str, ...],
    name: str | None,
    output: str,
) -> None:
    """Show the choice of an application among the best machines.

    APP is a name or a spec. Nothing is measured again and nothing is written.
    """
    from fogspec.catalog.table import each_in_its_unit
    from fogspec.choice.menu import menu_data
    from fogspec.compile.decision import no_choice
    from fogspec.report.menu import NO_LIMIT, Changes, menu_view, show

    for option, text, parse in (("--latency", latency, parse_duration_s), ("--cost", cost, parse_cost_usd_per_request)):
        if text not in (None, NO_LIMIT):
            quantity(option, str(text), parse)
    changes = Changes(alpha=alpha, latency=latency, cost=cost, metric=metric, limits=dict(map(_bound, bounds)))
    inputs = load_named(spec, name)
    views = [menu_view(one, changes) for one in inputs]
    menus = [menu for menu, _ in views]
    if output == "json":
        say_json([menu_data(menu) for menu in menus])
    else:
        shown = zip(each_in_its_unit(inputs), views, strict=True)
        say_text("\n\n".join(show(menu, machines, columns()) for _, (menu, machines) in shown))
        if all(menu.spec.balanced is not None for menu in menus):
            say_next(*(_following(one, changes) for one in inputs))
    raise_together([no_choice(menu) for _, menu in zip(each_in_its_unit(inputs), menus, strict=True)])


def _following(inputs: "Inputs", changes: "Changes") -> str | None:
    """Return what comes next: to explain the choice, or to write what was tried into the spec."""
    layout = inputs.layout
    if changes == type(changes)():
        return next_command("explain", layout.argument)
    compiling = next_command("compile", layout.spec)
    return f"to keep it, write it into {shell_command(layout.spec)} ({changes.text()}), then {compiling}"


def _bound(text: str) -> tuple[str, float | None]:
    """Return the metric and the bound of `NAME=35`; raise UsageError."""
    name, equals, value = text.partition("=")
    try:
        bound = None if value.strip() == "none" else float(value)
    except ValueError:
        bound = math.nan
    if not equals or not name.strip() or (bound is not None and not bound > 0):
        raise UsageError(f"--limit is a metric and its bound, got {text!r}", "--limit path_length=35")
    return name.strip(), bound
