"""A catalog from a CSV file in SkyPilot's columns, plain or gzipped."""

import gzip
import zlib
from collections.abc import Sequence
from pathlib import Path

from fogspec.base.outcomes import WrongFile
from fogspec.catalog import About, Catalog
from fogspec.plugins.catalogs.table import read

# SkyPilot's names (docs.skypilot.co, "Cloud providers")
CLOUDS = {
    "aws", "azure", "cudo", "do", "fluidstack", "gcp", "hyperbolic", "ibm", "kubernetes", "lambda", "nebius", "oci",
    "paperspace", "primeintellect", "runpod", "scp", "seeweb", "shadeform", "slurm", "ssh", "vast", "vsphere",
}  # fmt: skip


class CsvFile:
    """`--catalog FILE.csv[.gz]`.

    Rows of a table without a column `Cloud` belong to the cloud whose name the file or its folder has
    (`aws.csv`, `aws/vms.csv`, as SkyPilot lays them out), else to the only cloud in `clouds`, the clouds that the spec names.
    """

    def __init__(self, path: str, clouds: Sequence[str]) -> None:
        self.path, self.clouds = path, clouds

    def load(self) -> Catalog:
        """The catalog; raises Problems for a wrong table, WrongFile for one that cannot be read."""
        about = About(source=Path(self.path).name, revision="", date="", digest="")
        return read(content(self.path), self.path, self._cloud(), about)

    def _cloud(self) -> str | None:
        path = Path(self.path)
        names = (path.name.split(".")[0].lower(), path.absolute().parent.name.lower())
        named = next((name for name in names if name in CLOUDS), None)
        return named or (self.clouds[0] if len(set(self.clouds)) == 1 else None)


def content(path: str | Path) -> bytes:
    """The bytes of a file, unpacked where its name ends in .gz; raises WrongFile."""
    try:
        raw = Path(path).read_bytes()
        return gzip.decompress(raw) if str(path).endswith(".gz") else raw
    except (OSError, EOFError, zlib.error) as problem:
        reason = getattr(problem, "strerror", None) or "it is no whole gzip file"
        raise WrongFile(f"{path}: the catalog cannot be read: {reason}") from None
