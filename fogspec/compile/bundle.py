"""A manifest as a person names it, with the spec that it was compiled from."""

import os
from dataclasses import dataclass
from pathlib import Path

from fogspec.base import digest
from fogspec.base.errors import InvalidInput
from fogspec.base.files import read_file
from fogspec.base.layout import Layout
from fogspec.compile.manifest import Manifest
from fogspec.plan.schema import TaskRef
from fogspec.spec.loader import LoadedSpec, load, read_document


@dataclass(frozen=True, slots=True)
class ManifestBundle:
    """A manifest on disk, the digest of its bytes, and the application that it deploys."""

    manifest: Manifest
    digest: str
    layout: Layout
    loaded: LoadedSpec

    def edited(self) -> list[str]:
        """Files that the manifest names by digest and that are not as it says, each with what is wrong."""
        return [
            wrong
            for reference in references(self.manifest)
            if (wrong := _difference(self.layout.compiled / reference.path, reference)) is not None
        ]


def open_bundle(path: str | os.PathLike[str]) -> ManifestBundle:
    """The manifest at `compiled/NAME/manifest.yaml` and its spec.

    Raises DiagnosticError for a file that is damaged or a spec that is wrong, InvalidInput for one that is not there or stands
    elsewhere, so that what it names by relative path cannot be found.
    """
    at = Path(path)
    if not at.is_file():
        raise InvalidInput(
            f"{at}: there is no such manifest", "fogspec status says what is missing before there is one"
        )
    manifest = read_document(at, Manifest)
    name = manifest.metadata.name
    whole = Path(os.path.abspath(at))
    root = whole.parents[min(2, len(whole.parents) - 1)]
    root = root if at.is_absolute() else Path(os.path.relpath(root))
    spec = root / manifest.provenance.application.path
    layout = Layout.of(spec, name)
    if os.path.abspath(layout.manifest) != str(whole):
        raise InvalidInput(
            f"{at}: the manifest of {name} must stand at {layout.manifest}, beside what it names",
            f"make it there: fogspec compile {spec}",
        )
    found = next((one for one in load([spec]) if one.application.metadata.name == name), None)
    if found is None:
        raise InvalidInput(f"{spec} has no application named {name}, which {at} deploys")
    return ManifestBundle(manifest, digest.of_bytes(at.read_bytes()), layout, found)


def references(manifest: Manifest) -> list[TaskRef]:
    """Every file that is approved with the manifest."""
    spec = manifest.spec
    robot = [] if spec.robot_launch is None else [spec.robot_launch]
    return [spec.task, *(one.task for one in spec.fallbacks), *robot, *spec.files]


def _difference(path: Path, reference: TaskRef) -> str | None:
    try:
        content = read_file(path)
    except FileNotFoundError:
        return f"{path} is missing"
    except OSError as problem:
        return f"{path} cannot be read: {problem.strerror}"
    if digest.of_bytes(content) != reference.digest:
        return f"{path} is not what the manifest says: what is reviewed is what runs"
    return None
