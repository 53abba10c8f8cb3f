"""Secrets: that they are there, and out of what is printed: named environment variables, and values whose key says so."""

import os
import re
from collections.abc import Iterable, Mapping
from typing import Any

from fogspec.agent.secrecy import Secrets
from fogspec.base.errors import UsageError

HIDDEN = "(redacted)"
SECRET_KEY = re.compile(
    r"TOKEN|SECRET|PASSW|CREDENTIAL|API_?KEY|ACCESS_?KEY|PRIVATE_?KEY|(^|_)PSK$|(^|_)AUTH$", re.IGNORECASE
)


def check_set(names: Iterable[str]) -> None:
    """Raises UsageError for secrets that the environment does not have: before anything is started, not after."""
    if missing := sorted(name for name in names if name not in os.environ):
        raise UsageError(
            f"spec.secrets: the environment does not have {', '.join(missing)}, so nothing was started",
            f"export {' '.join(f'{name}=…' for name in missing)}",
        )


def redacted(value: Any, names: Iterable[str] = (), key: str = "") -> Any:
    """The value, a tree of mappings, lists and scalars, without secrets.

    `names` are environment variables whose values are secrets; what stands under a key that sounds like a secret is
    hidden whatever it is, unless nothing stands there.
    """
    return _redacted(value, Secrets.of(names), key)


def _redacted(value: Any, known: Secrets, key: str) -> Any:
    if isinstance(value, Mapping):
        return {name: _redacted(one, known, str(name)) for name, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_redacted(one, known, key) for one in value]
    if isinstance(value, str) and value and SECRET_KEY.search(key):
        return HIDDEN
    return known.out_of(value) if isinstance(value, str) else value
