"""Implement `fogspec init --example`: copy a spec with its results, so that nothing has to be measured."""

from pathlib import Path

from fogspec.base.console import say
from fogspec.base.errors import UsageError
from fogspec.base.templates import shipped

SUFFIX = "-recorded"


def examples() -> list[str]:
    """Return the names of the examples that come with fogspec, sorted."""
    return sorted(path.stem.removesuffix(SUFFIX) for path in shipped("specs").glob(f"*{SUFFIX}.yaml"))


def copy_example(name: str) -> str:
    """Write the spec of an example, its results and the schema below this directory, all under its name; overwrite nothing.

    Return the name of its first application. Raise UsageError for an unknown example and for a file that exists.
    """
    from fogspec.base.project_files import ProjectFiles
    from fogspec.language.loader import load
    from fogspec.language.suggest import did_you_mean

    if name not in examples():
        hints = did_you_mean(name, examples()) or [f"examples: {', '.join(examples())}"]
        raise UsageError(f"there is no example {name}", *hints)
    source = shipped("specs") / f"{name}{SUFFIX}.yaml"
    recorded = [one.application.metadata.name for one in load([str(source)])]
    applications = [one.removesuffix(SUFFIX) for one in recorded]
    content = source.read_bytes()
    for one, short in zip(recorded, applications, strict=True):
        content = content.replace(f"  name: {one}".encode(), f"  name: {short}".encode())
    copied = {Path("specs") / f"{name}.yaml": content}
    for one, short in zip(recorded, applications, strict=True):
        found = sorted((shipped("results") / one).glob("*.yaml"))
        copied |= {Path("results") / short / path.name: path.read_bytes() for path in found}
    files = ProjectFiles(Path())
    if present := [str(path) for path in copied if files.exists(path)]:
        raise UsageError(f"{present[0]} exists", "run this in an empty directory")
    if not files.exists(Path("schemas/Application.json")):
        copied[Path("schemas/Application.json")] = (shipped("schemas") / "Application.json").read_bytes()
    for path, content in copied.items():
        files.write(path, content)
    for path in dict.fromkeys(path.parent if path.parent.name in applications else path for path in copied):
        say(f"{path}: written")
    return applications[0]
