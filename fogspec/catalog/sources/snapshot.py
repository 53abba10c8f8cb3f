"""The catalog that ships with fogspec: dated, made by `fogspec-lab snapshot`."""

import json
from collections.abc import Sequence
from pathlib import Path

from fogspec.base.errors import InvalidInput
from fogspec.catalog.sources.csv import table
from fogspec.catalog.table import About, Catalog

TABLE = Path(__file__).with_name("snapshot.csv.gz")
ABOUT = Path(__file__).with_name("snapshot.json")


def bundled_digest() -> str:
    """Return the digest of the bundled table, which is not read."""
    return str(json.loads(ABOUT.read_text(encoding="utf-8"))["digest"])


class Snapshot:
    """The bundled table; `about.notes` report what was left out of it."""

    def __init__(self, _path: str, _clouds: Sequence[str]) -> None:
        """Accept the arguments of every source, and ignore them."""

    def load(self) -> Catalog:
        """Return the whole snapshot; raises InvalidInput if it is damaged."""
        known = json.loads(ABOUT.read_text(encoding="utf-8"))
        notes, checked = tuple(known["notes"]), known["checked"]
        about = About(known["source"], known["revision"], known["date"], digest="", notes=notes, checked=checked)
        catalog = table(TABLE, None, about, shown=TABLE.name)
        if catalog.about.digest != known["digest"]:
            raise InvalidInput(
                f"{TABLE.name} is not the bundled catalog that {ABOUT.name} describes: install fogspec again"
            )
        return catalog
