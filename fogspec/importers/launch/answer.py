"""The question to the sandboxed process that runs a launch file, and its answer, which is judged like any stranger's data."""

import os
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from fogspec.base import sandbox
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.files import read_bounded
from fogspec.base.yaml import reader
from fogspec.importers.launch.elsewhere import leave_out
from fogspec.importers.launch.found import MOST_BYTES, ROOTS, LaunchImport, Place, refuse
from fogspec.importers.launch.packages import Packages

DISTRO = "jazzy"  # that of a first spec
# What a file in no package may read beside it.
BESIDE = (".py", ".xml", ".yaml", ".yml", ".launch", ".json", ".urdf", ".xacro")
MOST_BESIDE = 500
READER = "fogspec.importers.launch.sandboxed.reading"
TRUST = "read the file; if you trust it, run it without a sandbox: fogspec init --from-launch … --trust-launch"
BY_HAND = "write the spec by hand: fogspec init without --from-launch"

Scalar = bool | int | float | str
Values = dict[str, Scalar | list[Scalar]]
Text = Annotated[str, Field(max_length=1 << 20)]
At = tuple[Text, int, int, int]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class Words(_Strict):
    """How launch starts a process."""

    allow_substs: bool = False
    autostart: bool = False
    prefix: Text | None = None
    respawn: bool = False
    respawn_delay: Text | None = None


class Started(_Strict):
    """A node, component, container or process."""

    package: Text | None = None
    executable: Text | None = None
    plugin: Text | None = None
    cmd: list[Text] | None = None
    name: Text | None = None
    namespace: Text | None = None
    parameters: Values = {}
    parameter_files: list[Text] = []
    remappings: dict[str, str] = {}
    arguments: list[Text] = []
    extra_arguments: Values = {}
    allow_substs: bool = False
    autostart: bool = False
    env: dict[str, str] = {}
    launch: Words = Words()
    composable_node_descriptions: list["Started"] = []
    place: At | None = None


class Answer(_Strict):
    """What the sandboxed process answers."""

    cloud: list[Started]
    robot: list[Started]
    said_cloud: bool
    constrained: bool
    constraints: dict[str, Scalar | None]
    objective: dict[str, Scalar | None]
    hardware: dict[str, Scalar | list[Text] | dict[str, list[Text]] | None]
    stop: dict[str, Scalar | None]
    probe: dict[str, Scalar]
    infra: list[Text]
    image: Text | None
    setup: list[Text]
    files: dict[Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]*[A-Za-z0-9_-]\.?[A-Za-z0-9_-]*$", max_length=200)], Text]
    defaults: dict[str, str]
    included: list[Text]
    notes: list[tuple[Text, int, int, int, Text]]
    failed: tuple[Text, At, Text | None] | None


def asked(found: LaunchImport, packages: Packages, arguments: dict[str, str], trusted: bool) -> None:
    """Have a sandboxed process run the launch file, and take over its answer; raise DiagnosticError if there is none."""
    path = found.path
    try:
        content = read_bounded(path, MOST_BYTES)
    except OSError as problem:
        raise refuse(f"the launch file cannot be read: {problem.strerror}", Place(path, 1)) from None
    text, wrong = reader.decode(content, path)
    if wrong:
        raise DiagnosticError(wrong)
    found.sources[path] = text.split("\n")
    whole = os.path.realpath(path)
    folders = {name: os.path.realpath(at) for name, at in packages.folders.items()}
    installed = [str(one) for one in packages.installed]
    question = {
        "file": whole, "arguments": arguments, "packages": folders, "installed": installed,
        "distro": DISTRO,
    }  # fmt: skip
    questions = [question | {"root": root} for root in ROOTS]
    readable = [*folders.values(), *(f"{one}/share" for one in installed), *_beside(Path(whole), bool(packages.own))]
    try:
        answer, *others = map(Answer.model_validate_json, sandbox.ask(READER, questions, readable, trusted=trusted))
    except sandbox.SandboxError as problem:
        fix = TRUST if "lacks" in str(problem) else BY_HAND
        raise refuse(f"the launch file is not read: {problem}", Place(path, 1), fix) from None
    except ValidationError:
        raise refuse("the launch file is not read: it forges its reader's answer", Place(path, 1), BY_HAND) from None
    leave_out(answer, others, whole)
    _take(found, answer, whole, readable)


def _beside(path: Path, in_package: bool) -> list[str]:
    """Return what a launch file may read because it is beside it: itself, and in no package, files of a few kinds."""
    if in_package:
        return [str(path)]
    some = (
        one for one in sorted(path.parent.iterdir()) if one.suffix in BESIDE and one.name[0] != "." and one.is_file()
    )
    return [str(path), *(str(one) for _, one in zip(range(MOST_BESIDE), some, strict=False))]


def _take(found: LaunchImport, answer: Answer, whole: str, readable: list[str]) -> None:
    """Take over an answer."""

    def place(at: At) -> Place:
        path = found.path if at[0] == whole else at[0]
        # A line is shown of files alone that the launch file could read.
        inside = any(at[0] == one or at[0].startswith(f"{one}/") for one in readable)
        if path not in found.sources and inside and os.path.realpath(at[0]) == at[0]:
            found.sources[path] = _lines(at[0])
        return Place(path, max(1, at[1]), max(1, at[2]), max(1, at[3]))

    if answer.failed is not None:
        why, at, fix = answer.failed
        raise refuse(why, place(at), fix)
    for file, line, column, width, message in answer.notes:
        found.note(place((file, line, column, width)), message)
    for name in ("cloud", "robot"):
        for started in getattr(answer, name):
            node = _plain(started)
            found.origins[id(node)] = place(started.place) if started.place else Place(found.path, 1)
            getattr(found, name).append(node)
    for name in answer.model_fields_set - {"cloud", "robot", "notes", "failed"}:
        setattr(found, name, getattr(answer, name))


def _plain(started: Started) -> dict[str, Any]:
    """Return a node as the spec has it."""
    return started.model_dump(exclude_unset=True, exclude={"place"})


def _lines(path: str) -> list[str]:
    try:
        return read_bounded(path, MOST_BYTES).decode("utf-8", "replace").split("\n")
    except OSError:
        return []
