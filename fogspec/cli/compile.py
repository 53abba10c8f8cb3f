"""Implement `fogspec compile`: write the plan and its tasks; once measured, models, menu and manifest."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fogspec.base.console import ask, detail, is_quiet, is_verbose, note, say, say_json, say_text, timed
from fogspec.base.errors import FogspecError, InvalidInput, Refused
from fogspec.base.text import count
from fogspec.cli.next_steps import after_compile, next_lines
from fogspec.cli.options import (
    CATALOG,
    OUTPUT,
    POLICIES,
    SPECS,
    load_inputs,
    raise_together,
    require_ready,
)

if TYPE_CHECKING:
    from fogspec.base.diagnostics import Diagnostic
    from fogspec.base.layout import Layout
    from fogspec.compile.artifacts import Artifacts
    from fogspec.compile.inputs import Inputs


@click.command()
@SPECS
@CATALOG
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
def command(
    specs: tuple[str, ...],
    catalog_path: str | None,
    policies: tuple[str, ...],
    output: str,
    partial: bool,
    prune_: bool,
    yes: bool,
) -> None:
    """Write all files that can be derived now, and report what is missing for the others.

    Each APP is a name or a spec, by default all in specs/.
    """
    from fogspec.base.diagnostics import DiagnosticError
    from fogspec.catalog.table import each_in_its_unit
    from fogspec.compile.inputs import policies_read
    from fogspec.language.rules.policies import Policies
    from fogspec.report import summary

    if prune_ and specs:
        raise click.UsageError("--prune is about all specs in specs/: name none")
    gone = prune_ and not _has_specs()
    inputs = [] if gone else load_inputs(specs, catalog_path, audit=True)
    rules = Policies(policies, read=policies_read(inputs))
    require_ready([one.spec for one in inputs])
    note(*dict.fromkeys(said for one in inputs for said in one.catalog_notes))
    rules.require_specs([one.spec for one in inputs])
    compiled, refused, damaged = _compiled(inputs, partial)
    with timed("writing"):
        changed = [path for one in compiled for path in one.write()]
    detail(*(f"{path}: written" for path in changed))
    for path in (path for one in compiled for path in one.removed):
        note(f"{path}: removed: it no longer follows from its inputs")
    if output == "json":
        say_json([summary.as_dict(one) for one in compiled])
    elif compiled:
        say_text(
            "\n\n".join(
                summary.result(one)
                if is_quiet()
                else summary.summary(one, next_lines([after_compile(one)]), is_verbose())
                for one in compiled
            )
        )
    if damaged:
        say(*(f"error: {one.message}" for one in refused), err=True)
        raise DiagnosticError(damaged)
    if any(one.decision is not None for one in compiled):
        from fogspec.compile.manifest import Manifest

        known = {path: file for one in compiled for path, file in one.written().items()}
        rules.require_manifests([one.spec for one in inputs], Manifest, known)
    if timings := [text for one in compiled if one.results is not None for text in one.inputs.timings]:
        say(f"{timings[0]}, so that check and apply refuse it", err=True)
    if prune_:
        _prune([one.layout for one in inputs], yes)
    raise_together(
        [*refused, *(None if one.decision is None else one.decision.refusal for one in each_in_its_unit(compiled))]
    )


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


def _has_specs() -> bool:
    """Return whether there are specs in specs/: the last one may have been removed."""
    from fogspec.language.discover import find_specs

    try:
        return bool(find_specs(()))
    except InvalidInput:
        return False


def _prune(layouts: "Sequence[Layout]", yes: bool) -> None:
    """List what fogspec wrote for applications without a spec, and remove it once that is confirmed."""
    from fogspec.deploy.housekeeping import leftovers, prune
    from fogspec.deploy.state import SystemWallClock

    roots = sorted({one.root for one in layouts} or {Path()})
    left = [one for root in roots for one in leftovers(root, layouts)]
    say(*(f"without a spec: {one.line}" for one in left), err=True)
    if not left:
        return
    if not yes and not sys.stdin.isatty():
        raise Refused("confirmation required, and no terminal is attached", "pass --yes to remove these files")
    if not yes and not ask("remove these files?"):
        raise Refused("nothing was removed")
    for one in left:
        removed = list(prune(one, SystemWallClock()))
        say(f"{one.layout.name}: {count(len(removed), 'file')} removed", err=True)
