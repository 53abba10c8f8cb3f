"""Implement `fogspec-lab snapshot`: the catalog that ships with fogspec."""

import click

from fogspec_lab.generated import require_checkout


@click.command()
@click.option("--check", is_flag=True, help="write nothing; exit with 3 if a file would change")
def command(check: bool) -> int:
    """Write the bundled catalog into the checkout, from the data of the packages moto and apache-libcloud."""
    from fogspec_lab import snapshot

    require_checkout()
    return snapshot.main(check)
