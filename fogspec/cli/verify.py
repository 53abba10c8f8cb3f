"""Implement `fogspec verify`: recompute the chain behind a manifest, byte for byte."""

import click

from fogspec.base.console import say_json, say_text
from fogspec.base.errors import OutOfDate
from fogspec.cli.next_steps import say_next, to_deploy
from fogspec.cli.options import CATALOG, MANIFEST, OUTPUT, POLICIES, check_policies, open_manifest


@click.command()
@MANIFEST
@CATALOG
@POLICIES
@OUTPUT
@click.option("--attestation", type=click.Path(path_type=str), metavar="FILE", help="signed statement to check, too")
@click.option("--key", type=click.Path(path_type=str), metavar="PEM", help="public key of that signature")
def command(
    manifest: str,
    catalog_path: str | None,
    policies: tuple[str, ...],
    output: str,
    attestation: str | None,
    key: str | None,
) -> None:
    """Recompute spec, plan, results, models, menu, manifest and task, and report which link does not match.

    MANIFEST is a file, or the name of an application: compiled/NAME/manifest.yaml.

    Nothing is written. Exit code 3 for a mismatch.
    """
    from fogspec.audit import verify

    if (attestation is None) != (key is None):
        raise click.UsageError("--attestation and --key go together")
    opened = open_manifest(manifest, catalog_path)
    links = verify.verify(opened)
    if attestation is not None and key is not None:
        from fogspec.audit.sign import check_signed

        links.append(check_signed(opened, attestation, key))
    if output == "json":
        say_json(verify.as_dict(opened, links))
    else:
        say_text(verify.as_text(opened, links))
    check_policies(policies, [opened.inputs])
    if output == "text" and not any(link.breaks for link in links):
        say_next(to_deploy(opened.inputs))
    if broken := [link for link in links if link.breaks]:
        raise OutOfDate(
            f"{opened.layout.manifest}: the chain breaks at {broken[0].name}", verify.remedy(opened, broken[0])
        )
