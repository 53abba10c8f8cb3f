"""The engines that may run machines of an application, by every record that may name one; what cannot be read is a doubt."""

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fogspec.base.clouds import LOCAL, cloud_name
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import FogspecError
from fogspec.base.layout import MOST_BYTES, Layout
from fogspec.base.repository import committed
from fogspec.deploy.shared_state import look, store_of
from fogspec.language.loader import SourceFile

UNKNOWN = "unknown"  # a cloud like any other: SkyPilot is asked


@dataclass(frozen=True, slots=True)
class Engines:
    """The clouds that records name, and for each record that cannot be read, why."""

    clouds: frozenset[str]
    doubts: tuple[str, ...]

    @property
    def infra(self) -> list[str]:
        """One infra for each engine to ask: this host always, and SkyPilot for any cloud, also one that only may be named."""
        away = sorted(self.clouds - {LOCAL}) or ([UNKNOWN] if self.doubts else [])
        return [LOCAL, *away[:1]]


def engines_of(layout: Layout) -> Engines:
    """Return what spec, overlay, plan, manifest, live state, journal, and the last commit of all but the last two name.

    A record that is missing is no doubt as long as another one says where machines of the application may be.
    """
    clouds, doubts, known = set[str](), list[str](), False
    overlay = [] if layout.overlay is None else [layout.overlay]
    for path in (layout.spec, *overlay, layout.plan, layout.manifest, layout.live):
        for content in _versions(layout, path, doubts):
            try:
                found = set(_clouds(SourceFile(path, content).plain()))
            except Exception:  # whatever is wrong with one record, the others are read
                doubts.append(f"{path}: cannot be read")
            else:
                clouds |= found
                known = known or bool(found)
    try:
        shared = None if (store := store_of(layout)) is None else look(store, layout)
        held = {cloud_name(one.machine.infra) for one in (shared.spec.machines if shared is not None else ())}
        clouds, known = clouds | held, known or bool(held)
    except (DiagnosticError, FogspecError):
        doubts.append(f"the shared state of {layout.name}: cannot be read")
    clouds |= set(_journaled(layout, doubts))
    if not known:
        doubts.append(f"{layout.spec}: neither it nor a plan says where its machines may be")
    return Engines(frozenset(clouds), tuple(dict.fromkeys(doubts)))


def _versions(layout: Layout, path: Path, doubts: list[str]) -> Iterator[bytes]:
    """Yield the content of a file as it is here and, of what is committed, as it was last committed."""
    if os.path.lexists(path):
        try:
            yield layout.files.read(path, MOST_BYTES)
        except FogspecError as problem:
            doubts.append(problem.message)
        except OSError:
            doubts.append(f"{path}: cannot be read")
    if path != layout.live and (content := committed(layout.root, path)) is not None:
        yield content


def _clouds(value: Any) -> Iterator[str]:
    """Yield the clouds of every `infra` in a document, and of machines that a spec lists."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if key == "infra" or (key == "machines" and isinstance(inner, list)):
                texts = [inner] if isinstance(inner, str) else inner if isinstance(inner, list) else []
                yield from (cloud_name(text) for text in texts if isinstance(text, str))
            if key != "inputs":  # names of files and fields are keys there, `infra` too
                yield from _clouds(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _clouds(inner)


def _journaled(layout: Layout, doubts: list[str]) -> Iterator[str]:
    """Yield the clouds of machines that benches started, by their runners."""
    if not os.path.lexists(layout.journal):
        return
    try:
        lines = layout.files.read(layout.journal, MOST_BYTES).splitlines(keepends=True)
    except FogspecError as problem:
        doubts.append(problem.message)
        return
    except OSError:
        doubts.append(f"{layout.journal}: cannot be read")
        return
    for line in lines:
        try:
            entry = json.loads(line)
            if entry["do"] == "start":
                yield LOCAL if entry["runner"] in (LOCAL, "replay") else UNKNOWN
        except (ValueError, KeyError, TypeError, RecursionError):
            if line.endswith(b"\n"):  # a torn last line describes nothing that had happened
                doubts.append(f"{layout.journal}: cannot be read")
