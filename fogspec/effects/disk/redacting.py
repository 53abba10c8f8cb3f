"""Keeping secrets out of what is printed: values of named environment variables, and values whose key says so."""

import os
import re
from collections.abc import Iterable, Mapping
from typing import Any

HIDDEN = "(redacted)"
SECRET_KEY = re.compile(
    r"TOKEN|SECRET|PASSW|CREDENTIAL|API_?KEY|ACCESS_?KEY|PRIVATE_?KEY|(^|_)PSK$|(^|_)AUTH$", re.IGNORECASE
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
