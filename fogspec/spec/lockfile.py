"""The lock: what a spec names that may change behind its name, pinned to digests, so that a compile is pure."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from posixpath import normpath
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from fogspec.base import digest
from fogspec.base.quantities import Strict
from fogspec.spec.launch_text import STARTS
from fogspec.spec.schema import Application, Node, Spec

DIGEST = re.compile(r"sha256:[0-9a-f]{64}")
DOCKER_HUB = "docker.io"
IMAGE = "image"  # the image's name among the pins of a measurement
# Not sent to machines, whatever the spec says: version control, live state, local secrets, caches.
IGNORED = (
    ".git",
    ".hg",
    ".svn",
    ".fogspec",
    ".skyignore",
    ".env",
    ".env.*",
    ".venv",
    ".venv-*",
    "__pycache__",
    "*.pyc",
    ".pytest_cache",
    ".mypy_cache",
    ".ruff_cache",
    ".DS_Store",
)
IGNORED_AT_ROOT = ("/compiled", "/results", "/fogspec.lock")
BUILT = ("build", "install", "log")  # colcon makes them again in a workspace on the machine
# A login to a private registry, under SkyPilot's names (docs.skypilot.co, "Using Private Docker Registries").
REGISTRY_LOGIN = ("SKYPILOT_DOCKER_USERNAME", "SKYPILOT_DOCKER_PASSWORD", "SKYPILOT_DOCKER_SERVER")
PART = r"[a-z0-9]+(?:(?:\.|_{1,2}|-+)[a-z0-9]+)*"  # of a repository's name: OCI Distribution Specification 1.1


def _date(text: str) -> str:
    return text and date.fromisoformat(text).isoformat()


class CatalogPin(Strict):
    """The catalog's provenance; `origin` is what `--catalog` was given, relative to the lock where it is a path."""

    origin: str
    source: str
    revision: str
    date: Annotated[str, AfterValidator(_date)]
    digest: str


class ImagePin(Strict):
    """A container image as the spec names it, and the digest that its registry gave for the name."""

    image: str
    digest: str


class PriorsPin(Strict):
    """The machine library that predictions are made with; `origin` is its path relative to the lock."""

    origin: str
    digest: str


class Pins(Strict):
    """What one application's files are made with; `files` has the digest of each file that is sent to machines."""

    catalog: CatalogPin
    image: ImagePin | None = None
    priors: PriorsPin | None = None
    files: dict[str, str] = Field({})


class SentFiles(Strict):
    """The files that are sent to the machine, from `folder`, except those that match a pattern of `ignored`.

    `digest` is over the paths and digests of all `files`, as `fogspec.lock` lists them; None without a lock.
    """

    folder: str
    files: int | None
    digest: str | None
    ignored: list[str]


class LockBody(Strict):
    """Pins by the application's name."""

    applications: dict[str, Pins]


class Lock(Strict):
    """`kind: Lock`: `fogspec.lock`, beside the folder of specs."""

    apiVersion: Literal["fogspec.dev/v1alpha1"] = "fogspec.dev/v1alpha1"
    kind: Literal["Lock"] = "Lock"
    spec: LockBody


@dataclass(frozen=True, slots=True)
class Image:
    """A container image's name taken apart, as docker reads it; `name` is it without tag and digest, as written."""

    name: str
    registry: str
    repository: str
    tag: str
    digest: str | None


def image_of(text: str) -> Image:
    """Parse an image reference: `ros:jazzy` is `docker.io/library/ros`, tag `jazzy`; raise ValueError if it is not one."""
    before, _, exact = text.partition("@")
    name, tag = before, "latest"
    if ":" in before.rpartition("/")[2]:
        name, _, tag = before.rpartition(":")
    first, slash, rest = name.partition("/")
    registry, repository = (first, rest) if slash and re.search(r"[.:]|^localhost$", first) else (DOCKER_HUB, name)
    if registry == DOCKER_HUB and "/" not in repository:
        repository = f"library/{repository}"
    fits = re.fullmatch(rf"{PART}(?:/{PART})*", repository) and re.fullmatch(r"\w[\w.-]{0,127}", tag)
    if not fits or (exact and not DIGEST.fullmatch(exact)):
        raise ValueError(f"{text!r} is not a name of a container image")
    return Image(name, registry, repository, tag, exact or None)


def image_named(application: Application) -> str | None:
    """Return the image that the spec names."""
    return application.spec.ros.image if application.spec.ros else None


def registry_login(spec: Spec) -> list[str]:
    """Return the secrets that are the login to the image's registry, and nothing for the nodes."""
    return [name for name in spec.secrets if name in REGISTRY_LOGIN]


def is_pinned(image: str) -> bool:
    """Return whether the image is named by its digest."""
    return bool(DIGEST.fullmatch(image.partition("@")[2]))


