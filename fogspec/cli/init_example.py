"""Implement `fogspec init --example`: copy a spec with its results, so that nothing has to be measured."""

from pathlib import Path

from fogspec.base.console import say
from fogspec.base.errors import UsageError
from fogspec.base.templates import shipped
from fogspec.cli.next_steps import next_command, say_next

SUFFIX = "-recorded"


def examples() -> list[str]:
    """Return the names of the examples that come with fogspec, sorted."""
    return sorted(path.stem.removesuffix(SUFFIX) for path in shipped("specs").glob(f"*{SUFFIX}.yaml"))


def copy_example(name: str) -> None:
    """Write the spec of an example, its results and the schema below this directory; overwrite nothing.

    Raise UsageError for an unknown example and for a file that exists.
    """
    from fogspec.base.project_files import ProjectFiles
    from fogspec.cli.init import for_git
    from fogspec.spec.loader import load
    from fogspec.spec.suggest import did_you_mean

    name = name.removesuffix(SUFFIX)
    if name not in examples():
        hints = did_you_mean(name, examples()) or [f"examples: {', '.join(examples())}"]
        raise UsageError(f"there is no example {name}", *hints)
    spec = f"{name}{SUFFIX}.yaml"
    applications = [one.application.metadata.name for one in load([str(shipped("specs") / spec)])]
    copied = {Path("specs") / spec: shipped("specs") / spec}
    copied |= {Path("results") / f"{one}.yaml": shipped("results") / f"{one}.yaml" for one in applications}
    files = ProjectFiles(Path())
    if present := [str(path) for path in copied if files.exists(path)]:
        raise UsageError(f"{present[0]} exists", "run this in an empty directory")
    if not files.exists(Path("schemas/Application.json")):
        copied[Path("schemas/Application.json")] = shipped("schemas") / "Application.json"
    for path, source in copied.items():
        files.write(path, source.read_bytes())
        say(f"{path}: written")
    for_git(Path(), files)
    say("measured already; nothing is rented")
    say_next(next_command("menu", applications[0]))
