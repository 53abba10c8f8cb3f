"""Reading of the files of results and of raw timings, with their checksums."""

from collections.abc import Sequence
from pathlib import Path

from fogspec.base import digest
from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span
from fogspec.base.errors import InvalidInput
from fogspec.base.files import decompress, too_large
from fogspec.base.layout import Layout
from fogspec.base.project_files import ProjectFiles
from fogspec.base.text import restore_command
from fogspec.language.loader import SourceFile
from fogspec.results.folded import Unmatched, cost_usd, folded, split
from fogspec.results.ranges import SIZE_LIMIT
from fogspec.results.schema import Measured, Result, ResultBody, Results, ResultsBody, checksum_ok, sealed

PACKED_LIMIT = 64 << 20
ASIDE = ".old-"  # in the name of a folder of results that were set aside, behind the application's


def result_files(folder: Path, files: ProjectFiles) -> list[SourceFile]:
    """Return the files of samples in a folder, by name; none without the folder. Raise LinkedPath for a link."""
    return [SourceFile.read(path, files) for path in result_paths(folder, files)]


def result_paths(folder: Path, files: ProjectFiles) -> list[Path]:
    """Return the paths of the files of samples in a folder, sorted."""
    return [folder / name for name in files.names(folder) if name.endswith(".yaml") and not name.startswith(".")]


def read_results(layout: Layout) -> Results | None:
    """Return the application's results, None if there are none yet; raises DiagnosticError for edited or damaged files."""
    return results_in(result_files(layout.results, layout.files), aside(layout))


def read_results_folder(folder: Path) -> Results:
    """Return the results in a folder, wherever it is; raises DiagnosticError or InvalidInput."""
    if (found := results_in(result_files(folder, ProjectFiles(folder.parent)))) is None:
        raise InvalidInput(f"{folder}: there are no results in this folder")
    return found


def results_in(sources: Sequence[SourceFile], set_aside: Sequence[ResultBody] = ()) -> Results | None:
    """Return the results that these files are, None without any; raise DiagnosticError with a line for each damaged file.

    `set_aside` is what was measured before.
    """
    bodies, wrong = list[ResultBody](), list[Diagnostic]()
    for source in sources:
        try:
            bodies.append(result_in(source))
        except DiagnosticError as damaged:
            wrong += damaged.diagnostics
    if wrong:
        raise DiagnosticError(wrong)
    try:
        return folded(bodies, cost_usd(set_aside, bodies[0].runner) if bodies else 0.0)
    except Unmatched as other:
        path = next(one.name for one in sources if Path(one.name).stem == other.id)
        raise DiagnosticError(
            [
                Diagnostic(
                    "FS701",
                    f"this sample does not belong to the others: {other}",
                    Span(path, 1, 1),
                    f"keep the files of one side ({restore_command(Path(path).parent)}), or remove it and measure it again",
                )
            ]
        ) from None


def result_in(source: SourceFile) -> ResultBody:
    """Return what the file of a sample says; raise DiagnosticError if it was edited, cut short or renamed."""
    found, path = source.document(Result), Path(source.name)
    if not checksum_ok(found):
        raise _damaged(path, "integrity check failed: the file was modified after the benchmark")
    if found.spec.id != path.stem or (found.spec.record is not None and found.spec.record.id != path.stem):
        raise _damaged(path, f"it is the file of {found.spec.id}, under another name")
    asked, record = found.spec.requested, found.spec.record
    if asked is not None and record is not None and asked.sample.machine.identity != record.machine.identity:
        raise _damaged(path, f"it asks for {asked.sample.machine.instance}, and measured {record.machine.instance}")
    return found.spec


def aside(layout: Layout) -> list[ResultBody]:
    """Return the readable files of results that were set aside: what they cost counts."""
    found, beside, files = list[ResultBody](), layout.results.parent, layout.files
    for name in files.names(beside):
        if name.startswith(f"{layout.application}{ASIDE}") and files.is_folder(beside / name):
            found += readable(result_files(beside / name, files))
    return found


def readable(sources: Sequence[SourceFile]) -> list[ResultBody]:
    """Return what those of the files say that are not damaged."""
    found = list[ResultBody]()
    for source in sources:
        try:
            found.append(result_in(source))
        except DiagnosticError:
            continue
    return found


def write_results(
    folder: Path, body: ResultsBody, made: str, files: ProjectFiles, written: dict[str, ResultBody] | None = None
) -> None:
    """Write the files of results, without those that are `written` already; `made` is the command that makes them."""
    known = {} if written is None else written
    for one in split(body):
        if known.get(one.id) != one:
            files.write_yaml(folder / f"{one.id}.yaml", sealed(one).model_dump(mode="json", exclude_none=True), made)
            known[one.id] = one


def _damaged(path: Path, why: str) -> DiagnosticError:
    fix = f"restore the file ({restore_command(path)}), or move it away and measure this sample again"
    return DiagnosticError([Diagnostic("FS701", why, Span(str(path), 1, 1), fix)])


def timings_path(folder: Path, sample: str) -> Path:
    """Return where the raw timings of a sample are in a folder of results."""
    return folder / "timings" / f"{sample}.jsonl.gz"


def packed_timings(record: Measured, folder: Path) -> bytes:
    """Return the raw timings of a record in a folder of results, as they are on disk.

    Raises InvalidInput if they are missing, or not as recorded.
    """
    if record.timings is None:
        raise InvalidInput(f"{record.id}: no raw timings were recorded")
    path, files = timings_path(folder, record.id), ProjectFiles(folder)
    if not files.is_file(path):
        raise InvalidInput(f"{path} is missing")
    try:
        content = files.head(path, PACKED_LIMIT + 1)
    except OSError as problem:
        raise InvalidInput(f"{path}: {problem.strerror}") from None
    if digest.of_bytes(content) != record.timings:
        raise InvalidInput(f"{path} is not what was recorded")
    return content


def raw_timings(record: Measured, folder: Path) -> bytes:
    """Return the raw timings of a record in a folder of results, unpacked.

    Raises InvalidInput if they are missing, damaged, or not as recorded.
    """
    content = packed_timings(record, folder)
    path = timings_path(folder, record.id)
    try:
        return unpacked(content, path)
    except OSError as problem:
        raise InvalidInput(f"{path}: {problem.strerror}") from None


def unpacked(content: bytes, path: Path) -> bytes:
    """Return raw timings unpacked; raise OSError if they are damaged or too large."""
    if len(content) > PACKED_LIMIT:
        raise too_large(path, PACKED_LIMIT)
    return decompress(content, "timings.gz", SIZE_LIMIT)
