"""A cache of parsed tables, as columns in the user's cache directory, so that no table is parsed twice.

A file is named by the digest of what was read (the table's bytes, its path and cloud) and of the code that read it: it
cannot be stale, and may be deleted at any time. A file that is damaged or cannot be written costs time only.
"""

import contextlib
import hashlib
import json
import os
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import asdict, fields
from functools import cache
from pathlib import Path

import numpy as np

from fogspec.catalog.table import About, Catalog, strings

KEPT = 24  # files; the least recently used beyond that are removed
READERS = (
    "base/clouds.py",
    "base/csv_table.py",
    "catalog/sources/cache.py",
    "catalog/sources/gcp.py",
    "catalog/sources/parse.py",
    "catalog/table.py",
)
COLUMNS = [field.name for field in fields(Catalog) if field.name != "about"]
FLAGS = ("spot", "burstable")
TEXTS = ("cloud", "region", "zone", "instance", "gpu", "arch", "family")
NUMBERS = tuple(name for name in COLUMNS if name not in FLAGS + TEXTS)


def cached(raw: bytes, path: str, cloud: str | None, read: Callable[[], Catalog]) -> Catalog:
    """Return the result of `read()` for these bytes, from the cache if it is there."""
    key = hashlib.sha256(json.dumps([path, cloud, _code(), hashlib.sha256(raw).hexdigest()]).encode()).hexdigest()
    file = folder() / f"{key}.npz"
    found = _load(file)
    if found is None:
        found = read()
        with contextlib.suppress(OSError):
            _save(file, found)
    return found


def folder() -> Path:
    """Return the directory of the cache, below the user's cache directory (XDG Base Directory Specification)."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if os.path.isabs(base) else Path.home() / ".cache") / "fogspec" / "catalogs"


@cache
def _code() -> str:
    package = Path(__file__).parents[2]
    return hashlib.sha256(b"".join((package / name).read_bytes() for name in READERS)).hexdigest()


def _load(file: Path) -> Catalog | None:
    try:
        with np.load(file, allow_pickle=False) as kept:
            about = json.loads(kept["about"].tobytes())
            codes, numbers, flags = kept["codes"], kept["numbers"], kept["flags"]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    with contextlib.suppress(OSError):
        os.utime(file)
    words = {name: strings(known)[code] for name, known, code in zip(TEXTS, about.pop("words"), codes, strict=True)}
    columns = words | dict(zip(NUMBERS, numbers, strict=True)) | dict(zip(FLAGS, flags, strict=True))
    return Catalog(about=About(**about | {"notes": tuple(about["notes"])}), **columns)


def _save(file: Path, catalog: Catalog) -> None:
    words, codes = [], []
    for name in TEXTS:
        column = getattr(catalog, name).tolist()
        known = {word: number for number, word in enumerate(dict.fromkeys(column))}
        words.append(list(known))
        codes.append(np.fromiter(map(known.__getitem__, column), np.int32, len(column)))
    about = {**asdict(catalog.about), "words": words}
    file.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=file.parent, suffix=".part")
    try:
        with open(handle, "wb") as out:
            np.savez(
                out,
                about=np.frombuffer(json.dumps(about).encode(), dtype=np.uint8),
                codes=np.stack(codes),
                numbers=np.stack([getattr(catalog, name) for name in NUMBERS]),
                flags=np.stack([getattr(catalog, name) for name in FLAGS]),
            )
        os.replace(temporary, file)
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(temporary)
    _tidy(file.parent)


def _tidy(kept: Path) -> None:
    used = {path: path.stat().st_mtime for path in kept.iterdir() if path.suffix in (".npz", ".part")}
    for path in sorted(used, key=used.__getitem__, reverse=True)[KEPT:]:
        path.unlink(missing_ok=True)
