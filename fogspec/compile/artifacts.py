"""Compare the compiled files of an application with those on disk, and write them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from fogspec.base.layout import Layout
from fogspec.catalog.filters import Filtered
from fogspec.catalog.table import Catalog
from fogspec.compile.inputs import Inputs
from fogspec.plan.reuse import selects_more
from fogspec.plan.schema import Plan
from fogspec.results.schema import Results
from fogspec.results.standing import Standing
from fogspec.spec.loader import SourceFile
from fogspec.spec.schema import Application

if TYPE_CHECKING:
    from fogspec.compile.decision import Decision


@dataclass(frozen=True, slots=True, kw_only=True)
class Artifacts:
    """The compiled files of an application, by path, and the values behind them.

    `application` is the spec with its image pinned. `results` are the current results; `stale` is the reason why those on
    disk are not current, `standing` what changed since they were measured. There is a `decision` if there are current results.
    """

    inputs: Inputs
    application: Application
    plan: Plan
    admissible: Filtered
    results: Results | None
    stale: str | None
    standing: Standing | None
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
    def selects_more(self) -> bool:
        """Whether the benchmark measures more machines than the plan has, those that the model selects."""
        sampling = None if self.results is None else self.results.spec.sampling
        if sampling is not None and sampling.stop_reason is not None and sampling.out_of_budget:
            return False
        return selects_more(self.application, self.plan.spec.sampler, sampling)

    @property
    def most_usd(self) -> float:
        """The most that the whole benchmark can cost in USD: all of its budget while the model selects machines."""
        body = self.plan.spec
        return (
            body.budget
            if self.selects_more and body.budget is not None and body.estimate.total
            else body.estimate.total
        )

    @property
    def kept(self) -> tuple[Path, ...]:
        """The manifest on disk and the files of its choice, if no new manifest follows: stale, and kept until one does."""
        layout, on_disk = self.layout, self.inputs.on_disk
        if layout.manifest in self.files or layout.manifest not in on_disk:
            return ()
        planned = (layout.tasks, layout.former_agent)
        return tuple(path for path in self._unfollowed() if path.parent not in planned)

    @property
    def removed(self) -> tuple[Path, ...]:
        """Compiled files on disk that no longer follow from the inputs, as far as fogspec wrote them, and are not kept."""
        kept = set(self.kept)
        return tuple(path for path in self._unfollowed() if path not in kept)

    def _unfollowed(self) -> tuple[Path, ...]:
        return tuple(path for path in self.inputs.on_disk if path not in self.files and self.inputs.wrote(path))

    def compare(self) -> list[Path]:
        """Return the files on disk that differ from what follows from the inputs: to write, to remove, or kept though stale."""
        changed = (path for path, content in self.files.items() if self.inputs.content(path) != content)
        return sorted([*changed, *self._unfollowed()])

    def written(self) -> dict[Path, SourceFile]:
        """Return the compiled files as they are on disk after writing."""
        known = self.inputs.on_disk
        same = {path for path, content in self.files.items() if self.inputs.content(path) == content}
        return {
            path: known[path] if path in same else SourceFile(path, content) for path, content in self.files.items()
        }

    def write(self) -> list[Path]:
        """Write the files that differ, remove those that no longer follow from the inputs, and return both."""
        kept = set(self.kept)
        differing = [path for path in self.compare() if path not in kept]
        for path in differing:
            if path in self.files:
                self.layout.files.write(path, self.files[path])
            else:
                self.layout.files.remove(path)
                self.layout.files.remove_folder(path.parent)  # if it is empty now
        return differing
