"""Catalogs and specs that several tests are made from."""

from collections.abc import Mapping, Sequence
from typing import Any

from fogspec.catalog.sources.parse import read
from fogspec.catalog.table import About, Catalog
from fogspec.language.schema import Application

HEAD = "InstanceType,AcceleratorName,AcceleratorCount,vCPUs,MemoryGiB,Price,SpotPrice,Region,AvailabilityZone"
PAPER_HARDWARE = {
    "cpus": "2..64",
    "memory": "4GiB..512GiB",
    "memory_per_cpu": "2GiB..8GiB",
    "allow": ["c6i.*", "m6i.*", "r6i.*"],
}


def table(*rows: str, head: str = HEAD, cloud: str = "aws") -> Catalog:
    """The catalog of these CSV lines."""
    return read("\n".join([head, *rows, ""]).encode(), "offers.csv", cloud, About("test", "1", "2026-01-01", ""))


def application(
    hardware: Mapping[str, Any] | None = None, infra: Sequence[str] = ("aws/us-east-1",), **benchmark: Any
) -> Application:
    """A spec with one node and this hardware."""
    return Application.model_validate(
        {
            "apiVersion": "fogspec.dev/v1alpha1",
            "kind": "Application",
            "metadata": {"name": "demo"},
            "spec": {
                "cloud": [{"cmd": ["./node"]}],
                "probe": {"callback": "plan"},
                "hardware": dict(hardware or {}),
                "infra": list(infra),
                "benchmark": {"sampler": "grid"} | benchmark,
            },
        }
    )
