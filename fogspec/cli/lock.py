"""Implement `fogspec lock`: pin the mutable inputs of a spec to digests."""

import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fogspec.base.console import say, say_json
from fogspec.base.errors import CloudError, OutOfDate
from fogspec.cli.next_steps import next_command, say_next
from fogspec.cli.options import CATALOG, OUTPUT, PRIORS, SPECS, library_from, require_ready

if TYPE_CHECKING:
    from fogspec.backends.images.registry import Registry

SHOWN = 40


@click.command()
@SPECS
@CATALOG
@PRIORS
@OUTPUT
@click.option("--check", is_flag=True, help="write nothing and ask no registry; exit 3 if the lock is incomplete")
@click.option(
    "--upgrade",
    multiple=True,
    metavar="NAME",
    help="resolve again: `catalog`, an image as the spec names it, or `all`; repeatable",
)
def command(
    specs: tuple[str, ...],
    catalog_path: str | None,
    priors: Path | None,
    output: str,
    check: bool,
    upgrade: tuple[str, ...],
) -> None:
    """Write fogspec.lock: catalog, machine library, image digests, and digests of workspace and workload.

    Each APP is a name or a spec, by default all in specs/. Locked entries stay as they are, except for files next to the
    specs, which are read again.
    """
    from fogspec.backends.images.registry import Registry
    from fogspec.base.project_files import ProjectFiles
    from fogspec.catalog.sources import default_origin, load_catalog
    from fogspec.compile import lock_update
    from fogspec.compile.inputs import clouds_of, located
    from fogspec.spec.discover import find_specs
    from fogspec.spec.loader import load
    from fogspec.spec.lock_io import lock_text, read_lock, read_pins
    from fogspec.spec.lockfile import PriorsPin

    library = library_from(priors)
    wanted = []
    loaded = [one for one in load(find_specs(specs)) if one.base is None]
    require_ready(loaded)
    for one in loaded:
        layout = one.layout
        pins = read_pins(layout)
        origin = _origin(catalog_path, layout.root) or (pins.catalog.origin if pins else default_origin(clouds_of(one)))
        about = load_catalog(located(origin, layout), clouds_of(one)).about
        pin = PriorsPin(origin=_beside(priors, layout.root), digest=library.digest) if priors and library else None
        wanted.append(lock_update.LockRequest(one.application, layout, origin, about, pin))
    ask = (lambda _name: "not resolved yet") if check else partial(_digest, Registry())
    locks = lock_update.relock(wanted, ask, ["catalog"] if check else upgrade, whole=not specs)
    changes = {path: lock_update.differences(read_lock(path), lock) for path, lock in locks.items()}
    if not check:
        for path, lock in locks.items():
            files = ProjectFiles(path.parent)
            if changes[path] or not files.is_file(path):
                files.write(path, lock_text(lock).encode())
    _print(changes, output)
    if output == "text" and not check:
        say_next(next_command("compile", *specs))
    if check and any(changes.values()):
        count = sum(map(len, changes.values()))
        raise OutOfDate(
            f"{count} {'thing is' if count == 1 else 'things are'} not as locked", "write the lock: fogspec lock"
        )


def _digest(registry: "Registry", image: str) -> str:
    """Return the digest of an image; without a connection, the error says what needs none."""
    try:
        return registry.digest(image)
    except CloudError as wrong:
        hints = wrong.hints or (
            "run it again with a connection; a proxy is set by HTTPS_PROXY",
            "without one: give the image by its digest in the spec, IMAGE@sha256:...; compile only warns without a lock",
        )
        raise CloudError(wrong.message, *hints) from None


def _origin(catalog: str | None, root: os.PathLike[str]) -> str | None:
    """Return the catalog as the lock names it, with a path relative to the lock."""
    if catalog in (None, "snapshot", "skypilot"):
        return catalog
    return _beside(catalog, root)


def _beside(path: str | os.PathLike[str], root: os.PathLike[str]) -> str:
    return os.path.relpath(path, root).replace(os.sep, "/")


def _print(changes: dict[Path, list[str]], output: str) -> None:
    if output == "json":
        say_json({str(path): lines for path, lines in changes.items()})
        return
    for path, lines in changes.items():
        shown = [*lines[:SHOWN], *([f"and {len(lines) - SHOWN} more"] if len(lines) > SHOWN else [])]
        say(f"{path}: {len(lines)} changes" if lines else f"{path}: complete", *(f"  {one}" for one in shown))
