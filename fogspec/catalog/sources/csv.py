"""A catalog from a CSV file in SkyPilot's columns, plain or gzipped."""

import gzip
import os
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from fogspec.base.clouds import CLOUDS
from fogspec.base.errors import InvalidInput
from fogspec.base.file_kinds import not_a_file
from fogspec.catalog.sources.cache import cached
from fogspec.catalog.sources.parse import read
from fogspec.catalog.table import About, Catalog


class CsvFile:
    """`--catalog FILE.csv[.gz]`.

    Rows of a table without a column `Cloud` belong to the cloud whose name the file or its folder has
    (`aws.csv`, `aws/vms.csv`, as SkyPilot lays them out), else to the only cloud in `clouds`, the clouds that the spec names.
    """

    def __init__(self, path: str, clouds: Sequence[str]) -> None:
        self.path, self.clouds = path, clouds

    def load(self) -> Catalog:
        """The catalog; raises DiagnosticError for a wrong table, InvalidInput for one that cannot be read."""
        return table(self.path, self._cloud(), About(source=Path(self.path).name, revision="", date="", digest=""))

    def _cloud(self) -> str | None:
        path = Path(self.path)
        names = (path.name.split(".")[0].lower(), path.absolute().parent.name.lower())
        named = next((name for name in names if name in CLOUDS and CLOUDS[name].on_skypilot), None)
        return named or (self.clouds[0] if len(set(self.clouds)) == 1 else None)


def table(path: str | Path, cloud: str | None, about: About, shown: str | None = None) -> Catalog:
    """The table in a file, which is called `shown` where something is wrong with it; raises DiagnosticError or InvalidInput."""
    raw, name = _bytes(path), shown or str(path)
    nobody = About("", "", "", "")
    catalog = cached(raw, name, cloud, lambda: read(_unpacked(raw, path), name, cloud, nobody))
    found = replace(about, digest=catalog.about.digest, notes=(*about.notes, *catalog.about.notes))
    return replace(catalog, about=found)


def _bytes(path: str | Path) -> bytes:
    try:
        if (what := not_a_file(os.stat(path).st_mode)) is not None:
            raise InvalidInput(f"{path}: the catalog cannot be read: {what}")
        return Path(path).read_bytes()
    except OSError as problem:
        raise InvalidInput(f"{path}: the catalog cannot be read: {problem.strerror}") from None


def _unpacked(raw: bytes, path: str | Path) -> bytes:
    try:
        return gzip.decompress(raw) if str(path).endswith(".gz") else raw
    except (OSError, EOFError, zlib.error):
        raise InvalidInput(f"{path}: the catalog cannot be read: it is no whole gzip file") from None
