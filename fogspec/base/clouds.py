"""Clouds and clusters, one row each: where they differ, code asks for a field of the row and never for a name."""

import math
import re
from dataclasses import dataclass
from enum import StrEnum

from fogspec.base.units import HOURS_PER_MONTH

LOCAL = "local"
DISK_GIB = 128  # for the machine's own image, at most 50, a container image with its archive, and what set-up installs
# Assumed of disk and address: in a region whose price is not known here, as many times as much as in those of its cloud that
# are; where no price of a cloud is known, as much as the dearest of the others, with SkyPilot's disk of 256 GiB. Where it is
# not known by which time a cloud bills, it is assumed to bill each hour that begins.
ELSEWHERE, UNKNOWN_USD_PER_HOUR, UNKNOWN_STEP_S = 2.0, 0.06, 3600.0
NO_END = ".*"  # SkyPilot cannot let machines there end themselves, and refuses tasks that require it
AZURE_ARM = r"Standard_[A-Z]+\d+(-\d+)?[a-z]*p[a-z]*(_|$)|.*_GB\d"


class OwnEnd(StrEnum):
    """What ends a sample's machine if fogspec does not, besides SkyPilot's autostop, which is armed after boot and copying.

    `AUTOSTOP`: nothing else. `JOB_TIME_LIMIT`: the machine is a batch job with a time limit. `POD_DEADLINE`: it is a pod
    with a deadline. `POWER_OFF`: its first boot sets a timer that turns it off, whereupon the cloud bills its disk only.
    """

    AUTOSTOP = "autostop"
    JOB_TIME_LIMIT = "job time limit"
    POD_DEADLINE = "pod deadline"
    POWER_OFF = "power-off"


@dataclass(frozen=True, slots=True, kw_only=True)
class Cloud:
    """What is special about one cloud or cluster, under SkyPilot's name for it.

    `on_skypilot` is False for this host alone. A cloud that is not `priced` needs no price list, and may have one; one
    without `instance_types` takes the shape of a machine, and the catalog may name it anything. Without
    `containers` SkyPilot starts no images there. A batch system has no spot machines. A cloud that `opens_ports` does so for
    SkyPilot; one that `maps_ports` has them at another address, and often under another number; `open_udp` is a command of the
    cloud's own program that opens a UDP port of the machine at an address; `quota` one that lists the account's quotas in a
    region.
    `places_in_zones`: a zone (a partition) has machines and prices of its own.
    `context_regions`: the region is the name of a context, which may have slashes. `attaches_gpus`: one instance type
    may carry one of several accelerators. `own_end`: see `OwnEnd`. `limits_pods`: SkyPilot limits a pod to what it requests if
    a task says so; otherwise the pod uses what its node has to spare. A new machine may be missing in the cloud's lists for
    `visible_s` seconds. A cloud that `lists_ended` machines does so long enough to tell whether there was one. One that `halts`
    bills the disk alone of a machine that has turned itself off. A machine is billed for `least_s` seconds at least, and for
    each `step_s` that begins (0: by the second; None: not known). Without an image, machines there have the `ubuntu` of this
    code name. `user_variable` tells SkyPilot an image's user where it logs in to the container itself, by default as root.

    With a machine come a disk of `disk_gib`, of SkyPilot's own size if that is None, and a public address. Both are paid beside
    its price: `beside_usd_per_hour` (None: not known) in the regions that match `beside_in`; what others cost is assumed.
    `credits` are patterns of instance types whose CPU may work beyond what is guaranteed, and what that costs at most, in USD
    per vCPU and hour.

    `region`, `zone_id`, `arm` and `family` are patterns: of a region's name; of ids of zones, which SkyPilot takes by the
    account's names for them; of instance types with an Arm CPU; of an instance type
    whose groups are its family's name. So are `accelerated`, `burstable`, `bare_metal`: of instance types with an
    accelerator, even if a price list does not name it, of types whose CPU is guaranteed for part of the time only, and of whole
    servers; `generation`: of a
    family, with the groups `series` and `number` (1 if it is empty); `previous`: of the families that the cloud itself
    calls previous generations; `platform`: of a family, whose groups are the same for all families with the same CPU;
    `unstartable`: of instance types that do not support the disk type, the image or the end that SkyPilot requests for them.
    """

    name: str
    on_skypilot: bool = True
    priced: bool = True
    instance_types: bool = True
    containers: bool = True
    opens_ports: bool = True
    maps_ports: bool = False
    places_in_zones: bool = False
    context_regions: bool = False
    attaches_gpus: bool = False
    own_end: OwnEnd = OwnEnd.AUTOSTOP
    limits_pods: bool = False
    visible_s: float = 0.0
    lists_ended: bool = False
    halts: bool = False
    least_s: float = 0.0
    step_s: float | None = None
    ubuntu: str | None = None
    disk_gib: int | None = None
    beside_usd_per_hour: float | None = None
    beside_in: str = ".*"
    credits: tuple[tuple[str, float], ...] = ()
    open_udp: str | None = None
    quota: str | None = None
    region: str | None = None
    zone_id: str | None = None
    arm: str | None = None
    family: str | None = None
    accelerated: str | None = None
    burstable: str | None = None
    bare_metal: str | None = None
    generation: str | None = None
    previous: str | None = None
    platform: str | None = None
    unstartable: str | None = None
    user_variable: str | None = None

    def beside(self, region: str) -> tuple[float, bool]:
        """Return what a machine's disk and address cost beside the machine, in USD per hour, and whether that is assumed."""
        if self.beside_usd_per_hour is None:
            return UNKNOWN_USD_PER_HOUR, True
        if self.beside_usd_per_hour == 0 or re.fullmatch(self.beside_in, region):
            return self.beside_usd_per_hour, False
        return self.beside_usd_per_hour * ELSEWHERE, True

    def credit_usd_per_hour(self, instance: str, vcpus: float) -> float:
        """Return what it costs beside a machine's price that all of its CPUs work always, where that is not guaranteed."""
        return vcpus * next((usd for pattern, usd in self.credits if re.match(pattern, instance)), 0.0)

    def billed_s(self, paid_s: float) -> float:
        """Return the seconds that are billed for a machine which is there for so long."""
        step_s = UNKNOWN_STEP_S if self.step_s is None else self.step_s
        return max(math.ceil(round(paid_s / step_s, 6)) * step_s if step_s else paid_s, self.least_s)

    def affordable_s(self, billed_s: float) -> float:
        """Return how long a machine may be there that is billed for so many seconds at most."""
        step_s = UNKNOWN_STEP_S if self.step_s is None else self.step_s
        return 0.0 if billed_s < self.least_s else billed_s // step_s * step_s if step_s else billed_s

    def names_region(self, text: str) -> bool:
        """Return whether the text is the name of a region of this cloud, as far as its pattern tells."""
        return self.region is not None and re.fullmatch(self.region, text) is not None


