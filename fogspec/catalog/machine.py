"""A machine that can be rented, or a shape of this host: the one type that every file and every stage uses."""

from typing import Annotated

from pydantic import AfterValidator

from fogspec.base.clouds import LOCAL, beside, beside_what, cloud_name, cloud_of
from fogspec.base.quantities import Bounds, Count, Memory, Price, Strict
from fogspec.base.units import shown_price
from fogspec.language.schema import local_shape

TypeKey = tuple[str, str, str, float]  # cloud, instance type, name and count of accelerators


SIZE = AfterValidator(Bounds(1e-12, 1e12).check)


def _price(value: float) -> float:
    return value if value == 0 else Bounds(1e-12, 1e12, " USD/h").check(value)


class Gpu(Strict):
    """Accelerators of a machine: name and count."""

    name: str
    count: Annotated[Count, SIZE]

    @property
    def key(self) -> str:
        """Return `T4:1`, as SkyPilot and the files name accelerators."""
        return f"{self.name}:{self.count:g}"

    @property
    def label(self) -> str:
        """Return `1 T4`, for people."""
        return f"{self.count:g} {self.name}"


class Machine(Strict):
    """A machine by its infra and instance type, with the shape and price that the catalog gave for it.

    A shape of this host has infra `local`, instance `<n>cpu-<m>gib` and price 0.
    """

    infra: str
    instance: str
    cpus: Annotated[Count, SIZE]
    memory: Annotated[Memory, SIZE]
    gpu: Gpu | None = None
    spot: bool = False
    price: Annotated[Price, AfterValidator(_price)]

    @property
    def cloud_name(self) -> str:
        """Return the first part of its infra."""
        return cloud_name(self.infra)

    @property
    def paid_usd_per_hour(self) -> float:
        """Return what it costs with its disk and address, and CPU credits at full load; `price` is without them."""
        if not self.price:
            return 0.0
        credits_usd_per_hour = cloud_of(self.infra).credit_usd_per_hour(self.instance, self.cpus)
        return self.price + beside(self.infra)[0] + credits_usd_per_hour

    @property
    def beside_what(self) -> str:
        """Return `disk and address`, what is paid beside its price; empty if nothing is."""
        return beside_what(self.infra, self.instance) if self.price else ""

    def usd(self, paid_s: float) -> float:
        """Return what it costs while it is there for so long, as its cloud bills: by the second, the minute or the hour."""
        return self.paid_usd_per_hour * cloud_of(self.infra).billed_s(paid_s) / 3600

    @property
    def price_words(self) -> str:
        """Return `$0.085/h, and $0.028/h for disk and address`, or `$0.51/h for each hour that begins, and ...`, for people."""
        step_s, hours = cloud_of(self.infra).step_s, ""
        if self.price and (step_s is None or step_s >= 3600):
            hours = " for each hour that begins" + ", which is assumed," * (step_s is None)
        words = self.beside_words
        return f"{shown_price(self.price)}{hours}, and {words}" if words else f"{shown_price(self.price)}{hours}"

    @property
    def beside_words(self) -> str:
        """Return `$0.028/h for disk and address`, for people; empty where its price includes them."""
        usd_per_hour, is_assumed = beside(self.infra)
        if not usd_per_hour or not self.price:
            return ""
        assumed = ", which is assumed," if is_assumed else ""
        return f"{shown_price(self.paid_usd_per_hour - self.price, 2)}{assumed} for {self.beside_what}"

    @property
    def is_local(self) -> bool:
        """Return whether it is a shape of this host."""
        return self.infra == LOCAL

    @property
    def accelerators(self) -> tuple[str, float]:
        """Return name and count as in the columns of a catalog: `("", 0.0)` without accelerators."""
        return (self.gpu.name, self.gpu.count) if self.gpu else ("", 0.0)

    @property
    def gpu_key(self) -> str | None:
        """Return `T4:1`; None without accelerators."""
        return self.gpu.key if self.gpu else None

    @property
    def identity(self) -> tuple[str, str, str | None, bool]:
        """Return what makes it another machine than one with the same words in its name: infra, instance, GPUs, spot."""
        return self.infra, self.instance, self.gpu_key, self.spot

    @property
    def type_key(self) -> TypeKey:
        """Return the key of its instance type, whatever its place and kind of price."""
        return self.cloud_name, self.instance, *self.accelerators


def host_shape(name: str) -> Machine | None:
    """Return the shape `local/<n>cpu-<m>gib` of this host; None for any other name.

    Its price is 0: a host costs its owner the same, whatever runs on it. A list that its owner wrote may give it one.
    """
    if (found := local_shape(name)) is None:
        return None
    cpus, memory_gib = found
    return Machine(infra=LOCAL, instance=name.removeprefix(f"{LOCAL}/"), cpus=cpus, memory=memory_gib, price=0.0)


class ListedMachine(Machine):
    """A machine in a file that says more of it."""

    @property
    def machine(self) -> Machine:
        """Return the machine without the fields that its file adds."""
        return Machine(**{name: getattr(self, name) for name in Machine.model_fields})
