"""Implement `fogspec compile`: write the plan and its tasks; once measured, models, menu and manifest."""

import sys
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fogspec.base.console import ask, detail, is_quiet, note, say, say_json, say_text, timed
from fogspec.base.errors import FogspecError, InvalidInput, OutOfDate, Refused
from fogspec.base.text import count, restore_command, shell_command
from fogspec.cli.next_steps import after_compile, next_lines
from fogspec.cli.options import (
    CATALOG,
    OUTPUT,
    POLICIES,
    PRIORS,
    SPECS,
    load_inputs,
    raise_together,
    require_ready,
)

if TYPE_CHECKING:
    from fogspec.base.diagnostics import Diagnostic
    from fogspec.compile.artifacts import Artifacts
    from fogspec.compile.inputs import Inputs


@click.command()
@SPECS
@CATALOG
@PRIORS
@POLICIES
@OUTPUT
@click.option(
    "--partial",
    is_flag=True,
    help="write a manifest even if the plan is not measured completely; the manifest states it",
)
@click.option(
    "--prune",
    "prune_",
    is_flag=True,
    help="also remove files of applications without a spec; lists them, and asks first",
)
@click.option("--yes", is_flag=True, help="skip the confirmation prompt of --prune")
@click.option("--check", is_flag=True, help="write nothing; exit 3 if a file differs from what would be written")
def command(
    specs: tuple[str, ...],
    catalog_path: str | None,
    priors: Path | None,
    policies: tuple[str, ...],
    output: str,
    partial: bool,
    prune_: bool,
    yes: bool,
    check: bool,
) -> None:
    """Write all files that can be derived now, and report what is missing for the others.

    Each APP is a name or a spec, by default all in specs/.
    """
    from fogspec.base.diagnostics import DiagnosticError
    from fogspec.report import summary
    from fogspec.spec.rules.policies import Policies

    if prune_ and specs:
        raise click.UsageError("--prune is about all specs in specs/: name none")
    gone = prune_ and not _has_specs()
    inputs = [] if gone else load_inputs(specs, catalog_path, priors, audit=True)
    rules = Policies(policies)
    require_ready([one.spec for one in inputs])
    note(*dict.fromkeys(said for one in inputs for said in one.catalog_notes))
    rules.require_specs([one.spec for one in inputs])
    compiled, refused, damaged = _compiled(inputs, partial)
    with timed("comparing" if check else "writing"):
        changed = [path for one in compiled for path in (one.compare() if check else one.write())]
    detail(*(f"{path}: {'differs' if check else 'written'}" for path in changed))
    for path in () if check else (path for one in compiled for path in one.removed):
        note(f"{path}: removed: it no longer follows from its inputs")
    if output == "json":
        say_json([summary.as_dict(one) for one in compiled])
    elif compiled:
        following = [[] if check else next_lines([after_compile(one)]) for one in compiled]
        say_text(
            "\n\n".join(
                summary.result(one) if is_quiet() else summary.summary(one, lines)
                for one, lines in zip(compiled, following, strict=True)
            )
        )
    if damaged:
        say(*(f"error: {one.message}" for one in refused), err=True)
        raise DiagnosticError(damaged)
    if any(one.decision is not None for one in compiled):
        from fogspec.compile.manifest import Manifest

        on_disk = [one.inputs.on_disk if check else one.written() for one in compiled]
        known = {path: file for files in on_disk for path, file in files.items()}
        rules.require_manifests([one.spec for one in inputs], Manifest, known)
    if check and changed:
        again = shell_command("fogspec", "compile", *specs)
        stale = [f"{one.layout.manifest} is stale: it stays until there is a new one" for one in compiled if one.kept]
        kept = {path for one in compiled for path in one.kept}
        written = [path for path in changed if path not in kept]
        raise OutOfDate(
            f"{count(len(written), 'file')} would change: what compile writes now differs"
            if written
            else f"{count(len(kept), 'file')} cannot be written again yet",
            *map(str, written or changed),
            *stale,
            *([f"write them: {again}"] if written else []),
        )
    _check_timings(inputs, check)
    _check_lock(specs, inputs, check)
    if prune_:
        _prune({one.layout.root for one in inputs} or {Path()}, [one.layout.name for one in inputs], yes, check)
    raise_together([*refused, *(None if one.decision is None else one.decision.refusal for one in compiled)])


def _compiled(
    inputs: "Sequence[Inputs]", partial: bool
) -> "tuple[list[Artifacts], list[FogspecError], list[Diagnostic]]":
    """Compile each application; what one lacks, such as budget, is no reason to leave the others as they are."""
    from fogspec.base.diagnostics import DiagnosticError
    from fogspec.compile.compiler import compile_application

    compiled, refused, damaged = list["Artifacts"](), list[FogspecError](), list["Diagnostic"]()
    for one in inputs:
        try:
            with timed(f"{one.layout.name}: compiling"):
                compiled.append(compile_application(one, partial))
        except FogspecError as refusal:
            if not refusal.message.startswith(one.layout.name):
                refusal.message = f"{one.layout.name}: {refusal.message}"
            refused.append(refusal)
        except DiagnosticError as problems:
            damaged += problems.diagnostics
    return compiled, refused, damaged


def _check_timings(inputs: "Sequence[Inputs]", check: bool) -> None:
    """Say which raw timings are not as recorded; with `check` raise OutOfDate."""
    timings = [text for one in inputs for text in one.timings]
    if timings and check:
        restore = restore_command(inputs[0].layout.results.parent)
        raise OutOfDate("raw timings are not as recorded", *timings[:6], restore)
    if timings:
        say(f"{timings[0]}, so that ci, verify and apply refuse it", err=True)


def _check_lock(specs: Sequence[str], inputs: "Sequence[Inputs]", check: bool) -> None:
    """Say which files are not what the lock says; with `check` raise OutOfDate."""
    from fogspec.spec.lockfile import some

    if drifted := list(dict.fromkeys(name for one in inputs for name in one.drifted)):
        lock = shell_command("fogspec", "lock", *specs)
        if check:
            raise OutOfDate(f"{some(drifted)}: not what the lock says", lock)
        note(f"{some(drifted)}: not what the lock says, so that bench and apply refuse it: {lock}")


def _has_specs() -> bool:
    """Return whether there are specs in specs/: the last one may have been removed."""
    from fogspec.spec.discover import find_specs

    try:
        return bool(find_specs(()))
    except InvalidInput:
        return False


def _prune(roots: Collection[Path], names: Collection[str], yes: bool, check: bool) -> None:
    """List what fogspec wrote for applications without a spec, and remove it once that is confirmed."""
    from fogspec.deploy.housekeeping import leftovers, prune
    from fogspec.deploy.state import SystemWallClock

    left = [one for root in sorted(roots) for one in leftovers(root, names)]
    say(*(f"without a spec: {one.line}" for one in left), err=True)
    if not left:
        return
    if check:
        raise OutOfDate(
            f"{count(len(left), 'application')} without a spec", "remove what is left: fogspec compile --prune"
        )
    if not yes and not sys.stdin.isatty():
        raise Refused("confirmation required, and no terminal is attached", "pass --yes to remove these files")
    if not yes and not ask("remove these files?"):
        raise Refused("nothing was removed")
    for one in left:
        removed = list(prune(one, SystemWallClock()))
        say(f"{one.layout.name}: {count(len(removed), 'file')} removed", err=True)
