"""The lock: what a spec names that may change behind its name, pinned to digests, so that a compile is pure."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from fogspec.base.quantities import Strict
from fogspec.spec.schema import Application, Node

DIGEST = re.compile(r"sha256:[0-9a-f]{64}")
DOCKER_HUB = "docker.io"
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
    """What one application's files are made with; `files` has a digest for each file or folder beside the spec."""

    catalog: CatalogPin
    image: ImagePin | None = None
    priors: PriorsPin | None = None
    files: dict[str, str] = Field({})


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
    before, _, digest = text.partition("@")
    name, tag = before, "latest"
    if ":" in before.rpartition("/")[2]:
        name, _, tag = before.rpartition(":")
    first, slash, rest = name.partition("/")
    registry, repository = (first, rest) if slash and re.search(r"[.:]|^localhost$", first) else (DOCKER_HUB, name)
    if registry == DOCKER_HUB and "/" not in repository:
        repository = f"library/{repository}"
    fits = re.fullmatch(rf"{PART}(?:/{PART})*", repository) and re.fullmatch(r"\w[\w.-]{0,127}", tag)
    if not fits or (digest and not DIGEST.fullmatch(digest)):
        raise ValueError(f"{text!r} is no name of a container image")
    return Image(name, registry, repository, tag, digest or None)


def image_named(application: Application) -> str | None:
    """Return the image that the spec names."""
    return application.spec.ros.image if application.spec.ros else None


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
    """Return what a measurement depends on outside the spec: the image's digest and that of each file next to the spec."""
    if pins is None:
        return {}
    image = image_named(pinned(application, pins))
    exact = {"image": image.partition("@")[2]} if image is not None and is_pinned(image) else {}
    return {**exact, **{name: pins.files[name] for name in sorted(pins.files)}}


def paths_named(application: Application) -> Iterator[str]:
    """Return every string of a spec that names a file next to it, and words of commands, which may name one."""
    yield from paths_deployed(application)
    workload = application.spec.benchmark.workload
    # The probe's bag is what a sample records, not what it reads.
    yield from filter(None, [workload.bag])
    if workload.node is not None:
        yield from _of_node(workload.node)


def paths_deployed(application: Application) -> Iterator[str]:
    """Return those of `paths_named` that a deployment needs, without what only a benchmark plays."""
    spec = application.spec
    if spec.ros is not None and spec.ros.workspace is not None:
        yield spec.ros.workspace
    for node in spec.cloud:
        yield from _of_node(node)


def files_needed(application: Application, measured: bool) -> Iterator[tuple[str, str]]:
    """Return what must exist next to the spec before a machine is started: the field and what it names.

    `measured` says whether requests are sent to it too.
    """
    spec, workload = application.spec, application.spec.benchmark.workload
    named = [("spec.ros.workspace", spec.ros.workspace if spec.ros else None)]
    nodes = [(f"spec.cloud[{number}]", node) for number, node in enumerate(spec.cloud)]
    if measured:
        named.append(("spec.benchmark.workload.bag", workload.bag))
        nodes += [("spec.benchmark.workload.node", workload.node)] if workload.node else []
    named += [(f"{field}.parameter_files", name) for field, node in nodes for name in node.parameter_files]
    return ((field, name) for field, name in named if name is not None)


def _of_node(node: Node) -> Iterator[str]:
    yield from node.parameter_files
    if node.cmd is not None:
        yield from (word for word in [*node.cmd, *node.arguments] if not word.startswith(("-", "/")))
