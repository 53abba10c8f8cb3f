"""Compare the compiled files of an application with those on disk, and write them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from fogspec.base.layout import Layout
from fogspec.catalog.filters import Filtered
from fogspec.catalog.table import Catalog
from fogspec.compile.inputs import Inputs
from fogspec.plan.schema import Plan
from fogspec.results.schema import Results
from fogspec.spec.loader import SourceFile
from fogspec.spec.schema import Application

if TYPE_CHECKING:
    from fogspec.compile.decision import Decision


@dataclass(frozen=True, slots=True, kw_only=True)
class Artifacts:
    """The compiled files of an application, by path, and the values behind them.

    `application` is the spec with its image pinned. `results` are the current results; `stale` is the reason why those on
    disk are not current. There is a `decision` if there are current results.
    """

    inputs: Inputs
    application: Application
    plan: Plan
    admissible: Filtered
    results: Results | None
    stale: str | None
    decision: "Decision | None"
    files: Mapping[Path, bytes]

    @property
    def layout(self) -> Layout:
        """The paths of the application's files."""
        return self.inputs.layout

    @property
    def catalog(self) -> Catalog:
        """The catalog of machines and prices."""
        return self.inputs.catalog

    @property
    def removed(self) -> tuple[Path, ...]:
        """Compiled files on disk that no longer follow from the inputs, as far as fogspec wrote them."""
        return tuple(path for path in self.inputs.on_disk if path not in self.files and self.inputs.wrote(path))

    def compare(self) -> list[Path]:
        """Return the files that differ from what compile would write, and those to remove."""
        changed = (path for path, content in self.files.items() if self.inputs.content(path) != content)
        return sorted([*changed, *self.removed])

    def written(self) -> dict[Path, SourceFile]:
        """Return the compiled files as they are on disk after writing."""
        known = self.inputs.on_disk
        same = {path for path, content in self.files.items() if self.inputs.content(path) == content}
        return {
            path: known[path] if path in same else SourceFile(path, content) for path, content in self.files.items()
        }

    def write(self) -> list[Path]:
        """Write the files that differ, remove those that no longer follow from the inputs, and return both."""
        differing = self.compare()
        for path in differing:
            if path in self.files:
                self.layout.files.write(path, self.files[path])
            else:
                self.layout.files.remove(path)
                self.layout.files.remove_folder(path.parent)  # if it is empty now
        return differing
