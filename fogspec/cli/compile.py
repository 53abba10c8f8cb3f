"""Implement `fogspec compile`: write the plan and its tasks; once measured, models, menu and manifest."""

from pathlib import Path

import click

from fogspec.base.console import say, say_json, say_text
from fogspec.base.errors import OutOfDate
from fogspec.base.text import count, shell_command
from fogspec.cli.options import (
    CATALOG,
    OUTPUT,
    POLICIES,
    PRIORS,
    SPECS,
    echo_notes,
    load_inputs,
    raise_together,
    require_ready,
)


@click.command()
@SPECS
@CATALOG
@PRIORS
@POLICIES
@OUTPUT
@click.option("--partial", is_flag=True, help="a manifest also where the plan was not carried out, which it says")
@click.option("--check", is_flag=True, help="write nothing; exit 3 when something differs from what would be written")
def command(
    specs: tuple[str, ...],
    catalog_path: str | None,
    priors: Path | None,
    policies: tuple[str, ...],
    output: str,
    partial: bool,
    check: bool,
) -> None:
    """Write all that can be derived now from SPECS, and say what is missing for the rest. SPECS are those in specs/."""
    from fogspec.compile.compiler import compile_application
    from fogspec.report import summary
    from fogspec.spec.discover import find_specs
    from fogspec.spec.lockfile import some
    from fogspec.spec.rules.policies import Policies

    inputs, rules = load_inputs(find_specs(specs), catalog_path, priors, audit=True), Policies(policies)
    require_ready([one.spec for one in inputs])
    echo_notes(note for one in inputs for note in one.catalog_notes)
    rules.require_specs([one.spec for one in inputs])
    compiled = [compile_application(one, partial) for one in inputs]
    changed = [path for one in compiled for path in (one.compare() if check else one.write())]
    for path in () if check else (path for one in compiled for path in one.removed):
        say(f"{path}: removed: it no longer follows from its inputs", err=True)
    if output == "json":
        say_json([summary.as_dict(one) for one in compiled])
    else:
        given = [*(["--catalog", catalog_path] if catalog_path else []), *(["--priors", str(priors)] if priors else [])]
        say_text("\n\n".join(summary.summary(one, given) for one in compiled))
    if any(one.decision is not None for one in compiled):
        from fogspec.compile.manifest import Manifest

        on_disk = [one.inputs.on_disk if check else one.written() for one in compiled]
        known = {path: file for files in on_disk for path, file in files.items()}
        rules.require_manifests([one.spec for one in inputs], Manifest, known)
    if check and changed:
        again = shell_command("fogspec", "compile", *specs)
        stale = [f"{one.layout.manifest} is stale: it stays until there is a new one" for one in compiled if one.kept]
        raise OutOfDate(
            f"{count(len(changed), 'file')} would change: what compile writes now differs",
            *map(str, changed),
            *(stale or [f"write them: {again}"]),
        )
    if drifted := list(dict.fromkeys(name for one in inputs for name in one.drifted)):
        lock = shell_command("fogspec", "lock", *specs)
        if check:
            raise OutOfDate(f"{some(drifted)}: not what the lock says", lock)
        say(f"{some(drifted)}: not what the lock says, so that bench and apply refuse it: {lock}", err=True)
    raise_together(None if one.decision is None else one.decision.refusal for one in compiled)
