"""Implement `fogspec init`: write a commented, valid spec, from a ROS 2 launch file if one is given."""

import os
from pathlib import Path

import click

from fogspec.base.console import say
from fogspec.base.errors import UsageError
from fogspec.base.text import shell_command


@click.command()
@click.argument("spec", required=False, type=click.Path(path_type=Path))
@click.option(
    "--from-launch",
    "launch",
    type=click.Path(path_type=str),
    metavar="FILE",
    help="read nodes and constraints from this Python, XML or YAML launch file; it is not run",
)
@click.option("--name", help="name of the application; that of the file unless said otherwise")
def command(spec: Path | None, launch: str | None, name: str | None) -> None:
    """Write SPEC, a file or a name for specs/NAME.yaml, and the schema for the editor. Nothing is overwritten."""
    from fogspec.base.project_files import ProjectFiles, write_output
    from fogspec.base.templates import shipped
    from fogspec.report.diagnostics import show_diagnostics
    from fogspec.spec.discover import is_name
    from fogspec.spec.launch_import import read_launch
    from fogspec.spec.loader import check_file
    from fogspec.spec.scaffold import first_data, first_text, name_from

    if spec and is_name(str(spec)) and not spec.suffix:
        name, spec = name or str(spec), Path("specs") / f"{spec}.yaml"  # `init mybot` means specs/mybot.yaml
    found = read_launch(launch) if launch else None
    name = name or name_from((spec and spec.name) or (launch and os.path.basename(launch)) or Path.cwd().name)
    spec = spec or Path("specs") / f"{name}.yaml"
    if spec.exists():
        raise UsageError(f"{spec} is there already", "name another file, or remove it")
    root = spec.parent.parent if spec.absolute().parent.name == "specs" else spec.parent
    schema, files = root / "schemas" / "Application.json", ProjectFiles(root)
    notes = [f"From {os.path.basename(launch)}, which was read and not run."] if launch else []
    if found and not found.cloud:
        notes.append(
            "The launch file says nothing of a cloud: all nodes are under cloud; move those that stay to robot."
        )
    if not files.exists(schema):
        files.write(schema, (shipped("schemas") / "Application.json").read_bytes())
        say(f"{schema}: the language for your editor")
    text = first_text(first_data(name, found), Path(os.path.relpath(schema, spec.parent)).as_posix(), notes)
    write_output(spec, text.encode())
    say(f"{spec}: written; name your topics under probe, then: {shell_command('fogspec', 'validate', spec)}")
    show_diagnostics(found.notes if found else [])
    wrong = [one for one in check_file([spec])[1] if one.severity == "error"]
    if wrong:
        show_diagnostics(wrong)
        raise click.exceptions.Exit(1)
