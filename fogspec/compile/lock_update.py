"""Update the lock: keep existing pins, resolve missing ones, and digest the files next to the specs again."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from fogspec.base.errors import UsageError
from fogspec.base.layout import Layout
from fogspec.catalog.table import About
from fogspec.spec.lock_io import files_sent, read_lock, read_pins
from fogspec.spec.lockfile import CatalogPin, ImagePin, Lock, LockBody, Pins, PriorsPin, image_named, is_pinned
from fogspec.spec.schema import Application

ALL = "all"


@dataclass(frozen=True, slots=True)
class LockRequest:
    """An application to lock, with the origin of its catalog and the catalog found there.

    `priors` is the machine library that `--priors` names; None keeps the locked one.
    """

    application: Application
    layout: Layout
    origin: str
    about: About
    priors: PriorsPin | None = None


def relock(
    wanted: Sequence[LockRequest], digest_of: Callable[[str], str], upgrade: Sequence[str], whole: bool
) -> dict[Path, Lock]:
    """Return the updated locks by path, one for each project.

    `digest_of` queries a registry. `upgrade` names the pins to resolve again: `catalog`, an image as named in a spec, or
    `all`. If `whole`, these are all applications and pins of others are dropped. Raise UsageError for an unknown name in
    `upgrade`.
    """
    known = {"catalog", ALL, *filter(None, (image_named(one.application) for one in wanted))}
    if unknown := [name for name in upgrade if name not in known]:
        raise UsageError(f"nothing to upgrade is named {', '.join(unknown)}", f"there is: {', '.join(sorted(known))}")
    ask = cache(digest_of)
    found: dict[Path, dict[str, Pins]] = {}
    for one in wanted:
        path, name = one.layout.lock, one.layout.name
        old = read_pins(one.layout)
        if path not in found:
            before = None if whole else read_lock(path)
            found[path] = dict(before.spec.applications) if before else {}
        image = _image(one.application, old, upgrade, ask)
        files = files_sent(one.application, one.layout)
        found[path][name] = Pins(
            catalog=_catalog(one, old, upgrade),
            image=image,
            priors=one.priors or (old.priors if old else None),
            files=files,
        )
    return {path: Lock(spec=LockBody(applications=pins)) for path, pins in found.items()}


def _catalog(one: LockRequest, old: Pins | None, upgrade: Sequence[str]) -> CatalogPin:
    if old is not None and old.catalog.origin == one.origin and not {"catalog", ALL} & set(upgrade):
        return old.catalog
    about = one.about
    return CatalogPin(
        origin=one.origin, source=about.source, revision=about.revision, date=about.date, digest=about.digest
    )


def _image(
    application: Application, old: Pins | None, upgrade: Sequence[str], ask: Callable[[str], str]
) -> ImagePin | None:
    name = image_named(application)
    if name is None or is_pinned(name):
        return None
    if old is not None and old.image is not None and old.image.image == name and not {name, ALL} & set(upgrade):
        return old.image
    return ImagePin(image=name, digest=ask(name))


def differences(before: Lock | None, now: Lock) -> list[str]:
    """Return a line for each difference between two locks."""
    old = before.spec.applications if before else {}
    new = now.spec.applications
    lines = []
    for name in sorted(old.keys() | new.keys()):
        was, is_ = _flat(old.get(name)), _flat(new.get(name))
        for what in sorted(was.keys() | is_.keys()):
            if was.get(what) == is_.get(what):
                continue
            if what not in was:
                lines.append(f"new: {name}: {what}: {is_[what]}")
            elif what not in is_:
                lines.append(f"gone: {name}: {what}")
            else:
                lines.append(f"changed: {name}: {what}: {was[what]} -> {is_[what]}")
    return lines


def _flat(pins: Pins | None) -> dict[str, str]:
    if pins is None:
        return {}
    image = {f"image {pins.image.image}": pins.image.digest} if pins.image else {}
    priors = {"priors": f"{pins.priors.origin} ({pins.priors.digest})"} if pins.priors else {}
    return {"catalog": f"{pins.catalog.origin} ({pins.catalog.digest})", **image, **priors, **pins.files}
