"""Implement `fogspec-lab paper`: the paper's tables and charts, beside those of the code that ships."""

import click

from fogspec_lab.generated import require_checkout


@click.command()
@click.option("--check", is_flag=True, help="write nothing; exit with 3 if a file would change")
def command(check: bool) -> int:
    """Print the paper's tables beside ours, and write the page and the charts of both into the checkout."""
    from fogspec_lab.paper import page

    require_checkout()
    return page.main(check)
