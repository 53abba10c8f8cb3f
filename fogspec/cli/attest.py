"""Implement `fogspec attest`: write a verifiable statement of a manifest's provenance."""

from pathlib import Path

import click

from fogspec.base.console import say, say_text
from fogspec.cli.next_steps import next_command, say_next
from fogspec.cli.options import CATALOG, MANIFEST, open_manifest


@click.command()
@MANIFEST
@CATALOG
@click.option(
    "--key",
    type=click.Path(path_type=str),
    metavar="PEM",
    help="private key that signs the statement, as a DSSE envelope",
)
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE", help="output file  [default: stdout]")
def command(manifest: str, catalog_path: str | None, key: str | None, out: Path | None) -> None:
    """Write an in-toto Statement v1 with SLSA provenance v1 about the manifest and the files approved with it.

    MANIFEST is a file, or the name of an application: compiled/NAME/manifest.yaml.

    The chain behind the manifest is recomputed first: if it does not match, nothing is attested (exit 3).
    """
    from fogspec.audit import attest
    from fogspec.base.project_files import write_output

    opened = open_manifest(manifest, catalog_path)
    text = attest.text(attest.statement(opened))
    if key is not None:
        from fogspec.audit.sign import sign

        text = sign(text, key)
    if out is None:
        say_text(text, end="")
    else:
        write_output(out, text.encode())
        say(f"{out}: {'signed with ' + key if key else 'not signed'}")
        if key is not None:
            say_next(next_command("verify", opened.layout.manifest, "--attestation", out, "--key", "PUBLIC.pem"))
