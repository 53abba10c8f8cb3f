"""Candidates for a deployment: their prices now, and the digests of their images."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from fogspec.backends.protocol import Work
from fogspec.base import units
from fogspec.base.clouds import cloud_of
from fogspec.base.errors import Refused
from fogspec.catalog.machine import Machine
from fogspec.language.lockfile import image_of, is_pinned


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A machine that may be launched with the reviewed work and task: the manifest's own, or one of its fallbacks.

    `number` counts the machines before it, `runs` is the digest of all that the machine is given; `now_usd_per_hour` is
    its price now, None if the catalog does not have it. It may cost at most `cap_usd_per_hour`: the approved price, or what
    the caller allows.
    """

    number: int
    machine: Machine
    work: Work
    task: Mapping[str, Any]
    runs: str
    approved_usd_per_hour: float
    now_usd_per_hour: float | None = None
    cap_usd_per_hour: float | None = None

    @property
    def price_usd_per_hour(self) -> float:
        """The price that it will cost."""
        return self.approved_usd_per_hour if self.now_usd_per_hour is None else self.now_usd_per_hour


def check_price(one: Candidate, limit_usd_per_hour: float | None, most_usd_per_hour: float | None, source: str) -> None:
    """Raise Refused for a machine that costs more than was approved, or than the caller or the spec allows.

    `most_usd_per_hour` is the price that the caller allows, in place of the approved one.
    """
    if one.now_usd_per_hour is None:
        raise Refused(f"{_named(one)}: is not on offer in {source}", "what it costs cannot be said: compile again")
    cap = one.approved_usd_per_hour if most_usd_per_hour is None else most_usd_per_hour
    now = one.now_usd_per_hour
    if limit_usd_per_hour is not None and now > limit_usd_per_hour * (1 + 1e-9):
        price, limit = units.shown_apart(now, limit_usd_per_hour, units.shown_price)
        raise Refused(
            f"{_named(one)}: costs {price} now, over the limit of {limit}",
            "spec.constraints.price is hard: compile again with these prices",
        )
    if now > cap * (1 + 1e-9):
        bound = "--max" if most_usd_per_hour is not None else "the approved price"
        price, most = units.shown_apart(now, cap, units.shown_price)
        raise Refused(
            f"{_named(one)}: costs {price} now in {source}, {bound} is {most}",
            f"compile again with these prices, or allow it: --max '{units.format_price(now)}'",
        )


def affordable(one: Candidate, limit_usd_per_hour: float | None, most_usd_per_hour: float | None) -> bool:
    """Return whether `check_price` accepts it."""
    try:
        check_price(one, limit_usd_per_hour, most_usd_per_hour, "")
    except Refused:
        return False
    return True


def exact(
    task: Mapping[str, Any], infra: str, image: str | None, resolve: bool, ask: Callable[[str], str]
) -> tuple[Mapping[str, Any], str | None]:
    """Return the task with its image pinned by digest, and that image; raise Refused for a tag, unless `resolve`.

    Without containers, the task has no image.
    """
    cloud = cloud_of(infra)
    if image is None or not (cloud.on_skypilot and cloud.containers):
        return task, None
    if is_pinned(image):
        return task, image
    if not resolve:
        raise Refused(
            f"image {image} is not pinned: what would run may be something else than what was measured",
            "pin it and review the manifest again: fogspec lock, fogspec compile",
            "or launch what the tag stands for now: --resolve-image",
        )
    found = f"{image_of(image).name}@{ask(image)}"
    resources = {**task["resources"], "image_id": f"docker:{found}"}
    return {**task, "resources": resources}, found


def cost_words(one: Candidate) -> str:
    """Return what its machine costs per hour, at its price now, and per month, with disk and address."""
    machine = one.machine.model_copy(update={"price": one.price_usd_per_hour})
    together = " together" if machine.paid_usd_per_hour > machine.price else ""
    return f"{machine.price_words}, {units.shown_month(machine.paid_usd_per_hour * units.HOURS_PER_MONTH)}{together}"


def _named(one: Candidate) -> str:
    return f"{one.machine.instance} in {one.machine.infra}"
