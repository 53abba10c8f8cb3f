"""Implement `fogspec compile`: write the plan and its tasks; once measured, models, menu and manifest."""

from pathlib import Path

import click

from fogspec.base.console import say, say_json, say_text
from fogspec.base.errors import Infeasible, OutOfDate
from fogspec.base.text import shell_command
from fogspec.cli.options import CATALOG, OUTPUT, POLICIES, PRIORS, SPECS, echo_notes, load_inputs, require_named


@click.command()
@SPECS
@CATALOG
@PRIORS
@POLICIES
@OUTPUT
@click.option("--check", is_flag=True, help="write nothing; exit 3 when something differs from what would be written")
def command(
    specs: tuple[str, ...],
    catalog_path: str | None,
    priors: Path | None,
    policies: tuple[str, ...],
    output: str,
    check: bool,
) -> None:
    """Write all that can be derived now from SPECS, and say what is missing for the rest. SPECS are those in specs/."""
    from fogspec.compile.compiler import compile_application
    from fogspec.report import summary
    from fogspec.spec.discover import find_specs
    from fogspec.spec.lockfile import some
    from fogspec.spec.rules.policies import Policies

    inputs, rules = load_inputs(find_specs(specs), catalog_path, priors, audit=True), Policies(policies)
    require_named([one.spec for one in inputs])
    echo_notes(note for one in inputs for note in one.catalog_notes)
    rules.require_specs([one.spec for one in inputs])
    compiled = [compile_application(one) for one in inputs]
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
        raise OutOfDate(
            f"{len(changed)} files differ from what compile would write", *map(str, changed), f"write them: {again}"
        )
    if drifted := list(dict.fromkeys(name for one in inputs for name in one.drifted)):
        lock = shell_command("fogspec", "lock", *specs)
        if check:
            raise OutOfDate(f"{some(drifted)}: not what the lock says", lock)
        say(f"{some(drifted)}: not what the lock says, so that bench and apply refuse it: {lock}", err=True)
    if infeasible := [one for one in compiled if one.decision is not None and one.decision.manifest is None]:
        names = ", ".join(one.layout.name for one in infeasible)
        raise Infeasible(f"{names}: no machine meets the limits", *(f"see {one.layout.menu}" for one in infeasible))
