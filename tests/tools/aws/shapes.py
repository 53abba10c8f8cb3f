"""The instance types of the account, in the tables that SkyPilot keeps of AWS.

vCPUs are claimed, not real; memory is bounded where cgroups are, at most at what this machine can give.
"""

from dataclasses import dataclass
from pathlib import Path

REGION = "us-east-1"
ZONES = ("use1-az1", "use1-az2")
IMAGES = {"x86_64": "ami-0f0915dec00000001", "arm64": "ami-0f0915dec00000002"}
SKYPILOTS_IMAGES = {"skypilot:custom-cpu-ubuntu": "x86_64", "skypilot:custom-cpu-ubuntu-arm64": "arm64"}


@dataclass(frozen=True, slots=True)
class Type:
    """An instance type; prices are on demand and spot, in dollars an hour."""

    name: str
    cpus: int
    memory_gib: int
    price: float
    spot_price: float


TYPES = (
    Type("c6i.large", 2, 4, 0.085, 0.034),
    Type("m6i.large", 2, 8, 0.096, 0.038),
    Type("c6i.xlarge", 4, 8, 0.17, 0.068),
    Type("m6i.xlarge", 4, 16, 0.192, 0.077),
    Type("c6i.4xlarge", 16, 32, 0.68, 0.272),
)
BY_NAME = {one.name: one for one in TYPES}
HEAD = (
    "InstanceType,AcceleratorName,AcceleratorCount,vCPUs,MemoryGiB,GpuInfo,Price,SpotPrice,Region,AvailabilityZone,Arch"
)


def write(folder: Path) -> None:
    """Write SkyPilot's tables below `folder`, its `catalogs/v8`."""
    aws, common = folder / "aws", folder / "common"
    for one in (aws, common):
        one.mkdir(parents=True, exist_ok=True)
    rows = [
        f"{one.name},,,{one.cpus},{one.memory_gib},,{one.price},{one.spot_price},{REGION},{zone},x86_64"
        for one in TYPES
        for zone in ZONES
    ]
    (aws / "vms.csv").write_text("\n".join([HEAD, *rows]) + "\n")
    images = [
        f"{tag},{REGION},ubuntu,22.04,{IMAGES[arch]},20260701,{IMAGES[arch]}" for tag, arch in SKYPILOTS_IMAGES.items()
    ]
    (aws / "images.csv").write_text(
        "\n".join(["Tag,Region,OS,OSVersion,ImageId,CreationDate,BaseImageId", *images]) + "\n"
    )
    (aws / "instance_quota_mapping.csv").write_text("InstanceType,OnDemandInstanceCode,SpotInstanceCode\n")
    (common / "accelerators.csv").write_text("AcceleratorName,Clouds\n")


def images() -> list[dict[str, object]]:
    """The images, as moto reads them."""
    return [
        {
            "architecture": arch, "ami_id": ami, "image_location": "amazon/fogspec-test", "image_type": "machine",
            "public": True, "owner_id": "801119661308", "platform": None, "state": "available",
            "description": "a machine image", "hypervisor": "xen", "name": f"fogspec-test-{arch}",
            "root_device_name": "/dev/sda1", "root_device_type": "ebs", "sriov": "simple",
            "virtualization_type": "hvm", "creation_date": "2026-07-01T00:00:00.000Z",
        }
        for arch, ami in IMAGES.items()
    ]  # fmt: skip
