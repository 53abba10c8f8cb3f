"""Compare the compiled files of an application with those on disk, and write them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from fogspec.base.layout import Layout
from fogspec.base.text import shell_command
from fogspec.catalog.filters import Filtered
from fogspec.catalog.table import Catalog
from fogspec.compile.inputs import Inputs
from fogspec.language.loader import SourceFile
from fogspec.language.schema import Application
from fogspec.plan.reuse import selects_more
from fogspec.plan.schema import Plan
from fogspec.results.schema import Results
from fogspec.results.standing import Standing

if TYPE_CHECKING:
    from fogspec.choice.menu import Menu
    from fogspec.compile.decision import Decision

CHART = ".svg"  # shows what other files say, and is no link of the chain


@dataclass(frozen=True, slots=True, kw_only=True)
class Artifacts:
    """The compiled files of an application, by path, and the values behind them.

    `application` is the spec with its image pinned. `results` are the current results; `stale` is the reason why those on
    disk are not current, `standing` what changed since they were measured. There is a `decision` if there are current results,
    and a price list; without one, `accepted` says how much of the plan the manifest on disk accepts if that is not all, and
    `recorded_menu` is the menu on disk.
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
    accepted: str | None = None
    recorded_menu: "Menu | None" = None

    @property
    def layout(self) -> Layout:
        """The paths of the application's files."""
        return self.inputs.layout

    @property
    def catalog(self) -> Catalog:
        """The catalog of machines and prices."""
        return self.inputs.catalog

    @property
    def partial(self) -> str | None:
        """How much of the plan the manifest rests on, if that is not all of it; None without such a manifest."""
        decision = self.decision
        if decision is None or decision.manifest is None or decision.unfinished is None:
            return self.accepted
        return decision.unfinished.state

    @property
    def infeasible(self) -> bool:
        """True if no machine can be chosen."""
        return self._menu is not None and self._menu.spec.balanced is None

    @property
    def settles(self) -> bool:
        """Whether one more sample may let a machine meet the limits, while none does."""
        found = None if self._menu is None else self._menu.spec.open
        return found is not None and found.cause == "one sample"

    @property
    def _menu(self) -> "Menu | None":
        return self.recorded_menu if self.decision is None else self.decision.menu

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
        return tuple(
            path for path in self._unfollowed() if path.parent != layout.tasks and path != layout.measure_script
        )

    @property
    def removed(self) -> tuple[Path, ...]:
        """Compiled files on disk that no longer follow from the inputs, as far as fogspec wrote them, and are not kept."""
        kept = set(self.kept)
        return tuple(path for path in self._unfollowed() if path not in kept)

    def _unfollowed(self) -> tuple[Path, ...]:
        return tuple(path for path in self.inputs.on_disk if path not in self.files and self.inputs.wrote(path))

    def _differing(self) -> list[Path]:
        changed = (path for path, content in self.files.items() if self.inputs.content(path) != content)
        return sorted([*changed, *self._unfollowed()])

    def compare(self) -> list[Path]:
        """Return the files on disk, charts apart, that differ from what follows: to write, to remove, or kept though stale."""
        return [path for path in self._differing() if path.suffix != CHART]

    @property
    def chart_warnings(self) -> tuple[str, ...]:
        """A warning for each chart on disk that differs although nothing else does, as after an edit or with another libc."""
        again = shell_command("fogspec", "compile", self.layout.spec)
        charts = () if self.compare() else [path for path in self._differing() if path.suffix == CHART]
        return tuple(f"warning: {path} is not the chart that compile draws: {again}" for path in charts)

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
        differing = [path for path in self._differing() if path not in kept]
        for path in differing:
            if path in self.files:
                self.layout.files.write(path, self.files[path])
            else:
                self.layout.files.remove(path)
                self.layout.files.remove_folder(path.parent)  # if it is empty now
        return differing
