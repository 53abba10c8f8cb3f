"""`fogspec compile`: the plan and its tasks; once measured, models, menu and manifest."""

import json
from pathlib import Path

import click

from fogspec.base.errors import Infeasible, OutOfDate
from fogspec.cli.options import CATALOG, OUTPUT, POLICIES, PRIORS, SPECS, catalogs_for, library_from


@click.command()
@SPECS
@CATALOG
@PRIORS
@POLICIES
@OUTPUT
@click.option("--check", is_flag=True, help="write nothing; exit 3 when something differs from what would be written")
def command(
    specs: tuple[str, ...], catalog_path: str | None, priors: Path | None, policies: tuple[str, ...], output: str,
    check: bool,
) -> None:  # fmt: skip
    """Write all that can be derived now from SPECS, and say what is missing for the rest. SPECS are those in specs/."""
    from fogspec.compile.compiler import compile_application
    from fogspec.report import summary
    from fogspec.spec.discover import find_specs
    from fogspec.spec.loader import load
    from fogspec.spec.rules.policies import Policies

    loaded, rules = load(find_specs(specs)), Policies(policies)
    rules.require_specs(loaded)
    catalogs, library = catalogs_for(loaded, catalog_path), library_from(priors)
    compiled = [
        compile_application(one.application, one.path, catalog, library)
        for one, catalog in zip(loaded, catalogs, strict=True)
    ]
    changed = [path for one in compiled for path in (one.differing() if check else one.write())]
    if output == "json":
        click.echo(json.dumps([summary.facts(one) for one in compiled], indent=2, ensure_ascii=False))
    else:
        click.echo("\n\n".join(summary.summary(one) for one in compiled))
    if any(one.chosen is not None for one in compiled):
        from fogspec.compile.manifest import Manifest

        rules.require_manifests(loaded, Manifest)
    if check and changed:
        again = f"fogspec compile {' '.join(specs)}"
        raise OutOfDate(
            f"{len(changed)} files differ from what compile would write", *map(str, changed), f"write them: {again}"
        )
    if none := [one for one in compiled if one.chosen is not None and one.chosen.manifest is None]:
        names = ", ".join(one.layout.name for one in none)
        raise Infeasible(f"{names}: no machine meets the limits", *(f"see {one.layout.menu}" for one in none))
