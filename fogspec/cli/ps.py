"""Implement `fogspec ps`: what runs of all applications."""

from pathlib import Path

import click

from fogspec.base.console import columns, note, say, say_json
from fogspec.base.errors import FogspecError, InvalidInput
from fogspec.base.text import table
from fogspec.cli.next_steps import next_command, say_next
from fogspec.cli.options import OUTPUT


@click.command()
@OUTPUT
def command(output: str) -> None:
    """List every machine in this project's live state: the state of its nodes, its uptime and its cost so far.

    Includes applications without a spec, which may still run after it was deleted or renamed. Nothing is written.
    """
    from functools import cache

    from fogspec.backends.registry import deployment_backend
    from fogspec.base.quantities import as_numbers
    from fogspec.base.units import dollars, rounded, shown_duration, shown_price
    from fogspec.deploy.running import running
    from fogspec.deploy.state import SystemWallClock
    from fogspec.spec.discover import NoSpecs, check_specs

    try:
        loaded, wrong = check_specs()
        is_known = not any(one.severity == "error" for one in wrong)
    except NoSpecs:
        loaded, is_known = [], True
    except InvalidInput:
        loaded, is_known = [], False
    names = [one.name for one in loaded]
    found, problems = running(Path(), names, SystemWallClock(), cache(deployment_backend))
    lost = InvalidInput("the live state of an application cannot be read", *problems) if problems else None
    if output == "json":
        say_json(
            [
                {
                    "application": one.application,
                    "has_spec": one.has_spec or (False if is_known else None),
                    "answers": one.answers,
                    "up_s": one.up_s,
                    "spent_usd": round(one.spent_usd, 6),
                    **as_numbers(one.machine),
                }
                for one in found
            ]
        )
        _raise(lost)
        return
    if not found:
        say("nothing else runs" if problems else "nothing runs")
        _raise(lost)
        return
    gone = [one.application for one in found if is_known and not one.has_spec]
    following = [next_command("down", name) for name in gone] or [next_command("status")]
    rows = [("application", "machine", "instance", "infra", "record", "nodes", "up", "price", "spent")]
    for one in found:
        machine = one.machine.machine
        rows.append(
            (
                one.application + ("\u00a0(no\u00a0spec)" if one.application in gone else ""),
                one.machine.name,
                machine.instance,
                machine.infra,
                one.machine.state,
                one.answers,
                shown_duration(rounded(one.up_s, 2)).replace(" ", "\u00a0"),
                shown_price(machine.price),
                dollars(one.spent_usd),
            )
        )
    say(*table(rows, columns(), indent=0))
    say_next(*following)
    if not is_known:
        note("not all specs can be read, so that it is not known which have none: fogspec validate")
    _raise(lost)


def _raise(lost: FogspecError | None) -> None:
    if lost is not None:
        raise lost
