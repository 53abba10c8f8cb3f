"""Open a manifest with the inputs that it was compiled from."""

import os
from dataclasses import dataclass
from pathlib import Path

from fogspec.base import digest
from fogspec.base.errors import InvalidInput
from fogspec.base.layout import Layout
from fogspec.base.project_files import ProjectFiles
from fogspec.base.text import shell_command
from fogspec.compile.inputs import Inputs
from fogspec.compile.manifest import Manifest
from fogspec.language.discover import spec_below
from fogspec.language.documents import Reading
from fogspec.language.loader import LoadedSpec, SourceFile, load
from fogspec.plan.schema import TaskRef


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

    def path(self, reference: TaskRef) -> Path:
        """Return the path of a file that the manifest names."""
        return Path(os.path.normpath(self.layout.compiled / reference.path))

    def file(self, reference: TaskRef) -> SourceFile:
        """Return a file that the manifest names."""
        path = self.path(reference)
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


def open_bundle(path: str | os.PathLike[str], spec: Path | None = None) -> ManifestBundle:
    """Open the manifest at `compiled/NAME/manifest.yaml` with its inputs.

    `spec` is where its application is if that is known. Raise DiagnosticError for a damaged file or an invalid spec,
    InvalidInput for a manifest that is missing or elsewhere, where its relative paths are wrong, and the errors of
    `Inputs.load`.
    """
    at = Path(path)
    whole = Path(os.path.abspath(at))
    root = whole.parents[min(2, len(whole.parents) - 1)]
    root = root if at.is_absolute() else Path(os.path.relpath(root))
    files = ProjectFiles(root)
    if not files.is_file(at):
        raise InvalidInput(
            f"{at}: there is no such manifest",
            f"{shell_command('fogspec', 'status', at.parent.name)} for what is missing, and the command that comes next",
        )
    file = SourceFile.read(at, files)
    manifest = file.document(Manifest)
    name = manifest.metadata.name
    reading = Reading()
    spec = Path(spec or spec_below(root, name, reading) or Layout.named(root, name).spec)
    layout = Layout.of(spec, name)
    if os.path.abspath(layout.manifest) != str(whole):
        raise InvalidInput(
            f"{at}: the manifest of {name} must stand at {layout.manifest}, beside what it names",
            f"make it there: fogspec compile {spec}",
        )
    known = {layout.manifest: file}
    found = Inputs.load([], loaded=load([spec], reading), name=name, audit=True, recorded=True, known=known)
    if not found:
        raise InvalidInput(f"{spec} has no application named {name}, which {at} deploys")
    return ManifestBundle(manifest, file.content, found[0])


def references(manifest: Manifest) -> list[TaskRef]:
    """Return every file that is approved with the manifest."""
    pins = manifest.pins
    robot = [] if pins.robot_launch is None else [pins.robot_launch]
    return [pins.task, *(one.task for one in manifest.spec.fallbacks), *robot, *pins.files]
