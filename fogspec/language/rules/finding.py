"""The result of a rule."""

from collections.abc import Callable, Iterator
from dataclasses import KW_ONLY, dataclass
from typing import Literal

from fogspec.base.yaml.positions import Path
from fogspec.language.schema import Application


@dataclass(frozen=True, slots=True)
class Finding:
    """A broken rule at `path`; `about` are the other fields that it depends on. `at_key` underlines the key."""

    code: str
    path: Path
    message: str
    fix: str | None = None
    about: tuple[Path, ...] = ()
    _: KW_ONLY
    at_key: bool = False
    severity: Literal["error", "warning"] = "error"


Rule = Callable[[Application], Iterator[Finding]]
