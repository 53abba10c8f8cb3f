"""Open a manifest with the inputs that it was compiled from."""

import os
from dataclasses import dataclass
from pathlib import Path

from fogspec.base import digest
from fogspec.base.errors import InvalidInput
from fogspec.base.layout import Layout
from fogspec.base.project_files import ProjectFiles
from fogspec.compile.inputs import Inputs
from fogspec.compile.manifest import Manifest
from fogspec.plan.schema import TaskRef
from fogspec.spec.loader import LoadedSpec, SourceFile


@dataclass(frozen=True, slots=True)
class ManifestBundle:
    """A manifest on disk with its bytes, and the inputs of the application that it deploys."""

    manifest: Manifest
    content: bytes
    inputs: Inputs

    @property
    def digest(self) -> str:
        """The digest of the manifest's bytes."""
        return digest.of_bytes(self.content)

    @property
    def layout(self) -> Layout:
        """The paths of the application's files."""
        return self.inputs.layout

    @property
    def loaded(self) -> LoadedSpec:
        """The application's spec."""
        return self.inputs.spec

    def edited(self) -> list[str]:
        """Return an error for each file that does not match its digest in the manifest."""
        return [wrong for one in references(self.manifest) if (wrong := self._difference(one)) is not None]

    def file(self, reference: TaskRef) -> SourceFile:
        """Return a file that the manifest names."""
        path = Path(os.path.normpath(self.layout.compiled / reference.path))
        return self.inputs.on_disk.get(path) or SourceFile.read(path, self.layout.files)

    def _difference(self, reference: TaskRef) -> str | None:
        path, file = self.layout.compiled / reference.path, self.file(reference)
        if isinstance(file.problem, FileNotFoundError):
            return f"{path} is missing"
        if file.problem is not None:
            return f"{path} cannot be read: {file.problem.strerror}"
        if digest.of_bytes(file.content) != reference.digest:
            return f"{path} is not what the manifest says: what is reviewed is what runs"
        return None


def open_bundle(path: str | os.PathLike[str], catalog: str | None = None) -> ManifestBundle:
    """Open the manifest at `compiled/NAME/manifest.yaml` with its inputs.

    `catalog` overrides the catalog in the lock. Raise DiagnosticError for a damaged file or an invalid spec, InvalidInput
    for a manifest that is missing or elsewhere, where its relative paths are wrong, and the errors of `Inputs.load`.
    """
    at = Path(path)
    whole = Path(os.path.abspath(at))
    root = whole.parents[min(2, len(whole.parents) - 1)]
    root = root if at.is_absolute() else Path(os.path.relpath(root))
    files = ProjectFiles(root)
    if not files.is_file(at):
        raise InvalidInput(
            f"{at}: there is no such manifest", "fogspec status says what is missing before there is one"
        )
    file = SourceFile.read(at, files)
    manifest = file.document(Manifest)
    name = manifest.metadata.name
    spec = root / manifest.provenance.application.path
    layout = Layout.of(spec, name)
    if os.path.abspath(layout.manifest) != str(whole):
        raise InvalidInput(
            f"{at}: the manifest of {name} must stand at {layout.manifest}, beside what it names",
            f"make it there: fogspec compile {spec}",
        )
    known = {layout.manifest: file}
    found = Inputs.load([spec], catalog=catalog, name=name, audit=True, known=known)
    if not found:
        raise InvalidInput(f"{spec} has no application named {name}, which {at} deploys")
    return ManifestBundle(manifest, file.content, found[0])


def references(manifest: Manifest) -> list[TaskRef]:
    """Return every file that is approved with the manifest."""
    spec = manifest.spec
    robot = [] if spec.robot_launch is None else [spec.robot_launch]
    return [spec.task, *(one.task for one in spec.fallbacks), *robot, *spec.files]
