"""One row a cloud: what differs between them is a field."""

import re

import pytest

from fogspec.base.clouds import CLOUDS, LOCAL, beside, cloud_name, cloud_of, split_infra


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