# SkyPilot's names, as of version 0.14 (docs.skypilot.co, "Cloud providers"), in the order in which messages name them.
# Naming schemes: docs.aws.amazon.com/ec2 "Amazon EC2 instance type naming conventions", learn.microsoft.com "Azure
# virtual machine sizes naming conventions", cloud.google.com/compute/docs "CPU platforms" (Arm: T2A, C4A, N4A, A4X).
# Previous generations as of July 2026: aws.amazon.com/ec2/previous-generation and EC2's instance facts; families with a
# date of retirement, learn.microsoft.com/azure/virtual-machines/retirement-notices; the first generation in
# cloud.google.com/compute/docs/machine-resource. Google's families have a CPU each; AWS and Azure repeat a CPU's mark.
# Lists: docs.aws.amazon.com/ec2/latest/devguide/eventual-consistency.html; a terminated instance stays in them for an hour.
# Bills: aws.amazon.com/ec2/pricing/on-demand; cloud.google.com/compute/vm-instance-pricing; Azure's minimum as of June 2025,
# learn.microsoft.com/answers 2259765, and its minutes, which older pages say; docs.lambda.ai/public-cloud/billing;
# docs.runpod.io/accounts-billing; vast.ai/pricing; oracle.com, "Announcing Per-Second Billing" (virtual machines);
# DigitalOcean as of January 2026; support.paperspace.com 360059200753.
# Ubuntu: `sky/clouds` of 0.14.1, its lists of images, and what its images for AWS, Azure and Kubernetes are built from.
# Disks and addresses: AWS gp3 with the 3,500 IOPS and 218 MB/s that SkyPilot asks for, of which 500 and 93 are paid
# (aws.amazon.com/ebs/pricing, aws.amazon.com/vpc/pricing); Google pd-balanced (cloud.google.com/compute/disks-image-pricing,
# cloud.google.com/vpc/network-pricing); Azure P10 (azure.microsoft.com/pricing/details/managed-disks, .../ip-addresses).
# Lambda's prices include both (lambda.ai/pricing); clusters bill neither. SkyPilot starts T3, T3a and T4g as AWS does where
# nothing is said, `unlimited`: surplus credits are paid (aws.amazon.com/ec2/pricing/on-demand, "Unlimited Mode Pricing").
# Not started by SkyPilot 0.14.1: on Google Cloud it requests a `pd-balanced` disk, which series with Hyperdisk alone do not
# support (cloud.google.com/compute/docs/disks/hyperdisks), but for those of which it knows that; on Azure its images are not
# marked for NVMe, which v6 and v7 need (learn.microsoft.com/azure/virtual-machines/nvme-overview); neither has one for Arm.
# Each `open_udp` finds the machine by its address, whatever SkyPilot called its firewall. Azure's opens TCP as well.
_ROWS = (
    Cloud(
        name="aws",
        own_end=OwnEnd.POWER_OFF,
        visible_s=30.0,
        lists_ended=True,
        halts=True,
        least_s=60.0,
        step_s=0.0,
        ubuntu="jammy",
        disk_gib=DISK_GIB,
        beside_usd_per_hour=(0.08 * DISK_GIB + 0.005 * 500 + 0.04 * 93) / HOURS_PER_MONTH + 0.005,
        beside_in="us-east-1|us-east-2|us-west-2",
        credits=((r"t3a?\.", 0.05), (r"t4g\.", 0.04)),
        region=r"[a-z]{2}-(?:gov-)?[a-z]+-\d",
        zone_id=r"[a-z0-9-]+-az\d+",
        arm=r"a1\.|mac2|[a-z]+\d+[a-z]*g[a-z]*(-[^.]*)?\.",
        accelerated=r"(dl|f|g|gr|inf|p|trn|vt)\d",
        burstable=r"t\d|[a-z]\d[a-z]*-flex\.",
        bare_metal=r".*\.metal",
        generation=r"(?P<series>[a-z]+)(?P<number>\d*)",
        previous=r"a1|c[134]|cc2|cr1|d2|hs1|i2|m[1-4]|r[34]|t1",
        platform=r"[a-z]+(\d.*)",
        quota="aws service-quotas list-service-quotas --service-code ec2 --region {region}",
        open_udp=(
            "aws ec2 authorize-security-group-ingress --region {region} --protocol udp --port {port} --cidr 0.0.0.0/0"
            ' --group-id "$(aws ec2 describe-instances --region {region} --filters Name=ip-address,Values={address}'
            " --query 'Reservations[].Instances[].SecurityGroups[0].GroupId' --output text)\""
        ),
    ),
    Cloud(
        name="gcp",
        attaches_gpus=True,
        halts=True,
        least_s=60.0,
        step_s=0.0,
        ubuntu="jammy",
        disk_gib=DISK_GIB,
        beside_usd_per_hour=0.10 * DISK_GIB / HOURS_PER_MONTH + 0.005,
        beside_in="us-central1|us-east1|us-west1",
        region=r"[a-z]+-[a-z]+\d",
        arm=r"(t2a|c4a|n4a|a4x)-",
        accelerated=r"(a2|a3|a4|a4x|g2|g4)-|n1-.*-tpu$|ct\d",
        burstable=r"(f1|g1)-|e2-(micro|small|medium)$",
        bare_metal=r".*-metal$",
        generation=r"(?P<series>[a-z])(?P<number>\d)",
        previous=r"m1|n1",
        platform=r"(.*)",
        unstartable=r"(c4|c4d|c4a|n4d|n4a|h4d|m4|x4|t2a|a4x)-",
        quota="gcloud compute regions describe {region}",
        open_udp=(
            "gcloud compute firewall-rules create fogspec-udp-{port} --allow udp:{port}"
            " --network \"$(gcloud compute instances list --filter 'networkInterfaces[0].accessConfigs[0].natIP={address}'"
            " --format 'value(networkInterfaces[0].network.basename())')\""
        ),
    ),
    Cloud(
        name="azure",
        least_s=300.0,
        step_s=60.0,
        ubuntu="jammy",
        disk_gib=DISK_GIB,
        beside_usd_per_hour=19.71 / HOURS_PER_MONTH + 0.005,
        beside_in="eastus|eastus2|westus2",
        arm=AZURE_ARM,
        family=r"(?:Standard|Basic)_([A-Z]+)\d+(?:-\d+)?([a-z]*)(?:.*_(v\d+))?",
        accelerated=r"Standard_(N|PB)",
        burstable=r"Standard_B",
        generation=r"(?P<series>[A-Z]+)[a-z]*?(?:v(?P<number>\d+))?$",
        previous=r"Am?|Am?v2|Bl?s|Bms|DS?|DS?v2|Fs?|Fsv2|GS?|H|Ls|Lsv2",
        platform=r"[A-Z]+([a-z]*?)(v\d+)?$",
        unstartable=rf".*_v[67]$|{AZURE_ARM}",
        quota="az vm list-usage --location {region} --output table",
        open_udp=(
            "az vm open-port --port {port} --priority 900"
            ' --ids "$(az vm list --show-details --query "[?publicIps==\'{address}\'].id" --output tsv)"'
        ),
    ),
    Cloud(name="oci", containers=False, bare_metal=r"BM\.", least_s=60.0, step_s=0.0),
    Cloud(name="ibm", containers=False, bare_metal=r".*-metal-", opens_ports=False),
    Cloud(name="lambda", step_s=60.0, beside_usd_per_hour=0.0, arm=r".*(gh200|gb\d00)"),
    Cloud(name="runpod", step_s=0.0, maps_ports=True, ubuntu="jammy", user_variable="SKYPILOT_RUNPOD_DOCKER_USERNAME"),
    Cloud(name="nebius", ubuntu="noble"),
    Cloud(name="cudo", containers=False),
    Cloud(name="paperspace", step_s=3600.0),
    Cloud(name="do", least_s=60.0, step_s=0.0),
    Cloud(name="fluidstack", ubuntu="jammy"),
    Cloud(name="vast", step_s=0.0, maps_ports=True),
    Cloud(name="vsphere", containers=False, opens_ports=False, step_s=0.0, beside_usd_per_hour=0.0),
    Cloud(name="scp", containers=False),
    Cloud(
        name="kubernetes",
        step_s=0.0,
        maps_ports=True,
        priced=False,
        instance_types=False,
        context_regions=True,
        own_end=OwnEnd.POD_DEADLINE,
        limits_pods=True,
        ubuntu="jammy",
        beside_usd_per_hour=0.0,
    ),
    Cloud(name="hyperbolic", containers=False, opens_ports=False, unstartable=NO_END),
    Cloud(name="primeintellect", containers=False, unstartable=NO_END),
    Cloud(name="seeweb"),
    Cloud(name="shadeform", containers=False),
    Cloud(
        name="slurm",
        step_s=0.0,
        priced=False,
        instance_types=False,
        containers=False,
        opens_ports=False,
        places_in_zones=True,
        own_end=OwnEnd.JOB_TIME_LIMIT,
        beside_usd_per_hour=0.0,
    ),
    Cloud(
        name="ssh",
        step_s=0.0,
        priced=False,
        instance_types=False,
        maps_ports=True,
        own_end=OwnEnd.POD_DEADLINE,
        ubuntu="jammy",
        beside_usd_per_hour=0.0,
    ),
    Cloud(name="mithril", opens_ports=False),
    Cloud(name="verda", containers=False, opens_ports=False, unstartable=NO_END),
    Cloud(name="yotta", unstartable=NO_END),
    Cloud(name=LOCAL, step_s=0.0, on_skypilot=False, priced=False, instance_types=False, beside_usd_per_hour=0.0),
)
CLOUDS = {row.name: row for row in _ROWS}


