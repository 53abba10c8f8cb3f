"""Implement `fogspec lock`: pin the mutable inputs of a spec to digests."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fogspec.base.console import say, say_json
from fogspec.base.errors import CloudError
from fogspec.base.text import count
from fogspec.cli.next_steps import next_command, say_next
from fogspec.cli.options import CATALOG, OUTPUT, SPECS, require_ready

if TYPE_CHECKING:
    from fogspec.backends.images.registry import Registry

SHOWN = 40


@click.command()
@SPECS
@CATALOG
@OUTPUT
@click.option(
    "--upgrade",
    multiple=True,
    metavar="NAME",
    help="resolve again: `catalog`, an image as the spec names it, or `all`; repeatable",
)
def command(
    specs: tuple[str, ...],
    catalog_path: str | None,
    output: str,
    upgrade: tuple[str, ...],
) -> None:
    """Write NAME.lock beside each spec: digests of its catalog and its image.

    Each APP is a name or a spec, by default all in specs/. What is locked stays as it is. Environments share the lock of
    their application.
    """
    from fogspec.backends.images.registry import Registry
    from fogspec.catalog.sources import default_origin, load_catalog, serves
    from fogspec.compile import lock_update
    from fogspec.compile.inputs import check_inside, clouds_of, located, origin_of
    from fogspec.language.discover import find_specs
    from fogspec.language.loader import load
    from fogspec.language.lock_io import lock_text, read_pins

    wanted = []
    loaded = [one for one in load(find_specs(specs)) if one.base is None]
    require_ready(loaded)
    for one in loaded:
        layout = one.layout
        pins = read_pins(layout)
        origin = origin_of(catalog_path, layout.root)
        if origin is None and pins and serves(pins.catalog.origin, clouds_of(one)):
            origin = pins.catalog.origin
            check_inside(layout.lock, f"price list {origin}", origin, layout, "lock", "--catalog")
        origin = origin or default_origin(clouds_of(one))
        about = load_catalog(located(origin, layout), clouds_of(one), one.application.spec.benchmark.machines).about
        wanted.append(lock_update.LockRequest(one.application, pins, origin, about))
    locked = lock_update.relock(wanted, partial(_digest, Registry()), upgrade)
    changes = dict[Path, list[str]]()
    for layout, request, now in zip((one.layout for one in loaded), wanted, locked, strict=True):
        changes[layout.lock] = lock_update.differences(request.old, now)
        if changes[layout.lock]:
            layout.beside_spec.write(layout.lock, lock_text(now).encode())
    _print(changes, output)
    if output == "text":
        say_next(next_command("compile", *specs))


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


def _print(changes: dict[Path, list[str]], output: str) -> None:
    if output == "json":
        say_json({str(path): lines for path, lines in changes.items()})
        return
    for path, lines in changes.items():
        shown = [*lines[:SHOWN], *([f"and {len(lines) - SHOWN} more"] if len(lines) > SHOWN else [])]
        say(f"{path}: {count(len(lines), 'change')}" if lines else f"{path}: complete", *(f"  {one}" for one in shown))
