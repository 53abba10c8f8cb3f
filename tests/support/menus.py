"""Menus as they are in files, for tests."""

from typing import Any


def with_role(menu: dict[str, Any], role: str) -> dict[str, Any] | None:
    """Return the machine of a role in what a file says below `spec`; None if there is none."""
    entries = (*menu.get("front", ()), *menu.get("others", ()))
    return next((one for one in entries if role in one.get("roles", ())), None)
