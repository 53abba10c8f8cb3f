"""A catalog from a CSV file in SkyPilot's columns, plain or gzipped."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from fogspec.base.clouds import CLOUDS
from fogspec.base.csv_table import MOST_BYTES
from fogspec.base.errors import InvalidInput
from fogspec.base.files import decompress, read_bounded
from fogspec.catalog.sources.cache import cached
from fogspec.catalog.sources.parse import read
from fogspec.catalog.sources.zones import by_name
from fogspec.catalog.table import About, Catalog


class CsvFile:
    """`--catalog FILE.csv[.gz]`.

    Rows of a table without a column `Cloud` belong to the cloud that the file or its directory is named after
    (`aws.csv`, `aws/vms.csv`, as SkyPilot lays them out), else to the only cloud in `clouds`, the clouds that the spec names.
    """

    def __init__(self, path: str, clouds: Sequence[str]) -> None:
        self.path, self.clouds = path, clouds

    def load(self) -> Catalog:
        """Return the catalog; raises DiagnosticError for a wrong table, InvalidInput for one that cannot be read."""
        return table(self.path, self._cloud(), About(source=Path(self.path).name, revision="", date="", digest=""))

    def _cloud(self) -> str | None:
        path = Path(self.path)
        names = (path.name.split(".")[0].lower(), path.absolute().parent.name.lower())
        named = next((name for name in names if name in CLOUDS and CLOUDS[name].on_skypilot), None)
        return named or (self.clouds[0] if len(set(self.clouds)) == 1 else None)


def table(path: str | Path, cloud: str | None, about: About, shown: str | None = None) -> Catalog:
    """Return the table in a file, under the name `shown` in messages; raises DiagnosticError or InvalidInput."""
    name = shown or str(path)
    try:
        raw = read_bounded(path, MOST_BYTES)
        empty = About("", "", "", "")
        catalog = cached(raw, name, cloud, lambda: read(decompress(raw, path, MOST_BYTES), name, cloud, empty))
    except OSError as problem:
        raise InvalidInput(f"{path}: the catalog cannot be read: {problem.strerror}") from None
    read_as = catalog.about
    notes = (*about.notes, *read_as.notes)
    found = replace(about, digest=read_as.digest, notes=notes, core_hours=read_as.core_hours)
    return by_name(replace(catalog, about=found), Path(path), name)
