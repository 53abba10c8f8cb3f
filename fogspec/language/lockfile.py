"""The lock: what a spec names that may change behind its name, pinned to digests, so that a compile is pure."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from glob import escape
from posixpath import normpath
from typing import Annotated, Literal

from pydantic import AfterValidator

from fogspec.base import digest
from fogspec.base.clouds import CLOUDS
from fogspec.base.quantities import Strict
from fogspec.language.named_files import sends_files
from fogspec.language.schema import Application, Spec

DIGEST = re.compile(r"sha256:[0-9a-f]{64}")
DOCKER_HUB = "docker.io"
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
IGNORED_AT_ROOT = ("/compiled", "/results")
BUILT = ("build", "install", "log")  # colcon makes them again in a workspace on the machine
# A login to a private registry, under SkyPilot's names (docs.skypilot.co, "Using Private Docker Registries").
REGISTRY_LOGIN = ("SKYPILOT_DOCKER_USERNAME", "SKYPILOT_DOCKER_PASSWORD", "SKYPILOT_DOCKER_SERVER")
USER_VARIABLES = frozenset(row.user_variable for row in CLOUDS.values() if row.user_variable)
# A person has to read these.
PUBLIC_LOGIN = frozenset({"SKYPILOT_DOCKER_USERNAME", "SKYPILOT_DOCKER_SERVER", *USER_VARIABLES})
PART = r"[a-z0-9]+(?:(?:\.|_{1,2}|-+)[a-z0-9]+)*"  # of a repository's name: OCI Distribution Specification 1.1


def _date(text: str) -> str:
    return text and date.fromisoformat(text).isoformat()


class CatalogPin(Strict):
    """The catalog's provenance; `origin` is what `--catalog` was given, relative to the project where it is a path."""

    origin: str
    source: str
    revision: str
    date: Annotated[str, AfterValidator(_date)]
    digest: str


class ImagePin(Strict):
    """A container image as the spec names it, and the digest that its registry gave for the name."""

    image: str
    digest: str


class Pins(Strict):
    """What may change behind its name, frozen for one application."""

    catalog: CatalogPin
    image: ImagePin | None = None


class SentFiles(Strict):
    """How many files are sent to the machine, and the digest over their paths and digests."""

    files: int
    digest: str


class Lock(Strict):
    """`kind: Lock`: `NAME.lock`, beside the spec of the application NAME."""

    apiVersion: Literal["fogspec.dev/v1alpha1"] = "fogspec.dev/v1alpha1"
    kind: Literal["Lock"] = "Lock"
    spec: Pins


@dataclass(frozen=True, slots=True)
class Image:
    """A container image's name taken apart, as docker reads it; `name` is it without tag and digest, as written."""

    name: str
    registry: str
    repository: str
    tag: str
    digest: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageUse:
    """What machines need of an image.

    Their CPUs are named as in spec.hardware.arch. `secrets` are those of the spec that tell how to log in, to the registry or
    to the container, whose user has to be root, or in `user_variable`, where that is one. The field `timeout` bounds the time
    until the nodes are ready, of which pulling the image is a part.
    """

    architectures: Sequence[str]
    secrets: Sequence[str] = ()
    user_variable: str | None = None
    timeout: str = ""
    timeout_s: float = math.inf


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


def differing(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return the names whose digests differ, or that only one of them has."""
    return sorted(name for name in before.keys() | now.keys() if before.get(name) != now.get(name))


def some(names: Sequence[str], most: int = 6) -> str:
    """Return the first names, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def ignored_patterns(application: Application, at_root: bool) -> tuple[str, ...]:
    """Return the patterns of files that are not sent; `at_root` tells that compiled files are next to the spec."""
    ros = application.spec.ros
    built = [f"/{normpath(ros.workspace)}/{name}" for name in BUILT] if ros is not None and ros.workspace else []
    library = [f"/{escape(normpath(application.spec.library))}"] if application.spec.library else []
    return (*IGNORED, *(IGNORED_AT_ROOT if at_root else ()), *built, *library)


def sent_files(application: Application, sent: Mapping[str, str]) -> SentFiles | None:
    """Return what a manifest says of the files that are `sent`; None if there are none."""
    if not sends_files(application.spec):
        return None
    return SentFiles(files=len(sent), digest=digest.of_value(dict(sent)))
