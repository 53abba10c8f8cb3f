"""Results as files, for tests."""

from pathlib import Path
from typing import Any

from fogspec.base.project_files import ProjectFiles
from fogspec.results.io import read_results_folder, write_results
from fogspec.results.schema import ResultsBody


def write(folder: Path, body: ResultsBody, made: str = "a test") -> None:
    """Write the files of samples as a bench would, in place of those that are there."""
    for path in folder.glob("*.yaml"):
        path.unlink()
    write_results(folder, body, made, ProjectFiles(folder.parent))


def document(folder: Path) -> dict[str, Any]:
    """Return what all files of samples in a folder say, as plain values, with what was spent in USD."""
    body = read_results_folder(folder).spec
    return {**body.model_dump(mode="json", exclude_none=True), "spent": f"${body.spent:.9f}".rstrip("0")}


def text(folder: Path) -> str:
    """Return the text of all files of samples in a folder."""
    return "".join(path.read_text("utf-8") for path in sorted(folder.glob("*.yaml")))


def first(folder: Path) -> Path:
    """Return the first file of a sample in a folder."""
    return min(folder.glob("*.yaml"))


def remove(folder: Path) -> None:
    """Remove the files of samples in a folder."""
    for path in folder.glob("*.yaml"):
        path.unlink()
