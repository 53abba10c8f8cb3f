"""Read the inputs of applications and their compiled files on disk.

`Inputs.load` is the only reader of a command. It reads each file once, even if applications share it, and parses it once,
when it is first needed.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from fogspec.base.clouds import cloud_name
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import OutOfDate
from fogspec.base.layout import Layout
from fogspec.catalog.sources import load_catalog
from fogspec.catalog.table import Catalog
from fogspec.compile.agent_archive import agent_archive, is_former_agent_file
from fogspec.results.io import check_integrity
from fogspec.results.schema import Results
from fogspec.spec.loader import LoadedSpec, SourceFile, load
from fogspec.spec.lock_io import lock_drift
from fogspec.spec.lockfile import Lock, Pins
from fogspec.spec.schema import Application

if TYPE_CHECKING:
    from fogspec.numerics.priors import PriorData

LINK_FILES = (
    "link.sh",
    "policy.xml",
    "cloud.json5",
    "robot.json5",
    "cloud.conf",
    "robot.conf",
    "cloud.fastdds.xml",
    "robot.fastdds.xml",
)


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """The inputs of an application.

    `damaged` is the error of unusable results on disk. `agent` are the files copied to every machine, by their path in
    `compiled/`. `on_disk` are the compiled files on disk, `lock` is the lock file. `drifted` names the files next to the
    spec that do not match the lock; it is computed only for an audit. `notes` are for the user.
    """

    spec: LoadedSpec
    layout: Layout
    pins: Pins | None
    catalog: Catalog
    library: "PriorData | None"
    results: Results | None
    results_file: SourceFile | None
    damaged: DiagnosticError | None
    lock: SourceFile | None
    agent: Mapping[Path, bytes]
    on_disk: Mapping[Path, SourceFile]
    drifted: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @classmethod
    def load(
        cls,
        specs: Sequence[str | os.PathLike[str]],
        *,
        catalog: str | None = None,
        priors: Path | None = None,
        name: str | None = None,
        audit: bool = False,
        known: Mapping[Path, SourceFile] | None = None,
    ) -> list["Inputs"]:
        """Read the inputs of the applications in these specs, or of the application `name`.

        `catalog` and `priors` override those in the lock. For an `audit`, compare the files next to the specs with the
        lock. `known` are files that were read before.

        Raise DiagnosticError or InvalidInput for an invalid file, OutOfDate for a catalog or machine library that differs
        from the locked one.
        """
        loaded = [one for one in load(specs) if name in (None, one.application.metadata.name)]
        reader = _Reader(files=dict(known or {}), catalog_path=catalog, priors=priors)
        return [reader.inputs(one, audit) for one in loaded]

    @property
    def application(self) -> Application:
        """The application as the spec defines it."""
        return self.spec.application

    @property
    def source(self) -> str:
        """The path of the spec relative to the root of the project, as compiled files name it."""
        return self.layout.relative(self.layout.spec)

    def content(self, path: Path) -> bytes | None:
        """Return the bytes of a compiled file on disk, None if it is missing or unreadable."""
        file = self.on_disk.get(path)
        return None if file is None or file.problem is not None else file.content

    @property
    def spec_content(self) -> bytes:
        """The bytes of the spec file."""
        return self.spec.texts.content[self.spec.path]

    @property
    def results_content(self) -> bytes | None:
        """The bytes of the results file; None without one."""
        return None if self.results_file is None else self.results_file.content

    def with_application(self, application: Application) -> "Inputs":
        """Return these inputs with another application."""
        return replace(self, spec=replace(self.spec, application=application))


def catalogs_for(loaded: Sequence[LoadedSpec], path: str | None) -> tuple[list[Catalog], list[str]]:
    """Return the catalog of each application, from `path` or else from the lock, and notes for the user.

    Raise the errors of `Inputs.load`.
    """
    reader = _Reader(files={}, catalog_path=path, priors=None)
    notes: dict[str, None] = {}
    found = []
    for one in loaded:
        layout = Layout.of(one.path, one.application.metadata.name)
        catalog, found_notes = reader.catalog(one, layout, reader.pins(layout))
        found.append(catalog)
        notes |= dict.fromkeys(found_notes)
    return found, list(notes)


def clouds_of(one: LoadedSpec) -> tuple[str, ...]:
    """Return the names of the clouds in a spec, sorted."""
    return tuple(sorted({cloud_name(entry) for entry in one.application.spec.infra}))


def located(origin: str, layout: Layout) -> str:
    """Return the value of `--catalog` for the origin of a locked catalog."""
    return origin if origin in ("snapshot", "skypilot") else os.path.normpath(layout.root / origin)


@dataclass(kw_only=True)
class _Reader:
    """Read the files of one command, each once."""

    files: dict[Path, SourceFile]
    catalog_path: str | None
    priors: Path | None
    locks: dict[Path, Lock] = field(default_factory=dict)
    catalogs: dict[tuple[str | None, tuple[str, ...]], Catalog] = field(default_factory=dict)
    libraries: "dict[Path, PriorData]" = field(default_factory=dict)

    def inputs(self, one: LoadedSpec, audit: bool) -> Inputs:
        application = one.application
        layout = Layout.of(one.path, application.metadata.name)
        pins = self.pins(layout)
        catalog, notes = self.catalog(one, layout, pins)
        file = self.file(layout.results) if os.path.lexists(layout.results) else None
        results, damaged = _results(layout, file)
        needs_library = file is not None or application.spec.benchmark.sampler == "adaptive"
        return Inputs(
            spec=one,
            layout=layout,
            pins=pins,
            catalog=catalog,
            library=self.library(layout, pins) if needs_library else None,
            results=results,
            results_file=file,
            damaged=damaged,
            lock=self.files.get(layout.lock),
            agent={layout.agent: agent_archive()},
            on_disk=self.on_disk(layout),
            drifted=tuple(lock_drift(application, layout, pins)) if audit else (),
            notes=tuple(notes),
        )

    def file(self, path: Path) -> SourceFile:
        if path not in self.files:
            self.files[path] = SourceFile.read(path)
        return self.files[path]

    def on_disk(self, layout: Layout) -> dict[Path, SourceFile]:
        """Return the files of ours in `compiled/`."""
        former = [path for path in sorted(layout.former_agent.glob("*.*")) if path.is_file()]
        ours = (path for path in former if is_former_agent_file(path.name, self.file(path).content))
        return {path: self.file(path) for path in (*_ours(layout), *ours)}

    def pins(self, layout: Layout) -> Pins | None:
        path = layout.lock
        if path not in self.locks:
            if not os.path.lexists(path):
                return None
            self.locks[path] = self.file(path).document(Lock)
        return self.locks[path].spec.applications.get(layout.name)

    def catalog(self, one: LoadedSpec, layout: Layout, pins: Pins | None) -> tuple[Catalog, list[str]]:
        """Return the catalog of the command line, else of the lock, else the snapshot; and notes for the user."""
        path = self.catalog_path
        key = (path or (located(pins.catalog.origin, layout) if pins else None), clouds_of(one))
        if key not in self.catalogs:
            self.catalogs[key] = load_catalog(*key)
        catalog = self.catalogs[key]
        if pins is not None and path is None:
            catalog = _as_locked(catalog, pins, layout)
        notes = [f"{path}: {note}" for note in catalog.about.notes] if path else []
        return catalog, [*notes, *_age(one, catalog)]

    def library(self, layout: Layout, pins: Pins | None) -> "PriorData | None":
        from fogspec.model.priors import locked_priors, read_priors

        if self.priors is not None:
            if self.priors not in self.libraries:
                self.libraries[self.priors] = read_priors(self.priors)
            return self.libraries[self.priors]
        if pins is None or pins.priors is None:
            return None
        path = layout.root / pins.priors.origin
        library = self.libraries.get(path)
        if library is None or library.digest != pins.priors.digest:
            library = locked_priors(layout, pins)
            if library is not None:
                self.libraries[path] = library
        return library


def _results(layout: Layout, file: SourceFile | None) -> tuple[Results | None, DiagnosticError | None]:
    if file is None:
        return None, None
    try:
        results = file.document(Results)
        check_integrity(results, layout.results)
    except DiagnosticError as problems:
        return None, problems
    return results, None


def _ours(layout: Layout) -> Iterator[Path]:
    """Yield the files in `compiled/` that compile writes or an earlier compile wrote; other files are ignored."""
    named = [
        layout.agent,
        layout.plan,
        layout.models,
        layout.menu,
        layout.picture,
        layout.latencies,
        layout.manifest,
        layout.deploy,
        layout.robot,
        layout.cloud,
        *(layout.link / name for name in LINK_FILES),
    ]
    globbed = [
        *layout.compiled.glob("deploy.*.sky.yaml"),
        *layout.tasks.glob("*.sky.yaml"),
    ]
    yield from (path for path in dict.fromkeys([*named, *sorted(globbed)]) if path.is_file())


def _as_locked(catalog: Catalog, pins: Pins, layout: Layout) -> Catalog:
    pin = pins.catalog
    if catalog.about.digest != pin.digest:
        raise OutOfDate(
            f"{layout.name}: the catalog {pin.origin} is not the one that {layout.lock} pins",
            f"fogspec lock {layout.spec} --upgrade catalog",
        )
    about = replace(catalog.about, source=pin.source, revision=pin.revision, date=pin.date)
    return replace(catalog, about=about)


def _age(one: LoadedSpec, catalog: Catalog) -> list[str]:
    """Return a warning if the catalog is older than the spec allows."""
    dated, most_s = catalog.about.date, one.application.spec.catalog.max_age
    if not dated:
        return []
    days = (datetime.now(UTC).date() - date.fromisoformat(dated)).days
    if days * 86400 <= most_s:
        return []
    return [
        f"warning: {catalog.about.source}: prices are of {dated}, {days} days old; spec.catalog.max_age allows "
        f"{most_s / 86400:g}: see --catalog"
    ]
