"""Lists of a machine's packages, as its agent sends them: read as untrusted text, and compared."""

import base64
import binascii
import zlib
from collections.abc import Iterator, Mapping, Sequence

from fogspec.agent.packages import LINE, MOST_BYTES, MOST_PACKAGES
from fogspec.results.schema import ServerFacts


def checked(content: bytes) -> str | None:
    """Return a list as text, sorted; None if there is none or any line is not of a list."""
    if not content or len(content) > MOST_BYTES or not content.isascii():
        return None
    lines = sorted(set(content.decode().splitlines()))
    if len(lines) > MOST_PACKAGES or not all(map(LINE.fullmatch, lines)):
        return None
    return "".join(f"{line}\n" for line in lines)


def unpacked(word: object) -> str | None:
    """Return the list in an agent's report; None if there is none, or it is damaged or too large."""
    if not isinstance(word, str):
        return None
    try:
        unzip = zlib.decompressobj()
        content = unzip.decompress(base64.b64decode(word, validate=True), MOST_BYTES)
    except (binascii.Error, ValueError, zlib.error):
        return None
    return checked(content) if unzip.eof else None


def differences(measured: tuple[ServerFacts, str], running: tuple[ServerFacts, str]) -> list[str]:
    """Return what differs between two machines, each with its list: kernel, driver, then packages.

    As `name before → after`, `none` where it is not installed. A kernel or driver that one did not report is left out.
    """
    found = []
    for name in ("kernel", "driver"):
        before, after = (getattr(server, name) for server, _ in (measured, running))
        if before is not None and after is not None and before != after:
            found.append(f"{name} {before} → {after}")
    return [*found, *_changed(_versions(measured[1]), _versions(running[1]))]


def _versions(text: str) -> dict[tuple[str, str], list[str]]:
    """Return the versions of each package, which may be installed several times."""
    found: dict[tuple[str, str], list[str]] = {}
    for line in text.splitlines():
        kind, name, version = line.split(" ")
        found.setdefault((kind, name), []).append(version)
    return found


def _changed(
    before: Mapping[tuple[str, str], Sequence[str]], after: Mapping[tuple[str, str], Sequence[str]]
) -> Iterator[str]:
    for key in sorted({*before, *after}):
        was, now = (", ".join(versions.get(key, ())) or "none" for versions in (before, after))
        if was != now:
            kind, name = key
            yield f"{'' if kind == 'dpkg' else f'{kind} '}{name} {was} → {now}"
