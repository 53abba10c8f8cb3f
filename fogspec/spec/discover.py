"""Find the spec files that a command line names: files, directories and patterns."""

import glob
import os
import re
from collections.abc import Sequence

from fogspec.base.diagnostics import Diagnostic, DiagnosticError
from fogspec.base.errors import InvalidInput, UsageError
from fogspec.base.yaml.positions import plain
from fogspec.spec.loader import LoadedSpec, check_file, read_nodes
from fogspec.spec.lockfile import some
from fogspec.spec.overlays import spec_files
from fogspec.spec.suggest import did_you_mean


class NoSpecs(InvalidInput):
    """There is no spec where one is looked for: it may have been removed."""


NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")


def find_specs(arguments: Sequence[str] = ()) -> list[str]:
    """Return the files named, those in directories (`*.yaml`, `*.yml`, at any depth), and those that patterns match, each once.

    A bare word that is not a file is the name of an application in specs/, in an environment too. Without arguments, return
    those in specs/. In a directory, hidden files, files that do not mention fogspec, and files that fogspec wrote are left
    out. Raise InvalidInput if an argument leads to nothing.
    """
    return list(_found(arguments))


def check_specs(
    arguments: Sequence[str] = (), overlays: Sequence[str] = ()
) -> tuple[list[LoadedSpec], list[Diagnostic]]:
    """Return the valid applications that arguments lead to, in all of their environments, and all errors and warnings.

    `NAME@ENVIRONMENT` leads to that one alone. Raise the errors of `find_specs`.
    """
    found = _found(arguments)
    loaded, wrong = check_file(list(found), overlays)
    return [one for one in loaded if (only := found[os.path.normpath(one.path)]) is None or one.name in only], wrong


def load_specs(arguments: Sequence[str] = (), overlays: Sequence[str] = ()) -> list[LoadedSpec]:
    """Return what `check_specs` does; raise DiagnosticError with every error in any of the files."""
    loaded, wrong = check_specs(arguments, overlays)
    if any(one.severity == "error" for one in wrong):
        raise DiagnosticError(wrong)
    return loaded


def _found(arguments: Sequence[str]) -> dict[str, set[str] | None]:
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
            here = spec_files(argument)
            nothing = "has no spec"
        elif glob.has_magic(argument) and not os.path.lexists(argument):
            here = sorted(path for path in glob.glob(argument, recursive=True) if os.path.isfile(path))
            nothing = "matches no file"
        else:
            here, nothing = [named_spec(argument)], ""
        if not here:
            raise NoSpecs(f"{argument} {nothing}", "name a file, a directory or a pattern, such as specs/*.yaml")
        for path in map(os.path.normpath, here):
            before = found.get(path, set())
            found[path] = None if only is None or before is None else before | only
    return found


def is_name(argument: str) -> bool:
    """Return whether an argument looks like the name of an application rather than a path."""
    return not (os.path.lexists(argument) or "/" in argument or argument.endswith((".yaml", ".yml")))


def spec_of(name: str) -> str | None:
    """Return the spec in specs/ with an application of this name; None if there is none or it is not a name."""
    if not is_name(name) or not os.path.isdir("specs"):
        return None
    guess = os.path.join("specs", f"{name.partition('@')[0]}.yaml")
    for path in sorted(spec_files("specs"), key=lambda path: path != guess):
        if name in _names_in(path):
            return path
    if not os.path.exists(guess) or ("@" in name and not _is_wrong(guess)):
        return None
    return guess  # its error hides its name: loading it reports the error


def _is_wrong(path: str) -> bool:
    return any(one.severity == "error" for one in check_file([path])[1])


def named_spec(argument: str) -> str:
    """Return the spec that an argument of the command line means: a path, or the spec of an application in specs/.

    Raise UsageError for a name that no application in specs/ has.
    """
    path = spec_of(argument)
    if path is not None or not is_name(argument):
        return path or argument
    if not os.path.isdir("specs"):
        raise UsageError(f"there is no file {argument}, and no directory specs/ here", "run fogspec where specs/ is")
    known = applications()
    near = did_you_mean(argument, known) or ([f"it has {some(known)}"] if known else [])
    raise UsageError(f"specs/ has no application named {argument}", *near)


def applications() -> list[str]:
    """Return the names of the applications in specs/, sorted, also those in environments and of invalid specs."""
    paths = spec_files("specs") if os.path.isdir("specs") else []
    return sorted({name for path in paths for name in _names_in(path)})


def _names_in(path: str) -> set[str]:
    """Return the names of the applications of a spec, also of an invalid one that is YAML."""
    loaded, wrong = check_file([path])
    names = {one.name for one in loaded}
    if not any(one.severity == "error" for one in wrong):
        return names
    try:
        written = [plain(node) for node in read_nodes(path)[0]]
    except (DiagnosticError, OSError):
        return names
    metadata = [one.get("metadata") for one in written if isinstance(one, dict)]
    found = {one["name"] for one in metadata if isinstance(one, dict) and isinstance(one.get("name"), str)}
    return names | {name for name in found if NAME.fullmatch(name)}
