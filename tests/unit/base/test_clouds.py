"""One row a cloud: what differs between them is a field."""

import re

import pytest

from fogspec.base.clouds import CLOUDS, LOCAL, cloud_name, cloud_of, split_infra


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
