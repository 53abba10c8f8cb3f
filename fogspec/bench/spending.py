"""What measuring an application has cost so far, by every record of it that can be read: the budget is the application's.

A change of the spec sets results aside or starts new ones; the money stays spent. The files here, those of the last commit and
the journal each have a sum up to their time, so that the largest counts. What another clone spent and did not commit is known
to that clone only.
"""

import contextlib
from collections.abc import Mapping, Sequence

from fogspec.base.errors import FogspecError
from fogspec.base.layout import MOST_BYTES, Layout
from fogspec.base.repository import committed_below
from fogspec.bench.journal import JournalState
from fogspec.language.loader import SourceFile
from fogspec.results.folded import cost_usd
from fogspec.results.io import ASIDE, aside, readable, result_files
from fogspec.results.schema import ResultBody, Results


def spending(layout: Layout, results: Results | None) -> dict[str, float]:
    """Return the cost so far in USD by the name of the runner; `results` are those on disk.

    Recorded costs of a replay are no money, so that each runner has a sum of its own.
    """
    found = dict[str, float]()
    if results is not None:
        found[results.spec.runner] = results.spec.spent
    with contextlib.suppress(OSError, FogspecError):
        # Results that could be read count all that is beside them of their own runner.
        _raise(found, _sums([*(_on_disk(layout) if results is None else ()), *aside(layout)]))
    _raise(found, _sums(_committed(layout)))
    with contextlib.suppress(OSError, FogspecError):
        _raise(found, JournalState.read(layout.files.head(layout.journal, MOST_BYTES)).totals)
    return found


def _raise(found: dict[str, float], others: Mapping[str, float]) -> None:
    for runner, usd in others.items():
        found[runner] = max(found.get(runner, 0.0), usd)


def _sums(files: Sequence[ResultBody]) -> dict[str, float]:
    return {one.runner: cost_usd(files, one.runner) for one in files}


def _on_disk(layout: Layout) -> list[ResultBody]:
    return readable(result_files(layout.results, layout.files))


def _committed(layout: Layout) -> list[ResultBody]:
    """Return the results of the last commit, which may be deleted here, with those that were set aside then."""
    beside = layout.results.parent
    content = committed_below(layout.root, beside, lambda name: _is_result(name, layout.application))
    return readable([SourceFile(beside / name, content) for name, content in content.items()])


def _is_result(name: str, application: str) -> bool:
    folder, _, file = name.rpartition("/")
    return file.endswith(".yaml") and (folder == application or folder.startswith(f"{application}{ASIDE}"))
