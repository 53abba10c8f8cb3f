"""Implement `fogspec init`: write a commented, valid spec, from a ROS 2 launch file if one is given."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fogspec.base.console import say
from fogspec.base.errors import UsageError
from fogspec.cli.next_steps import next_command, say_next

if TYPE_CHECKING:
    from fogspec.base.project_files import ProjectFiles
    from fogspec.importers.launch.found import LaunchImport

MOST_DEFAULTS = 20
# What git should know of a project, by file.
FOR_GIT = {
    ".gitignore": ".fogspec/\n",
    # Digests are of bytes: git is to convert no line ends, whatever its user's core.autocrlf.
    ".gitattributes": "specs/** -text\nresults/** -text\ncompiled/** -text linguist-generated -merge\n"
    "compiled/**/*.svg -diff\ncompiled/agent.pyz -diff\n"
    "results/*.yaml merge=fogspec-results\n",
}


@click.command()
@click.argument("spec", required=False, type=click.Path(path_type=Path))
@click.argument("arguments", nargs=-1, metavar="[NAME:=VALUE]...")
@click.option(
    "--from-launch",
    "launch",
    type=click.Path(path_type=str),
    metavar="FILE",
    help="launch file (Python, XML or YAML) to read nodes from; it runs in a sandbox that can read only files of packages",
)
@click.option(
    "--trust-launch", "trusted", is_flag=True, help="run the launch file also where this machine has no sandbox for it"
)
@click.option(
    "--package-path",
    "package_paths",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    multiple=True,
    metavar="DIRECTORY",
    help="directory with packages of included launch files: a workspace or an installed prefix; repeatable",
)
@click.option(
    "--from-graph", "graph", is_flag=True, help="read nodes and topics from the running robot, without changing it"
)
@click.option("--watch", default="20s", show_default=True, metavar="20s", help="time to watch the robot")
@click.option("--record", metavar="30s", help="then record requests for this time, as the workload")
@click.option(
    "--observed",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="output of `agent.pyz watch --out FILE` on the robot, in place of watching",
)
@click.option("--name", help="application name  [default: file name]")
@click.option(
    "--example",
    metavar="NAME",
    help="example to copy with its results: grasp-planning, motion-planning or vslam; nothing is rented",
)
def command(
    spec: Path | None,
    arguments: tuple[str, ...],
    launch: str | None,
    package_paths: tuple[Path, ...],
    trusted: bool,
    graph: bool,
    watch: str,
    record: str | None,
    observed: Path | None,
    name: str | None,
    example: str | None,
) -> None:
    """Write SPEC, a file or a name for specs/NAME/NAME.yaml, and the schema for the editor. Nothing is overwritten.

    NAME:=VALUE are launch arguments for --from-launch, as `ros2 launch` takes them.
    """
    from fogspec.base.layout import Layout
    from fogspec.base.project_files import ProjectFiles, write_output
    from fogspec.base.templates import shipped
    from fogspec.cli.init_graph import check_options, from_graph
    from fogspec.importers.launch import read_launch
    from fogspec.importers.scaffold import first_data, first_text, name_from, workspace_of
    from fogspec.language.discover import is_name
    from fogspec.language.loader import check_file
    from fogspec.report.diagnostics import show_diagnostics

    if example is not None:
        from fogspec.cli.init_example import copy_example

        if spec or launch or graph or observed or name:
            raise UsageError("--example goes with no other argument of init", f"fogspec init --example {example}")
        first = copy_example(example)
        for_git(Path(), ProjectFiles(Path()))
        say("measured already; nothing is rented")
        say_next(next_command("menu", first))
        return
    if spec and ":=" in str(spec):
        spec, arguments = None, (str(spec), *arguments)
    given = _launch_arguments(arguments, launch)
    if spec and is_name(str(spec)) and not spec.suffix:
        name, spec = name or str(spec), None  # `init mybot` means specs/mybot/mybot.yaml: it shares files with no other
    check_options(launch, graph, record, observed)
    found = read_launch(launch, given, package_paths, trusted=trusted) if launch else None
    name = name or name_from((spec and spec.name) or (launch and os.path.basename(launch)) or Path.cwd().name)
    spec = spec or Path("specs") / name / f"{name}.yaml"
    if spec.exists():
        raise UsageError(f"{spec} is there already", "name another file, or remove it")
    root = Layout.of(spec, name).root
    schema, files = root / "schemas" / "Application.json", ProjectFiles(root)
    data, notes = None, _notes(launch, given, found)
    workspace, copied = workspace_of(found.folders if found else [], spec.parent)
    notes += copied
    if graph or observed:
        data, notes = from_graph(name, spec.parent, files, watch, record, observed)
    text = first_text(
        _with_files(data or first_data(name, found, workspace), spec.parent, found),
        Path(os.path.relpath(schema, spec.parent)).as_posix(),
        notes,
        found,
    )
    written = {spec.parent / f"{name}.params" / one: content for one, content in (found.files if found else {}).items()}
    for path in written:
        if files.exists(path):
            raise UsageError(f"{path} is there already", "name another application with --name, or remove it")
    if not files.exists(schema):
        files.write(schema, (shipped("schemas") / "Application.json").read_bytes())
        say(f"{schema}: the language for your editor")
    for_git(root, files)
    for path, content in written.items():
        files.write(path, content.encode())
        say(f"{path}: the parameter file that the launch file makes of its own")
    write_output(spec, text.encode())
    todo = "read what it says" if data else "name your topics under probe"
    say(f"{spec}: written; {todo}")
    show_diagnostics(found.notes if found else [])
    wrong = [one for one in check_file([spec])[1] if one.severity == "error"]
    if wrong:
        show_diagnostics(wrong)
        raise click.exceptions.Exit(1)
    say_next(next_command("validate", spec))


def _with_files(data: dict[str, Any], folder: Path, found: "LaunchImport | None") -> dict[str, Any]:
    """Return the values of a first spec, with its files listed if other specs are in the folder."""
    from fogspec.importers.scaffold import first_text
    from fogspec.language.files_there import files_used
    from fogspec.language.loader import check_text
    from fogspec.language.tree import has_spec

    loaded = check_text(first_text(data, "", [], found).encode(), "spec")[0] if has_spec(folder) else []
    if not loaded:
        return data
    return {**data, "spec": {**data["spec"], "files": files_used(loaded[0].application.spec, folder)}}


def for_git(root: Path, files: "ProjectFiles") -> None:
    """Write what git should know of a project, where it has no such files yet."""
    if not (root / ".git").exists():
        return
    for name, text in FOR_GIT.items():
        path = root / name
        if not files.exists(path):
            files.write(path, text.encode())
            say(
                f"{path}: live state is ignored"
                if name == ".gitignore"
                else f"{path}: what compile writes is generated"
            )
            continue
        has = files.head(path, 1 << 20).decode("utf-8", "replace").splitlines()
        if lacking := [one for one in text.splitlines() if one not in has]:
            say(f"{path}: is there already, and lacks: {'; '.join(lacking)}")


def _launch_arguments(arguments: tuple[str, ...], launch: str | None) -> dict[str, str]:
    """Return launch arguments by name; raise UsageError for what is none."""
    if arguments and launch is None:
        raise UsageError(
            f"{arguments[0]} is a launch argument, and there is no --from-launch", "add --from-launch FILE"
        )
    for one in arguments:
        if ":=" not in one or one.startswith(":="):
            raise UsageError(f"{one} is not a launch argument", "write NAME:=VALUE")
    return dict(one.split(":=", 1) for one in arguments)


def _notes(launch: str | None, given: dict[str, str], found: "LaunchImport | None") -> list[str]:
    """Return what stands at the top of the spec: where it comes from, and what was decided for it."""
    if launch is None or found is None:
        return []
    notes = [f"From {os.path.basename(launch)}, which ran in a sandbox, with stand-ins for launch."]
    if given:
        notes.append("Launch arguments: " + " ".join(f"{key}:={value}" for key, value in given.items()))
    if found.defaults:
        some = [f"{key}:={value}" for key, value in found.defaults.items()]
        notes += ["Launch arguments at their defaults:", *(f"  {one}" for one in some[:MOST_DEFAULTS])]
        if len(some) > MOST_DEFAULTS:
            notes.append(f"  and {len(some) - MOST_DEFAULTS} more")
    if found.reasons:
        notes.append(
            "Which nodes stay on the robot is a suggestion, with its reason above each: move them as you like."
        )
    elif not found.said_cloud:
        notes.append(
            "The launch file says nothing of a cloud: all nodes are under cloud; move those that stay to robot."
        )
    return notes
