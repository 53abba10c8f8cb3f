"""The machines of the cluster: one node and one partition a shape, priced by partition like an instance type.

CPU counts are claimed, not real: a workload that is measured here has its latency follow the claimed count.
"""

from dataclasses import dataclass

CLUSTER = "fogtest"


@dataclass(frozen=True, slots=True)
class Shape:
    """A node: its name is also its partition's."""

    name: str
    cpus: int
    memory_gib: int
    price_usd_per_hour: float
    gpu: str | None = None

    @property
    def instance(self) -> str:
        """SkyPilot's name for a request of the whole node."""
        gpu = f"--{self.gpu}:1" if self.gpu else ""
        return f"{self.cpus}CPU--{self.memory_gib}GB{gpu}"


SHAPES = (
    Shape("s-1x2", 1, 2, 0.023),
    Shape("c-2x4", 2, 4, 0.085),
    Shape("m-2x16", 2, 16, 0.126),
    Shape("c-16x32", 16, 32, 0.68),
    Shape("c-64x128", 64, 128, 2.72),
    Shape("g-4x16", 4, 16, 0.526, gpu="T4"),
)
HEAD = "Cloud,Region,AvailabilityZone,InstanceType,vCPUs,MemoryGiB,AcceleratorName,AcceleratorCount,Price"


def catalog() -> str:
    """The price list: a catalog table for fogspec."""
    rows = [
        f"slurm,{CLUSTER},{one.name},{one.instance},{one.cpus},{one.memory_gib},{one.gpu or ''},"
        f"{1 if one.gpu else ''},{one.price_usd_per_hour}"
        for one in SHAPES
    ]
    return "\n".join([HEAD, *rows]) + "\n"