def cloud_name(infra: str) -> str:
    """Return the first part of `cloud/region/zone`."""
    return infra.partition("/")[0]


def cloud_of(infra: str) -> Cloud:
    """Return the row of the cloud that an infra names; one that a catalog made up has nothing special, and bills its price."""
    name = cloud_name(infra)
    return CLOUDS.get(name) or Cloud(name=name, step_s=0.0, beside_usd_per_hour=0.0)


def beside(infra: str) -> tuple[float, bool]:
    """Return what disk and address of a machine there cost beside its price, in USD per hour, and whether that is assumed."""
    cloud, place = cloud_of(infra), split_infra(infra)
    return cloud.beside(place[1] if len(place) > 1 else "")


def beside_what(infra: str, instance: str) -> str:
    """Return what is paid beside the price of a machine there, for people; empty if nothing is."""
    if not beside(infra)[0]:
        return ""
    credits = cloud_of(infra).credit_usd_per_hour(instance, 1.0)
    return "disk, address and CPU credits at full load" if credits else "disk and address"


def split_infra(infra: str) -> list[str]:
    """Return cloud, region and zone of an infra, as far as it names them."""
    return infra.split("/", 1 if cloud_of(infra).context_regions else 2)


def is_zone_id(infra: str) -> bool:
    """Return whether `cloud/region/zone` ends in an id of a zone, which SkyPilot takes by the account's name for it."""
    pattern, places = cloud_of(infra).zone_id, split_infra(infra)
    return pattern is not None and len(places) == 3 and re.fullmatch(pattern, places[2]) is not None


def is_zone(infra: str) -> bool:
    """Return whether the zone of `cloud/region/zone` may be one of its region, where a cloud names both alike."""
    cloud, region, zone = split_infra(infra)
    return cloud_of(cloud).region is None or zone.startswith(region)


def quota_command(infra: str) -> str | None:
    """Return the provider's own command that lists the account's quotas at a place; None without one."""
    cloud, (_, *below) = cloud_of(infra), split_infra(infra)
    return None if cloud.quota is None else cloud.quota.format(region=below[0] if below else "REGION")
