"""What measuring an application has cost so far, by every record of it that can be read: the budget is the application's.

A change of the spec sets results aside or starts new ones; the money stays spent. Each record has the sum up to its time, so
that the largest counts. What another clone spent and did not commit is known to that clone only.
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import FogspecError
from fogspec.base.layout import Layout
from fogspec.base.repository import committed
from fogspec.bench.journal import JournalState
from fogspec.results.schema import Results
from fogspec.spec.loader import SourceFile


def spending(layout: Layout, results: Results | None) -> dict[str, float]:
    """Return the cost so far in USD by the name of the runner; `results` are those on disk.

    Recorded costs of a replay are no money, so that each runner has a sum of its own.
    """
    found = dict[str, float]()
    for one in (results, *_others(layout)):
        if one is not None:
            found[one.spec.runner] = max(found.get(one.spec.runner, 0.0), one.spec.spent)
    with contextlib.suppress(OSError, FogspecError):
        for runner, usd in JournalState.read(layout.files.read(layout.journal)).totals.items():
            found[runner] = max(found.get(runner, 0.0), usd)
    return found


def _others(layout: Layout) -> Iterator[Results | None]:
    """Yield the results that were set aside, and those of the last commit, which may be deleted here."""
    folder = layout.results.parent
    for name in layout.files.names(folder):
        if name.startswith(f"{layout.name}.old-"):
            path = folder / name / layout.results.name
            with contextlib.suppress(OSError, FogspecError):
                yield _parsed(path, layout.files.read(path))
    if (content := committed(layout.root, layout.results)) is not None:
        yield _parsed(Path(f"HEAD:{layout.results}"), content)


def _parsed(path: Path, content: bytes) -> Results | None:
    try:
        return SourceFile(path, content).document(Results)
    except (DiagnosticError, FogspecError):
        return None
