"""Reading of results files and raw timings, with their checksums."""

from dataclasses import dataclass
from pathlib import Path

from fogspec.base import digest
from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span
from fogspec.base.errors import InvalidInput
from fogspec.base.files import decompress, too_large
from fogspec.base.layout import Layout
from fogspec.base.project_files import ProjectFiles
from fogspec.base.text import restore_command
from fogspec.results.ranges import SIZE_LIMIT
from fogspec.results.schema import Measured, Results, checksum_ok
from fogspec.spec.loader import read_document

PACKED_LIMIT = 64 << 20


@dataclass(frozen=True, slots=True)
class Recording:
    """One record to replay, and its raw timings if they were kept (gzip).

    A record that is not `priced` has no cost of its own: it costs the plan's price for its duration.
    """

    record: Measured
    timings: Path | None = None
    priced: bool = True


def read_results(layout: Layout) -> Results | None:
    """Return the application's results, None if there are none yet; raises DiagnosticError for an edited or damaged file."""
    if not layout.files.exists(layout.results):
        return None
    results = read_document(layout.results, Results, layout.files)
    check_integrity(results, layout.results)
    return results


def read_results_file(path: Path) -> Results:
    """Return the results in a file, wherever it is; raises DiagnosticError or InvalidInput."""
    results = read_document(path, Results, ProjectFiles(path.parent))
    check_integrity(results, path)
    return results


def check_integrity(results: Results, path: str | Path) -> None:
    """Raise DiagnosticError if the checksum does not match the content."""
    if not checksum_ok(results):
        raise DiagnosticError(
            [
                Diagnostic(
                    "FS701",
                    "integrity check failed: the results file was modified after the benchmark",
                    Span(str(path), 1, 1),
                    f"restore the file ({restore_command(path)}), or move it away and measure again",
                )
            ]
        )


def packed_timings(record: Measured, folder: Path) -> bytes:
    """Return the raw timings that a record of a results file in `folder` names, as they are on disk.

    Raises InvalidInput if they are missing, or not as recorded.
    """
    if record.timings is None:
        raise InvalidInput(f"{record.id}: no raw timings were recorded")
    named = Path(record.timings.path)
    path = folder / named
    if named.is_absolute() or ".." in named.parts:
        raise InvalidInput(f"{record.id}: {named} lies outside of {folder}")
    files = ProjectFiles(folder)
    if not files.is_file(path):
        raise InvalidInput(f"{path} is missing")
    try:
        content = files.read(path, PACKED_LIMIT + 1)
    except OSError as problem:
        raise InvalidInput(f"{path}: {problem.strerror}") from None
    if digest.of_bytes(content) != record.timings.digest:
        raise InvalidInput(f"{path} is not what was recorded")
    return content


def raw_timings(record: Measured, folder: Path) -> bytes:
    """Return the raw timings that a record of a results file in `folder` names, unpacked.

    Raises InvalidInput if they are missing, damaged, or not as recorded.
    """
    content = packed_timings(record, folder)
    path = folder / (record.timings.path if record.timings else "")
    try:
        return unpacked(content, path)
    except OSError as problem:
        raise InvalidInput(f"{path}: {problem.strerror}") from None


def changed_timings(results: Results, folder: Path) -> list[str]:
    """Return a sentence for each file of raw timings of results in `folder` that is missing, or not as recorded."""
    found = list[str]()
    for record in results.spec.samples:
        if record.timings is not None:
            try:
                packed_timings(record, folder)
            except InvalidInput as wrong:
                found.append(wrong.message)
    return found


def unpacked(content: bytes, path: Path) -> bytes:
    """Return raw timings unpacked; raise OSError if they are damaged or too large."""
    if len(content) > PACKED_LIMIT:
        raise too_large(path, PACKED_LIMIT)
    return decompress(content, "timings.gz", SIZE_LIMIT)


def recordings(path: str) -> tuple[list[Recording], str]:
    """Return the records of a results file, to replay, and their source; raises DiagnosticError or InvalidInput."""
    results = read_results_file(Path(path))
    folder = Path(path).parent
    for record in results.spec.samples:
        if record.timings is not None:
            raw_timings(record, folder)
    found = [
        Recording(record, folder / record.timings.path if record.timings else None) for record in results.spec.samples
    ]
    return found, f"replayed from {Path(path).name}: {results.spec.source or f'measured with {results.spec.runner}'}"
