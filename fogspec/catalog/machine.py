"""The words for a machine that can be rented: its shape, where it is, and what it costs."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, order=True)
class Gpu:
    """Accelerators of one machine: SkyPilot's name, such as T4, and how many."""

    name: str
    count: float = 1


@dataclass(frozen=True, slots=True)
class Offer:
    """One machine on offer: an instance type in one place at one price; spot is an offer of its own."""

    infra: str
    instance: str
    vcpus: float
    memory_gib: float
    price_usd_per_hour: float
    gpu: Gpu | None = None
    arch: str = "x86_64"
    family: str = ""
    spot: bool = False
