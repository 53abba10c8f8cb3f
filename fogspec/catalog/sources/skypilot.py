"""SkyPilot's catalogs in its own layout: a directory per cloud with a table `vms.csv`, plain or gzipped.

`--catalog skypilot` reads the directory that SkyPilot itself fills and refreshes (`sky gpus list --infra aws` makes it do
so), and is the default where that has been done; SkyPilot is not imported, and nothing is fetched here. Only tables of
clouds that the spec names are read, so that new prices of one cloud leave what was made for another one as it is.
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from fogspec.base import digest
from fogspec.base.clouds import cloud_of
from fogspec.base.errors import InvalidInput
from fogspec.catalog.sources.csv import table
from fogspec.catalog.table import About, Catalog, concatenated

SCHEMA = "v8"  # of SkyPilot 0.14
TABLES = ("vms.csv", "vms.csv.gz")


class Folder:
    """`--catalog FOLDER`: tables in SkyPilot's layout, of unknown date."""

    def __init__(self, path: str, clouds: Sequence[str]) -> None:
        self.folder, self.clouds = Path(path), clouds

    def is_complete(self) -> bool:
        """Return whether there are tables, and none of a named cloud that needs one is missing."""
        tables = self._tables()
        return any(tables.values()) and not self._missing(tables)

    def load(self) -> Catalog:
        """Return the tables of the named clouds as one; raises DiagnosticError or InvalidInput."""
        tables = self._tables()
        if missing := self._missing(tables):
            where = f"{self.folder}: the catalog has no table of {', '.join(missing)}"
            raise InvalidInput(where, *map(self._advice, missing))
        found = {cloud: path for cloud, path in tables.items() if path is not None}
        if not found:
            raise InvalidInput(f"{self.folder}: the catalog has no table of {', '.join(tables)}")
        parts = [table(path, cloud, About("", "", "", ""), f"{cloud}/{path.name}") for cloud, path in found.items()]
        digests = {cloud: part.about.digest for cloud, part in zip(found, parts, strict=True)}
        notes = tuple(note for part in parts for note in part.about.notes)
        about = replace(self._about(found.values()), digest=digest.of_value(digests), notes=notes)
        return concatenated(parts, about)

    def _tables(self) -> dict[str, Path | None]:
        return {cloud: self._table(cloud) for cloud in sorted({*self.clouds})}

    @staticmethod
    def _missing(tables: Mapping[str, Path | None]) -> list[str]:
        return [cloud for cloud, path in tables.items() if path is None and cloud_of(cloud).priced]

    def _table(self, cloud: str) -> Path | None:
        return next((path for name in TABLES if (path := self.folder / cloud / name).is_file()), None)

    def _about(self, tables: Iterable[Path]) -> About:
        return About(source=self.folder.absolute().name, revision="", date="", digest="")

    def _advice(self, cloud: str) -> str:
        return f"expected {self.folder / cloud / TABLES[0]}"


class SkyPilot(Folder):
    """`--catalog skypilot`: the tables of the SkyPilot installed here, dated by the oldest one."""

    def __init__(self, _path: str, clouds: Sequence[str]) -> None:
        base = Path(os.path.expanduser(os.environ.get("SKY_RUNTIME_DIR") or "~"))
        super().__init__(str(base / ".sky" / "catalogs" / SCHEMA), clouds)

    def _about(self, tables: Iterable[Path]) -> About:
        fetched = min(path.stat().st_mtime for path in tables)
        date = datetime.fromtimestamp(fetched, UTC).date().isoformat()
        return About(source="skypilot", revision=f"schema {SCHEMA}", date=date, digest="")

    def _advice(self, cloud: str) -> str:
        return f"let SkyPilot fetch it: sky gpus list --infra {cloud}"
