"""Reading what was measured: whole, sealed, and never guessed at."""

import gzip
import io
import os
import zlib
from dataclasses import dataclass
from pathlib import Path

from fogspec.base import digest
from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span
from fogspec.base.errors import InvalidInput
from fogspec.base.layout import Layout
from fogspec.results.schema import Measured, Results, checksum_ok
from fogspec.spec.loader import read_document

SIZE_LIMIT = 256 * 2**20


@dataclass(frozen=True, slots=True)
class Recording:
    """One record to be replayed, and its raw timings where they were kept (gzip).

    Where it is not `priced`, nobody wrote down what it cost: the plan's price for its duration is taken.
    """

    record: Measured
    timings: Path | None = None
    priced: bool = True


def read_results(layout: Layout) -> Results | None:
    """The application's results, None where there are none yet; raises DiagnosticError for an edited or damaged file."""
    if not os.path.lexists(layout.results):
        return None
    results = read_document(layout.results, Results)
    check_integrity(results, layout.results)
    return results


def check_integrity(results: Results, path: str | Path) -> None:
    """Raises DiagnosticError when the file says something else than what was measured."""
    if not checksum_ok(results):
        raise DiagnosticError([Diagnostic(
            "FS701", "the results were changed after they were measured: their seal does not hold",
            Span(str(path), 1, 1),
            f"restore the file (git checkout -- {path}), or move it away and measure again",
        )])  # fmt: skip


def raw_timings(record: Measured, folder: Path) -> bytes:
    """The raw timings that a record of a results file in `folder` names; raises InvalidInput where they are not as recorded."""
    assert record.timings is not None
    named = Path(record.timings.path)
    path = folder / named
    if named.is_absolute() or ".." in named.parts:
        raise InvalidInput(f"{record.id}: {named} lies outside of {folder}")
    if not path.is_file():
        raise InvalidInput(f"{path} is missing")
    content = path.read_bytes()
    if digest.of_bytes(content) != record.timings.digest:
        raise InvalidInput(f"{path} is not what was recorded")
    try:
        with gzip.open(io.BytesIO(content)) as packed:
            return packed.read(SIZE_LIMIT)
    except (OSError, EOFError, zlib.error):
        raise InvalidInput(f"{path} is no gzip file, or not a whole one") from None


def recordings(path: str) -> tuple[list[Recording], str]:
    """What a results file recorded, to be replayed, and where it comes from; raises DiagnosticError or InvalidInput."""
    results = read_document(Path(path), Results)
    check_integrity(results, path)
    folder = Path(path).parent
    for record in results.spec.samples:
        if record.timings is not None:
            raw_timings(record, folder)
    found = [
        Recording(record, folder / record.timings.path if record.timings else None) for record in results.spec.samples
    ]
    return found, f"replayed from {Path(path).name}: {results.spec.source or f'measured with {results.spec.runner}'}"
