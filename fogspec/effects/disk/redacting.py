"""Secrets: that they are there, and out of what is printed: named environment variables, and values whose key says so."""

import os
import re
from collections.abc import Iterable, Mapping
from typing import Any

from fogspec.base.outcomes import WrongCommand

HIDDEN = "(redacted)"
SECRET_KEY = re.compile(
    r"TOKEN|SECRET|PASSW|CREDENTIAL|API_?KEY|ACCESS_?KEY|PRIVATE_?KEY|(^|_)PSK$|(^|_)AUTH$", re.IGNORECASE
)


def check_set(names: Iterable[str]) -> None:
    """Raises WrongCommand for secrets that the environment does not have: before anything is started, not after."""
    if missing := sorted(name for name in names if name not in os.environ):
        raise WrongCommand(
            f"spec.secrets: the environment does not have {', '.join(missing)}, so nothing was started",
            f"export {' '.join(f'{name}=…' for name in missing)}",
        )


def redacted(value: Any, names: Iterable[str] = (), key: str = "") -> Any:
    """The value, a tree of mappings, lists and scalars, without secrets.

    `names` are environment variables whose values are secrets; what stands under a key that sounds like a secret is
    hidden whatever it is, unless nothing stands there.
    """
    known = [os.environ[name] for name in names if len(os.environ.get(name, "")) > 3]
    return _redacted(value, known, key)


def _redacted(value: Any, known: list[str], key: str) -> Any:
    if isinstance(value, Mapping):
        return {name: _redacted(one, known, str(name)) for name, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_redacted(one, known, key) for one in value]
    if isinstance(value, str) and value and SECRET_KEY.search(key):
        return HIDDEN
    if isinstance(value, str):
        for secret in known:
            value = value.replace(secret, HIDDEN)
    return value
