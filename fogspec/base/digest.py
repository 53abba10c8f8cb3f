"""Digests of values, whatever their spelling: the same content gives the same digest."""

import base64
import hashlib
import json
import re
from typing import Any


def of_bytes(content: bytes) -> str:
    """Return `sha256:<hex>` of the bytes."""
    return f"sha256:{hashlib.sha256(content).hexdigest()}"


def shorten(digest: str, length: int = 12) -> str:
    """Return the first hexadecimal digits of a `sha256:` digest, enough to tell a few apart."""
    return digest.removeprefix("sha256:")[:length]


def as_label(digest: str) -> str | None:
    """Return a `sha256:` digest in lower-case letters and digits, whole: clouds allow 63 of `[a-z0-9-]`; None for no digest."""
    if not re.fullmatch("sha256:[0-9a-f]{64}", digest):
        return None
    return base64.b32encode(bytes.fromhex(digest.removeprefix("sha256:"))).decode().rstrip("=").lower()


def from_label(text: str) -> str | None:
    """Return the digest that `as_label` made a label of; None for any other text."""
    try:
        content = base64.b32decode(f"{text.upper()}====")
    except ValueError:
        return None
    return f"sha256:{content.hex()}" if len(content) == hashlib.sha256().digest_size else None


def of_value(value: Any) -> str:
    """Return `sha256:<hex>` of a JSON-able value's canonical form: sorted keys, no spaces, no NaN.

    Raises ValueError for a value that JSON cannot represent exactly.
    """
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return of_bytes(text.encode())
