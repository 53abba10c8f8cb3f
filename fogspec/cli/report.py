"""Implement `fogspec report`: write a self-contained page about an application."""

from pathlib import Path

import click

from fogspec.base.console import say, say_text
from fogspec.base.errors import UsageError
from fogspec.base.text import shell_command
from fogspec.cli.next_steps import after_look, next_lines
from fogspec.cli.options import complete_application, load_named


@click.command()
@click.argument("what", metavar="APP", shell_complete=complete_application)
@click.option("--name", help="application, if the spec has several")
@click.option("--out", "to", metavar="FILE", help="output file, - for stdout  [default: compiled/NAME/report.html]")
def command(what: str, name: str | None, to: str | None) -> None:
    """Write the report of an application, one HTML page.

    APP is a name or a spec. The page has the interactive menu, spec, samples, models, costs and provenance. It needs no
    network.
    """
    from fogspec.base.project_files import write_output
    from fogspec.compile.compiler import compile_application
    from fogspec.report.html import page

    inputs = load_named(what, name)
    if to is not None and len(inputs) > 1:
        raise UsageError(f"{what} has {len(inputs)} applications, {to} holds one: choose with --name")
    for compiled in [compile_application(one) for one in inputs]:
        common = [compiled.inputs.source, "--name", compiled.layout.name]
        regenerate, menu = shell_command("fogspec", "report", *common), shell_command("fogspec", "menu", *common)
        content = page(compiled, regenerate, menu)
        if to == "-":
            say_text(content.decode(), end="")
        else:
            target = compiled.layout.page if to is None else Path(to)
            if to is None:
                compiled.layout.files.write(target, content)
            else:
                write_output(target, content)
            say(f"{target}: {len(content) / 1000:,.0f} kB", *next_lines([after_look(compiled)]))
