"""Stable codes of diagnostics: the page of each, read from `codes.toml` when one is shown."""

import functools
import tomllib
from pathlib import Path
from typing import NamedTuple


class Code(NamedTuple):
    """A diagnostic's page: `wrong` and `right` are lines of a spec."""

    title: str
    why: str
    wrong: str = ""
    right: str = ""


@functools.cache
def codes() -> dict[str, Code]:
    """Return every code with its page, in the order of the table."""
    table = tomllib.loads(Path(__file__).with_name("codes.toml").read_text("utf-8"))
    return {name: Code(**page) for name, page in table.items()}
