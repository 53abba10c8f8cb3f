"""Remove the files of applications that have no spec any more."""

import os
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from fogspec.base.errors import Refused
from fogspec.base.layout import LOCK, MOST_BYTES, Layout
from fogspec.base.project_files import ProjectFiles
from fogspec.base.text import count, shell_command
from fogspec.base.units import dollars
from fogspec.bench.journal import JournalState
from fogspec.compile.inputs import compiled_files
from fogspec.deploy.state import DeploymentState, WallClock
from fogspec.language.lock_io import lock_files
from fogspec.results.io import ASIDE, readable, result_files
from fogspec.results.schema import ResultBody


def check_ended(layout: Layout, times: WallClock) -> None:
    """Raise Refused if machines of the application may run, or a bench has measured what is not in the results yet."""
    down = shell_command("fogspec", "down", layout.name)
    live = DeploymentState.look(layout, times)
    if live.machines or live.foreign:
        names = ", ".join(one.name for one in (*live.machines, *live.foreign))
        raise Refused(f"{layout.name} runs: {names}; machines are bound to the application's name", f"end it: {down}")
    files = layout.files
    if files.is_file(layout.journal):
        journal = JournalState.read(files.head(layout.journal, MOST_BYTES))
        if journal.open or journal.unwritten:
            bench = shell_command("fogspec", "bench", layout.name)
            raise Refused(f"{layout.name}: a bench of it has not ended", f"let it finish: {bench}, or end it: {down}")


def _compiled(layout: Layout) -> list[Path]:
    """Return what fogspec wrote into `compiled/` for an application, the report included."""
    return [*compiled_files(layout), layout.page]


def _own_timings(layout: Layout) -> list[Path]:
    timings = [layout.timings / name for name in layout.files.names(layout.timings) if name.endswith(".gz")]
    return timings + [
        layout.results / name for name in layout.files.names(layout.results) if name.startswith("packages-")
    ]


def _remove_empty(layout: Layout) -> None:
    """Remove the folders of an application that are empty now."""
    compiled = (layout.tasks, layout.deploy_script.parent, layout.link, layout.compiled)
    for folder in (*compiled, layout.timings, layout.results):
        layout.files.remove_folder(folder)


@dataclass(frozen=True, slots=True)
class Leftover:
    """What fogspec wrote for an application that has no spec: `paths` are its files, `measured` says what they cost."""

    layout: Layout
    paths: tuple[Path, ...]
    measured: str

    @property
    def line(self) -> str:
        """The files in a few words."""
        spent = {self.layout.results: f": {self.measured}"}
        parts = [
            f"{count(number, 'file')} in {folder}{spent.get(folder, '')}" for folder, number in self.folders.items()
        ]
        parts += [str(path) for path in self.paths if path.suffix == LOCK]
        return f"{self.layout.name}: {'; '.join(parts)}"

    @property
    def folders(self) -> dict[Path, int]:
        """How many of the files are in which folder; a lock, which stands among specs, is in none of them."""
        counted = {
            folder: sum(folder in path.parents for path in self.paths)
            for folder in (self.layout.compiled, self.layout.results)
        }
        return {folder: number for folder, number in counted.items() if number}


def without_application(root: Path, layouts: Collection[Layout]) -> list[str]:
    """Return a sentence for each folder and each lock below a root that belongs to none of these applications."""
    found = [folder for one in leftovers(root, layouts) for folder in one.folders]
    return [f"{folder}: no spec has an application of this name" for folder in found] + [
        f"{path}: no spec beside it has an application of this name: {shell_command('git', 'rm', path)}"
        for path in _stray_locks(root, layouts)
    ]


def _stray_locks(root: Path, layouts: Collection[Layout]) -> list[Path]:
    """Return the locks below a root that belong to none of these applications, or stand where their specs do not."""
    known = {os.path.realpath(one.lock) for one in layouts}
    return [path for path in lock_files(root) if os.path.realpath(path) not in known]


def leftovers(root: Path, layouts: Collection[Layout]) -> list[Leftover]:
    """Return what fogspec wrote below a root for applications that are not among these."""
    files = Layout.named(root, "any").files
    found = [name for name in files.names(root / "compiled") if files.is_folder(root / "compiled" / name)]
    found += [name for name in files.names(root / "results") if ASIDE not in name]
    locks = _stray_locks(root, layouts)
    found += [path.stem for path in locks]
    left = []
    for name in sorted(set(found) - {one.name for one in layouts}):
        layout = Layout.named(root, name)
        ours = [path for path in _compiled(layout) if files.is_file(path)]
        if not any(path in ours for path in (layout.plan, layout.manifest)):
            ours = []  # not a folder of ours, whatever is in it
        measured = _measured(layout)
        if measured:
            ours += [*(layout.results / f"{one.id}.yaml" for one in measured), *_own_timings(layout)]
        ours += [path for path in locks if path.stem == name]
        if ours:
            spent = f"{count(len(measured), 'sample')}, {dollars(sum(one.spent for one in measured))}"
            left.append(Leftover(layout, tuple(ours), spent))
    return left


def prune(left: Leftover, times: WallClock) -> Iterator[Path]:
    """Remove the files and yield each. Raise Refused if the application still runs."""
    layout, files = left.layout, left.layout.files
    check_ended(layout, times)
    for path in left.paths:
        if (files if path.suffix != LOCK else ProjectFiles(path.parent)).remove(path):
            yield path
    _remove_empty(layout)


def _measured(layout: Layout) -> list[ResultBody]:
    """Return what fogspec measured: another YAML file is not fogspec's to remove, and an environment has none of its own."""
    return [] if layout.overlay is not None else readable(result_files(layout.results, layout.files))
