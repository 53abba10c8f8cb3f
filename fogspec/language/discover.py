"""Find the spec files that a command line names: files, directories and patterns."""

import glob
import os
import re
from collections.abc import Sequence
from pathlib import Path

from fogspec.base.diagnostics import Diagnostic, DiagnosticError
from fogspec.base.errors import InvalidInput, UsageError
from fogspec.base.yaml.positions import plain
from fogspec.language.documents import Reading
from fogspec.language.loader import LoadedSpec, check_file, read_nodes
from fogspec.language.lockfile import some
from fogspec.language.overlays import spec_files
from fogspec.language.suggest import did_you_mean
from fogspec.language.tree import specs_in


class NoSpecs(InvalidInput):
    """There is no spec where one is looked for: it may have been removed."""


NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")


def find_specs(arguments: Sequence[str] = (), reading: Reading | None = None) -> list[str]:
    """Return the files named, those in directories (`*.yaml`, `*.yml`, at any depth), and those that patterns match, each once.

    A bare word that is not a file is the name of an application in specs/, in an environment too. Without arguments, return
    those in specs/. In a directory, hidden files, files that do not mention fogspec, and files that fogspec wrote are left
    out. Raise InvalidInput if an argument leads to nothing. `reading` is what was read before.
    """
    return list(_found(arguments, Reading() if reading is None else reading))


def check_specs(
    arguments: Sequence[str] = (), reading: Reading | None = None
) -> tuple[list[LoadedSpec], list[Diagnostic]]:
    """Return the valid applications that arguments lead to, in all of their environments, and all errors and warnings.

    `NAME@ENVIRONMENT` leads to that one alone. `reading` is what was read before. Raise the errors of `find_specs`.
    """
    known = Reading() if reading is None else reading
    found = _found(arguments, known)
    loaded, wrong = check_file(list(found), known)
    return [one for one in loaded if (only := found[os.path.normpath(one.path)]) is None or one.name in only], wrong


def load_specs(arguments: Sequence[str] = ()) -> list[LoadedSpec]:
    """Return what `check_specs` does; raise DiagnosticError with every error in any of the files."""
    loaded, wrong = check_specs(arguments)
    if any(one.severity == "error" for one in wrong):
        raise DiagnosticError(wrong)
    return loaded


def _found(arguments: Sequence[str], reading: Reading) -> dict[str, set[str] | None]:
    """Return the files by path, each with the names of the applications in environments that alone are meant; None for all."""
    if not arguments and not os.path.isdir("specs"):
        raise NoSpecs(
            "there is no directory specs/ here",
            "name files, directories or patterns, or write a first spec: fogspec init",
        )
    found: dict[str, set[str] | None] = {}
    for argument in arguments or ("specs",):
        only = {argument} if "@" in argument and is_name(argument) else None
        if os.path.isdir(argument):
            here = spec_files(argument, reading)
            nothing = "has no spec"
        elif glob.has_magic(argument) and not os.path.lexists(argument):
            here = sorted(path for path in glob.glob(argument, recursive=True) if os.path.isfile(path))
            nothing = "matches no file"
        else:
            here, nothing = [named_spec(argument, reading)], ""
        if not here:
            raise NoSpecs(f"{argument} {nothing}", "name a file, a directory or a pattern, such as specs/*.yaml")
        for path in map(os.path.normpath, here):
            before = found.get(path, set())
            found[path] = None if only is None or before is None else before | only
    return found


def is_name(argument: str) -> bool:
    """Return whether an argument looks like the name of an application rather than a path."""
    return not (os.path.lexists(argument) or "/" in argument or argument.endswith((".yaml", ".yml")))


def spec_of(name: str, reading: Reading) -> str | None:
    """Return the spec in specs/ with an application of this name; None if there is none or it is not a name."""
    if not is_name(name) or not os.path.isdir("specs"):
        return None
    if (found := _spec_among(name, spec_files("specs", reading), reading)) is not None:
        return found
    guess = os.path.join("specs", f"{name.partition('@')[0]}.yaml")
    if not os.path.exists(guess) or ("@" in name and not _is_wrong(guess, reading)):
        return None
    return guess  # its error hides its name: loading it reports the error


def spec_below(root: Path, name: str, reading: Reading) -> str | None:
    """Return the spec with an application of this name in the `specs/` of a project, or beside that; None if there is none."""
    folder = root / "specs"
    found = _spec_among(name, spec_files(str(folder), reading), reading) if folder.is_dir() else None
    return found or _spec_among(name, [os.path.join(root, one) for one in specs_in(root)], reading)


def _spec_among(name: str, paths: Sequence[str], reading: Reading) -> str | None:
    """Return the first of the files that has an application of this name; one that is called so is opened first."""
    likely = f"{name.partition('@')[0]}.yaml"
    ordered = sorted(paths, key=lambda path: os.path.basename(path) != likely)
    return next((path for path in ordered if name in _names_in(path, reading)), None)


def _is_wrong(path: str, reading: Reading) -> bool:
    return any(one.severity == "error" for one in check_file([path], reading)[1])


def named_spec(argument: str, reading: Reading | None = None) -> str:
    """Return the spec that an argument of the command line means: a path, or the spec of an application in specs/.

    Raise UsageError for a name that no application in specs/ has.
    """
    known = Reading() if reading is None else reading
    path = spec_of(argument, known)
    if path is not None or not is_name(argument):
        return path or argument
    if not os.path.isdir("specs"):
        raise UsageError(f"there is no file {argument}, and no directory specs/ here", "run fogspec where specs/ is")
    names = applications(known)
    near = did_you_mean(argument, names) or ([f"it has {some(names)}"] if names else [])
    raise UsageError(f"specs/ has no application named {argument}", *near)


def applications(reading: Reading | None = None) -> list[str]:
    """Return the names of the applications in specs/, sorted, also those in environments and of invalid specs."""
    known = Reading() if reading is None else reading
    paths = spec_files("specs", known) if os.path.isdir("specs") else []
    return sorted({name for path in paths for name in _names_in(path, known)})


def _names_in(path: str, reading: Reading) -> set[str]:
    """Return the names of the applications of a spec, also of an invalid one that is YAML."""
    loaded, wrong = check_file([path], reading)
    names = {one.name for one in loaded}
    if not any(one.severity == "error" for one in wrong):
        return names
    try:
        written = [plain(node) for node in read_nodes(path, reading.content(path))[0]]
    except (DiagnosticError, OSError):
        return names
    metadata = [one.get("metadata") for one in written if isinstance(one, dict)]
    found = {one["name"] for one in metadata if isinstance(one, dict) and isinstance(one.get("name"), str)}
    return names | {name for name in found if NAME.fullmatch(name)}
