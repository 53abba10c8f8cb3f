"""What the places of shared live state have in common: records by keys, each replaced only by who saw what it replaces."""

from dataclasses import dataclass
from typing import Protocol

from fogspec.base.errors import CloudError, FogspecError


@dataclass(frozen=True, slots=True)
class Stored:
    """A record as it is in the store; `version` identifies it, and is None if there is no record."""

    version: str | None = None
    content: bytes = b""


WITHOUT = "FOGSPEC_STATE=folder runs a command without the shared state"


class StoreUnavailable(CloudError):
    """The store did not answer, or refused: what it has is as it was, or as it was to become."""

    def __init__(self, where: str, reason: str) -> None:
        super().__init__(f"{where}: no contact: {reason}", "nothing is lost: run it again when it answers", WITHOUT)


class StoreRefused(StoreUnavailable):
    """To read or write the store could run a program that its files name; nothing of it was used."""

    exit_code = 5

    def __init__(self, place: str, reason: str, fix: str) -> None:
        FogspecError.__init__(self, f"{place}: {reason}", fix, WITHOUT)


class Overtaken(Exception):
    """The record is no longer the one that was to be replaced."""


class Store(Protocol):
    """Records that clones share."""

    def read(self, key: str) -> Stored:
        """Return the record with this key; raise StoreUnavailable."""
        ...

    def read_all(self) -> dict[str, Stored]:
        """Return all records by their keys; raise StoreUnavailable."""
        ...

    def write(self, key: str, content: bytes | None, replaced: str | None, why: str) -> str | None:
        """Replace the version `replaced` of a record, or remove it; return the new version.

        Raise Overtaken if the record is another version, StoreUnavailable if the store refuses or what became of it is unknown.
        """
        ...

    def path(self, key: str) -> str:
        """Return where a record is, for people."""
        ...
