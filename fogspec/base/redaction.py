"""Secrets: recognize them by key or by form, require them in the environment, keep their values out of all text.

Reading a spec registers the names of its secrets. Text passes one of two gates: the console, for all that is printed, and
for files the types and functions through which text of machines enters: `SampleStatus`, `DeploymentStatus`, `LaunchRefused`,
`Unreachable`, logs and raw timings. Files of fogspec's own words have no gate: a value that is a part of a digest or of the
name of a machine that runs must not change these.
"""

import os
import re
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fogspec.base.credentials import kind_of
from fogspec.base.errors import UsageError
from fogspec.base.project_files import ProjectFiles

if TYPE_CHECKING:
    from fogspec.agent.redaction import Secrets

HIDDEN = "(redacted)"
FILE_LIMIT = 256 * 2**20
SECRET_KEY = re.compile(
    r"TOKEN|SECRET|PASSW|CREDENTIAL|API_?KEY|ACCESS_?KEY|PRIVATE_?KEY|(^|_)PSK$|(^|_)AUTH$", re.IGNORECASE
)


_registered: set[str] = set()


def register(names: Iterable[str]) -> None:
    """Take the values of these environment variables out of all text from now on."""
    _registered.update(names)


def known() -> "Secrets":
    """Return the registered secrets that the environment has."""
    return _of(tuple((name, value) for name in sorted(_registered) if (value := os.environ.get(name))))


@lru_cache(maxsize=1)
def _of(pairs: tuple[tuple[str, str], ...]) -> "Secrets":
    from fogspec.agent.redaction import Secrets

    return Secrets.of(name for name, _ in pairs)


def without_secrets(text: str) -> str:
    """Return the text with `$NAME` in place of the value of each registered secret."""
    return known().redact(text) if _registered else text


def check_set(names: Iterable[str]) -> None:
    """Raise UsageError for secrets missing from the environment, before anything is started."""
    if missing := sorted(name for name in names if name not in os.environ):
        raise UsageError(
            f"spec.secrets: the environment does not have {', '.join(missing)}, so nothing was started",
            f"export {' '.join(f'{name}=…' for name in missing)}",
        )


def redacted(value: Any, key: str = "") -> Any:
    """Return the value, a tree of mappings, lists and scalars, without secrets.

    A non-empty string under a key that names a secret is always hidden.
    """
    if isinstance(value, Mapping):
        return {name: redacted(one, str(name)) for name, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [redacted(one, key) for one in value]
    if isinstance(value, str) and value and (SECRET_KEY.search(key) or kind_of(value, key)):
        return HIDDEN
    return without_secrets(value) if isinstance(value, str) else value


def redact_files(directory: Path) -> None:
    """Rewrite the files below a directory that contain registered secrets."""
    if not (secrets := known()):
        return
    files = ProjectFiles(directory)
    for path in files.files(directory):
        try:
            before = files.head(path, FILE_LIMIT)
        except OSError:
            continue
        after = secrets.redact_bytes(before)
        if after != before:
            files.write(path, after)
