"""Secrets: recognize them by key or by form, require them in the environment, keep them out of what is printed."""

import os
import re
from collections.abc import Iterable, Mapping
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


def check_set(names: Iterable[str]) -> None:
    """Raise UsageError for secrets missing from the environment, before anything is started."""
    if missing := sorted(name for name in names if name not in os.environ):
        raise UsageError(
            f"spec.secrets: the environment does not have {', '.join(missing)}, so nothing was started",
            f"export {' '.join(f'{name}=…' for name in missing)}",
        )


def redacted(value: Any, names: Iterable[str] = (), key: str = "") -> Any:
    """Return the value, a tree of mappings, lists and scalars, without secrets.

    `names` are environment variables whose values are secrets. A non-empty string under a key that names a secret is
    always hidden.
    """
    from fogspec.agent.redaction import Secrets

    return _redacted(value, Secrets.of(names), key)


def _redacted(value: Any, known: "Secrets", key: str) -> Any:
    if isinstance(value, Mapping):
        return {name: _redacted(one, known, str(name)) for name, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_redacted(one, known, key) for one in value]
    if isinstance(value, str) and value and (SECRET_KEY.search(key) or kind_of(value, key)):
        return HIDDEN
    return known.redact(value) if isinstance(value, str) else value


def redact_files(secrets: "Secrets", directory: Path) -> None:
    """Rewrite the files below a directory that contain secrets."""
    if not secrets:
        return
    files = ProjectFiles(directory)
    for path in files.files(directory):
        try:
            before = files.read(path, FILE_LIMIT)
        except OSError:
            continue
        after = secrets.redact_bytes(before)
        if after != before:
            files.write(path, after)
