"""One row a cloud: what differs between them is a field."""

import re

import pytest

from fogspec.base.clouds import CLOUDS, LOCAL, beside, cloud_name, cloud_of, split_infra
from fogspec.catalog.machine import Machine
from tests.support.catalogs import table


def test_every_pattern_compiles_and_every_command_names_its_port() -> None:
    for cloud in CLOUDS.values():
        for pattern in filter(None, (cloud.region, cloud.arm, cloud.family)):
            re.compile(pattern)
        if cloud.open_udp is not None:
            assert "4242" in cloud.open_udp.format(region="r", address="192.0.2.1", port=4242)


def test_a_cloud_that_only_a_catalog_knows_is_an_ordinary_one() -> None:
    assert cloud_of("our-rack/hall-2") == cloud_of("our-rack")
    assert (cloud_of("our-rack").name, cloud_of("our-rack").priced) == ("our-rack", True)


def test_only_this_host_is_not_on_skypilot() -> None:
    assert [cloud.name for cloud in CLOUDS.values() if not cloud.on_skypilot] == [LOCAL]


@pytest.mark.parametrize(
    ("infra", "parts"),
    [
        ("aws", ["aws"]),
        ("aws/us-east-1/us-east-1a", ["aws", "us-east-1", "us-east-1a"]),
        ("kubernetes/arn:aws:eks/a/b", ["kubernetes", "arn:aws:eks/a/b"]),
        ("slurm/cluster/partition", ["slurm", "cluster", "partition"]),
    ],
)
def test_an_infra_is_split_as_its_cloud_writes_it(infra: str, parts: list[str]) -> None:
    assert split_infra(infra) == parts
    assert cloud_name(infra) == parts[0]


@pytest.mark.parametrize(("region", "owner"), [("us-east-1", "aws"), ("us-gov-west-1", "aws"), ("europe-west4", "gcp")])
def test_a_region_names_its_cloud(region: str, owner: str) -> None:
    assert [cloud.name for cloud in CLOUDS.values() if cloud.names_region(region)] == [owner]


@pytest.mark.parametrize(
    ("infra", "usd_per_month"),
    [
        ("aws/us-east-1", 128 * 0.08 + 2.5 + 3.72 + 3.65),
        ("aws/us-east-1/us-east-1a", 128 * 0.08 + 2.5 + 3.72 + 3.65),
        (
            "aws/sa-east-1",
            2 * (128 * 0.08 + 2.5 + 3.72 + 3.65),
        ),
        ("gcp/us-central1", 128 * 0.1 + 3.65),
        ("azure/eastus", 19.71 + 3.65),
        ("vast/somewhere", 43.8),
        ("lambda/us-east-1", 0.0),
        ("kubernetes/a/b", 0.0),
        ("slurm/cluster/partition", 0.0),
        ("our-rack/hall-2", 0.0),
        ("local", 0.0),
    ],
)
def test_disk_and_address_cost_what_their_lists_say(infra: str, usd_per_month: float) -> None:
    usd_per_hour, is_assumed = beside(infra)
    assert usd_per_hour * 730 == pytest.approx(usd_per_month)
    assert is_assumed == (infra in ("aws/sa-east-1", "vast/somewhere"))


def test_nothing_known_costs_less_than_the_dearest_of_what_is_known() -> None:
    """Of disks of SkyPilot's 256 GiB in the regions whose price is known: Azure's is P15."""
    known = {
        "aws": (256 * 0.08 + 2.5 + 3.72 + 3.65) / 730,
        "gcp": (256 * 0.1 + 3.65) / 730,
        "azure": (38.02 + 3.65) / 730,
    }
    assert max(known.values()) <= beside("vast/anywhere")[0] < 1.1 * max(known.values())


@pytest.mark.parametrize(
    ("instance", "usd_per_vcpu_hour"),
    [("t3.large", 0.05), ("t3a.micro", 0.05), ("t4g.small", 0.04), ("t2.micro", 0.0), ("c7i-flex.large", 0.0)],
)
def test_the_cpu_credits_of_burstable_machines_are_paid_at_full_load(instance: str, usd_per_vcpu_hour: float) -> None:
    """SkyPilot starts T3, T3a and T4g "unlimited"; a T2 is not, and flex types have no credits."""
    one = Machine(infra="aws/us-east-1", instance=instance, cpus=2, memory=8.0, price=0.0832)
    disk = beside(one.infra)[0]
    assert one.paid_usd_per_hour == pytest.approx(0.0832 + disk + 2 * usd_per_vcpu_hour)
    every = table(f"{instance},,,2,8,0.0832,,us-east-1,")
    assert every.paid_usd_per_hour.tolist() == pytest.approx([one.paid_usd_per_hour])
    assert (" and CPU credits at full load" in one.price_words) == (usd_per_vcpu_hour > 0)
    assert (
        Machine(infra="gcp/us-central1", instance=instance, cpus=2, memory=8.0, price=1.0).beside_what
        == "disk and address"
    )
