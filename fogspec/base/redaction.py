"""Secrets: recognize them by key or by form, require them in the environment, keep them out of what is printed."""

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fogspec.base.errors import UsageError
from fogspec.base.project_files import ProjectFiles

if TYPE_CHECKING:
    from fogspec.agent.redaction import Secrets

HIDDEN = "(redacted)"
FILE_LIMIT = 256 * 2**20
SECRET_KEY = re.compile(
    r"TOKEN|SECRET|PASSW|CREDENTIAL|API_?KEY|ACCESS_?KEY|PRIVATE_?KEY|(^|_)PSK$|(^|_)AUTH$", re.IGNORECASE
)

# Prefixes that issuers put at the start of their keys, so that leaks can be found.
PRIVATE_KEY = re.compile(
    r"-----BEGIN [A-Z0-9 ]*PRIVATE KEY|AGE-SECRET-KEY-1|\b(?:AKIA|ASIA)[0-9A-Z]{16}\b|\bgh[pousr]_[A-Za-z0-9]{36}"
    r"|\bgithub_pat_[A-Za-z0-9_]{22}|\bglpat-[A-Za-z0-9_-]{20}|\bxox[abprs]-[A-Za-z0-9-]{10}|\bAIza[0-9A-Za-z_-]{35}"
    r"|\bhf_[A-Za-z]{30}"
)
NAMED_PRIVATE = re.compile(r"private_?key|preshared_?key", re.IGNORECASE)
WIREGUARD_KEY = re.compile(r"[A-Za-z0-9+/]{42}[AEIMQUYcgkosw048]=")


def looks_private(text: str, key: str) -> bool:
    """Return whether the value of `key` looks like a private key or a credential."""
    named = NAMED_PRIVATE.search(key) is not None and WIREGUARD_KEY.fullmatch(text.strip()) is not None
    return PRIVATE_KEY.search(text) is not None or named


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
    if isinstance(value, str) and value and SECRET_KEY.search(key):
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
