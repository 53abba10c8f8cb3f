"""Read `claims.yaml`: what the paper states, each with its line, and what it leaves to be inferred."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

FILE = Path(__file__).with_name("claims.yaml")
REGION = "us-east-1"  # of the prices in Table II that name no other
APPLICATIONS = ("SLAM", "Dex-Net", "Cubicles", "Apartment")  # in the order of the columns of Table II


def inferred(one_of: int) -> str:
    """Return the mark of something that is not in the paper but fits it, as one of so many."""
    return "(inferred)" if one_of == 1 else f"(inferred, one of {one_of})"


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """A claim in our words at one or several lines of the paper; `cell` is what the page prints of it.

    `machines` are instance types by region whose prices give the figure; with `one_of` they, or else the cell, are inferred.
    """

    line: int | Sequence[int]
    says: str
    cell: str = ""
    not_shown: str = ""
    one_of: int | None = None
    machines: Mapping[str, Sequence[str]] = field(default_factory=dict)
    values: Mapping[str, Any] = field(default_factory=dict)

    @property
    def lines(self) -> tuple[int, ...]:
        """Return the lines of the paper's LaTeX, from 1."""
        return (self.line,) if isinstance(self.line, int) else tuple(self.line)

    @property
    def mark(self) -> str:
        """Return how what is inferred is marked, with a space before it; empty for a figure of the paper."""
        return f" {inferred(self.one_of)}" if self.one_of else ""

    @property
    def shown(self) -> str:
        """Return the cell, marked if the paper does not have it."""
        return self.cell if self.machines else f"{self.cell}{self.mark}"


@lru_cache(maxsize=1)
def claims() -> dict[str, Claim]:
    """Return every claim by name; raise TypeError for a key that no claim has."""
    return {name: Claim(**one) for name, one in yaml.safe_load(FILE.read_text("utf-8")).items()}


def unaccounted(page: str) -> list[str]:
    """Return the claims of which the page has no cell and the file no reason, or both."""
    unclear = [name for name, one in claims().items() if bool(one.not_shown) == bool(one.cell)]
    return unclear + [name for name, one in claims().items() if one.cell and not _stands_in(page, one.shown)]


def _stands_in(page: str, cell: str) -> bool:
    return re.search(rf"(?<![\w.$]){re.escape(cell)}(?![\w.]?\w)", page) is not None
