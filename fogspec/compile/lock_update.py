"""Update locks: keep existing pins, and resolve missing ones."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

from fogspec.base.errors import UsageError
from fogspec.catalog.table import About
from fogspec.language.lockfile import CatalogPin, ImagePin, Pins, differing, image_named, is_pinned
from fogspec.language.schema import Application

ALL = "all"


@dataclass(frozen=True, slots=True)
class LockRequest:
    """An application to lock, with what its lock pins now, the origin of its catalog and the catalog found there."""

    application: Application
    old: Pins | None
    origin: str
    about: About


def relock(wanted: Sequence[LockRequest], digest_of: Callable[[str], str], upgrade: Sequence[str]) -> list[Pins]:
    """Return what each application's lock is to pin.

    `digest_of` queries a registry. `upgrade` names the pins to resolve again: `catalog`, an image as named in a spec, or
    `all`. Raise UsageError for an unknown name in `upgrade`.
    """
    known = {"catalog", ALL, *filter(None, (image_named(one.application) for one in wanted))}
    if unknown := [name for name in upgrade if name not in known]:
        raise UsageError(f"nothing to upgrade is named {', '.join(unknown)}", f"there is: {', '.join(sorted(known))}")
    ask = cache(digest_of)
    return [Pins(catalog=_catalog(one, upgrade), image=_image(one, upgrade, ask)) for one in wanted]


def _catalog(one: LockRequest, upgrade: Sequence[str]) -> CatalogPin:
    old = one.old
    if old is not None and old.catalog.origin == one.origin and not {"catalog", ALL} & set(upgrade):
        return old.catalog
    about = one.about
    return CatalogPin(
        origin=one.origin, source=about.source, revision=about.revision, date=about.date, digest=about.digest
    )


def _image(one: LockRequest, upgrade: Sequence[str], ask: Callable[[str], str]) -> ImagePin | None:
    name, old = image_named(one.application), one.old
    if name is None or is_pinned(name):
        return None
    if old is not None and old.image is not None and old.image.image == name and not {name, ALL} & set(upgrade):
        return old.image
    return ImagePin(image=name, digest=ask(name))


def differences(before: Pins | None, now: Pins) -> list[str]:
    """Return a line for each difference between two locks."""
    old, new = {} if before is None else _flat(before), _flat(now)
    lines = []
    for what in differing(old, new):
        if what not in old:
            lines.append(f"new: {what}: {new[what]}")
        elif what not in new:
            lines.append(f"gone: {what}")
        else:
            lines.append(f"changed: {what}: {old[what]} -> {new[what]}")
    return lines


def _flat(pins: Pins) -> dict[str, str]:
    image = {f"image {pins.image.image}": pins.image.digest} if pins.image else {}
    return {"catalog": f"{pins.catalog.origin} ({pins.catalog.digest})", **image}