def pinned(application: Application, pins: Pins | None) -> Application:
    """Return the application with its image named by digest if the lock has one for it."""
    ros = application.spec.ros
    if ros is None or ros.image is None or is_pinned(ros.image):
        return application
    if pins is None or pins.image is None or pins.image.image != ros.image:
        return application
    exact = ros.model_copy(update={"image": f"{image_of(ros.image).name}@{pins.image.digest}"})
    return application.model_copy(update={"spec": application.spec.model_copy(update={"ros": exact})})


def pins_of_measurement(application: Application, pins: Pins | None) -> dict[str, str]:
    """Return what a measurement depends on outside the spec: the image's digest and that of each file that is sent."""
    if pins is None:
        return {}
    image = image_named(pinned(application, pins))
    exact = {IMAGE: image.partition("@")[2]} if image is not None and is_pinned(image) else {}
    files = pins.files if measurement_sends_files(application.spec) else {}
    return {**exact, **{f"./{name}" if name == IMAGE else name: files[name] for name in sorted(files)}}


def changed_pins(measured: Mapping[str, str] | None, now: Mapping[str, str]) -> list[str]:
    """Return the names pinned to something else since they were measured, files that are new or gone included.

    What was measured before anything was locked is not known to differ.
    """
    return differing(measured, now) if measured and now else []


def differing(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return the names whose digests differ, or that only one of them has."""
    return sorted(name for name in before.keys() | now.keys() if before.get(name) != now.get(name))


def some(names: Sequence[str], most: int = 6) -> str:
    """Return the first names, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def listed(names: Sequence[str], text: str, most: int) -> list[str]:
    """Return the text for each of the first names, and a line for those that are left."""
    left = len(names) - most
    return [*(text.format(name) for name in names[:most]), *([f"and {left} more files"] if left > 0 else [])]


def ignored_patterns(application: Application, at_root: bool) -> tuple[str, ...]:
    """Return the patterns of files that are not sent; `at_root` tells that compiled files are beside the spec."""
    ros = application.spec.ros
    built = [f"/{normpath(ros.workspace)}/{name}" for name in BUILT] if ros is not None and ros.workspace else []
    return (*IGNORED, *(IGNORED_AT_ROOT if at_root else ()), *built, *application.spec.ignore)


def sent_files(application: Application, folder: str, pins: Pins | None, at_root: bool) -> SentFiles | None:
    """Return what a manifest says of the files that are sent; None if there are none. `folder` is relative to it."""
    if not sends_files(application):
        return None
    files = None if pins is None else pins.files
    return SentFiles(
        folder=folder,
        files=None if files is None else len(files),
        digest=None if files is None else digest.of_value(files),
        ignored=list(ignored_patterns(application, at_root)),
    )


def sends_files(application: Application) -> bool:
    """Return whether a machine is sent the spec's directory."""
    return measurement_sends_files(application.spec) or application.spec.deployment.ready is not None


def measurement_sends_files(spec: Spec) -> bool:
    """Return whether anything that is measured is named relative to the spec."""
    workload = spec.benchmark.workload
    if workload.bag is not None or spec.probe.bag is not None:
        return True
    nodes = [*spec.cloud, *([workload.node] if workload.node else [])]
    workspace = spec.ros is not None and spec.ros.workspace is not None
    return workspace or any(node.cmd is not None or any(parameter_files(node)) for node in nodes)


def files_needed(application: Application, measured: bool) -> Iterator[tuple[str, str]]:
    """Return what is next to the spec and must be sent to a machine: the field and what it names.

    `measured` says whether requests are sent to it too.
    """
    spec = application.spec
    named = [("spec.ros.workspace", spec.ros.workspace if spec.ros else None)]
    if measured:
        named.append(("spec.benchmark.workload.bag", spec.benchmark.workload.bag))
    nodes = _nodes(application, measured)
    named += [(f"{field}.parameter_files", name) for field, node in nodes for name in parameter_files(node)]
    return ((field, name) for field, name in named if name is not None)


def parameter_files(node: Node) -> Iterator[str]:
    """Return the parameter files of a node and its components that are next to the spec; others are in packages there."""
    files = [
        *node.parameter_files,
        *(name for one in node.composable_node_descriptions for name in one.parameter_files),
    ]
    return (name for name in files if not name.startswith(STARTS))


def words_of_commands(application: Application, measured: bool) -> Iterator[tuple[str, str]]:
    """Return the words of commands that may name a file next to the spec, with their field."""
    for field, node in _nodes(application, measured):
        words = [*node.cmd, *node.arguments] if node.cmd is not None else []
        yield from ((f"{field}.cmd", word) for word in words if not word.startswith(("-", "/", *STARTS)))


def _nodes(application: Application, measured: bool) -> list[tuple[str, Node]]:
    nodes = [(f"spec.cloud[{number}]", node) for number, node in enumerate(application.spec.cloud)]
    client = application.spec.benchmark.workload.node
    return [*nodes, ("spec.benchmark.workload.node", client)] if measured and client is not None else nodes
