"""What the on-machine agent said of a sample: untrusted, so read with limits and checked value by value."""

import json
import os
from pathlib import Path
from typing import Any, get_args

from fogspec.results.schema import Reason

OUTCOME_LIMIT = 64 * 2**10
TEXT_LIMIT = 500
LONGEST_S = 1e9


def read(path: Path) -> dict[str, Any] | None:
    """The agent's outcome, as far as its values are of the right kind; None where there is none."""
    try:
        with open(path, "rb", opener=_plainly) as file:
            said = json.loads(file.read(OUTCOME_LIMIT))
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(said, dict):
        return None
    checked: dict[str, Any] = {"reason": said.get("reason") if said.get("reason") in get_args(Reason) else None}
    for key in ("setup_s", "waited_s", "duration_s"):
        value = said.get(key)
        checked[key] = float(value) if isinstance(value, (int, float)) and 0 <= value < LONGEST_S else None
    for key in ("detail", "stopped_by"):
        value = said.get(key)
        checked[key] = value[:TEXT_LIMIT] if isinstance(value, str) else None
    return checked


def _plainly(path: str, flags: int) -> int:
    """Open without following a link or waiting for a pipe."""
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK)
