"""Implement `fogspec-lab conformance`: a small application goes all the way on an engine, with a report for an issue."""

import shutil
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fogspec.base.console import ask, say, say_json
from fogspec.base.errors import CloudError, Interrupted, Refused, UsageError
from fogspec.base.project_files import write_output
from fogspec.base.text import shell_command
from fogspec.cli.options import CATALOG, OUTPUT, Dollars

if TYPE_CHECKING:
    from fogspec_lab.conformance import Offer, Outcome


@click.command()
@click.option(
    "--infra",
    default="local",
    metavar="PLACE",
    help="engine: cloud/region, kubernetes/CONTEXT, slurm/CLUSTER  [default: local]",
)
@click.option("--max", "max_usd", type=Dollars(), default="$2", help="most money that the run may cost  [default: $2]")
@click.option(
    "--machines", metavar="A,B", default="", help="two instance types  [default: the cheapest of 2 vCPUs, 4 GiB]"
)
@CATALOG
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default="conformance.md",
    help="report file, .md or .json  [default: conformance.md]",
)
@click.option("--yes", is_flag=True, help="skip the confirmation prompt")
@click.option("--dry-run", is_flag=True, help="show machines and price, and stop")
@OUTPUT
def command(
    infra: str,
    max_usd: float,
    machines: str,
    catalog_path: str | None,
    out: Path,
    yes: bool,
    dry_run: bool,
    output: str,
) -> None:
    """Prove fogspec on an engine: bench of two instance types, kill, resume, apply, update, down, nothing left.

    Runs in a temporary project, so any working directory will do, and writes a report without accounts, addresses and paths
    to attach to an issue. Costs money on a cloud, and asks first. Exits with 6 if a step fails; what was started is torn
    down.
    """
    from fogspec_lab.conformance import offer

    if out.suffix not in (".md", ".json"):
        raise UsageError(f"--out {out} is neither .md nor .json", "write --out conformance.md")
    names = [name.strip() for name in machines.split(",") if name.strip()]
    chosen = offer(infra, names, _located(catalog_path), max_usd)
    say(*chosen.lines(), err=True)
    chosen.check()
    if dry_run:
        return
    if not chosen.is_local and not yes:
        if not sys.stdin.isatty():
            raise Refused("confirmation required, and no terminal is attached", "pass --yes to approve this price")
        if not ask("start it?"):
            raise Refused("nothing was started")
    _exercise(chosen, out, output)


def _exercise(chosen: "Offer", out: Path, output: str) -> None:
    """Take the steps and write the report; raise CloudError if one fails, Interrupted on Ctrl-C."""
    from fogspec_lab.conformance import Exercise

    folder = Path(tempfile.mkdtemp(prefix="fogspec-conformance-"))
    find = shell_command("cd", str(folder)) + " && fogspec down conformance"
    if not chosen.is_local:
        say(f"its machines end by themselves; if this command is killed, end them at once: {find}", err=True)
    exercise = Exercise(chosen, folder, lambda text: say(text, err=True))
    outcome = exercise.outcome
    try:
        exercise.run()
    except KeyboardInterrupt:
        raise Interrupted("interrupted", *([f"something may still run: {find}"] if outcome.left else [])) from None
    finally:
        _write(outcome, out)
        if not outcome.left:
            shutil.rmtree(folder, ignore_errors=True)
    if output == "json":
        say_json(outcome.as_dict())
    else:
        say(f"report    {out}")
    if outcome.left:
        raise CloudError("something may still run", f"look at {out}, then: {find}")
    if not outcome.passed:
        failed = next(one for one in outcome.steps if one.state != "ok")
        raise CloudError(f"conformance on {outcome.infra} failed at {failed.name}: {failed.detail}", f"report: {out}")


def _located(origin: str | None) -> str | None:
    """Return where prices are, also from the temporary project."""
    return origin if origin in (None, "snapshot", "skypilot") else str(Path(str(origin)).absolute())


def _write(outcome: "Outcome", out: Path) -> None:
    import json

    text = json.dumps(outcome.as_dict(), indent=2) + "\n" if out.suffix == ".json" else outcome.as_markdown()
    write_output(out, text.encode())
