"""Puts measured figures into the page that quotes them, between the two comments that name their command."""

import os
import platform
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "explanation" / "probes-and-links.md"


def host() -> str:
    """What the figures were taken on, and what else ran there."""
    return f"{platform.machine()}, {os.cpu_count()} CPUs, load average {os.getloadavg()[0]:.1f} before"


def quote(command: str, lines: list[str], page: Path = PAGE) -> None:
    """Replace what the page quotes of a command; raises ValueError where the page has no place for it."""
    begin, end = f"<!-- {command} -->\n", f"<!-- end of {command} -->\n"
    text = page.read_text("utf-8")
    before, found, rest = text.partition(begin)
    _, ended, after = rest.partition(end)
    if not found or not ended:
        raise ValueError(f"{page} has no place for the figures of {command}")
    page.write_text(before + begin + "```text\n" + "\n".join(lines) + "\n```\n" + end + after, "utf-8")
