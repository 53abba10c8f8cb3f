"""Digests of values, whatever their spelling: the same content gives the same digest."""

import hashlib
import json
from typing import Any


def of_bytes(content: bytes) -> str:
    """Return `sha256:<hex>` of the bytes."""
    return f"sha256:{hashlib.sha256(content).hexdigest()}"


def shorten(digest: str, length: int = 12) -> str:
    """Return the first hexadecimal digits of a `sha256:` digest, enough to tell a few apart."""
    return digest.removeprefix("sha256:")[:length]


def of_value(value: Any) -> str:
    """Return `sha256:<hex>` of a JSON-able value's canonical form: sorted keys, no spaces, no NaN.

    Raises ValueError for a value that JSON cannot represent exactly.
    """
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return of_bytes(text.encode())
