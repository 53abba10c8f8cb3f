"""The funnel: which offers a spec admits, and what each filter removed."""

import numpy as np
import pytest

from fogspec.base.units import Range
from fogspec.catalog.filters import filter_offers, gpu_type, matches_gpu, matches_infra, matches_names
from fogspec.catalog.machine import Gpu
from fogspec.catalog.table import About, Catalog, strings
from fogspec.language.schema import Hardware
from tests.support.catalogs import table
from tests.support.relative import work_of

OFFERS = (
    "c6i.large,,,2,4,0.085,0.03,us-east-1,use1-az1",
    "c6i.large,,,2,4,0.085,0.04,us-east-1,use1-az2",
    "c6i.large,,,2,4,0.106,,us-west-1,usw1-az1",
    "c7g.large,,,2,4,0.0725,,us-east-1,use1-az1",
    "g4dn.xlarge,T4,1,4,16,0.526,,us-east-1,use1-az1",
    "g4dn.12xlarge,T4,4,48,192,3.912,,us-east-1,use1-az1",
    "m6i.large,,,2,8,0.096,,us-east-1,use1-az1",
)


def names(catalog: Catalog) -> list[str]:
    return sorted(str(name) for name in catalog.instance)


@pytest.mark.parametrize(
    ("hardware", "infra", "left"),
    [
        (Hardware(), ["aws/us-east-1"], ["c6i.large", "m6i.large"]),
        (Hardware(), ["aws"], ["c6i.large", "c6i.large", "m6i.large"]),
        (Hardware(), ["AWS/us-west-1"], ["c6i.large"]),
        (Hardware(), ["*/us-west-1", "aws/us-east-1"], ["c6i.large", "c6i.large", "m6i.large"]),
        (Hardware(), ["gcp"], []),
        (Hardware(arch=["arm64"]), ["aws"], ["c7g.large"]),
        (Hardware(gpus=["T4"]), ["aws"], ["g4dn.xlarge"]),
        (Hardware(gpus=["t4:4", "none"]), ["aws/us-east-1"], ["c6i.large", "g4dn.12xlarge", "m6i.large"]),
        (Hardware(spot=True), ["aws/us-east-1"], ["c6i.large", "c6i.large", "m6i.large"]),
        (Hardware(memory_per_cpu=Range(4, 8)), ["aws"], ["m6i.large"]),
        (Hardware(memory=Range(None, 4)), ["aws/us-east-1"], ["c6i.large"]),
        (Hardware(allow=["c6i.*"]), ["aws/us-east-1"], ["c6i.large"]),
        (Hardware(deny=["c6?.*", "m*"]), ["aws/us-east-1"], ["c6i.large"]),
    ],
)  # fmt: skip
def test_what_is_admitted(hardware: Hardware, infra: list[str], left: list[str]) -> None:
    assert names(filter_offers(table(*OFFERS), hardware, infra).offers) == left


def test_the_funnel_counts_what_each_filter_removed() -> None:
    funnel = filter_offers(table(*OFFERS), Hardware(cpus=Range(2, 2)), ["aws/us-east-1"]).funnel
    assert (funnel.offered, funnel.admitted) == (9, 2)
    assert {step.name: step.removed for step in funnel.filters if step.removed} == {
        "infra": 1, "hardware.spot": 2, "hardware.arch": 1, "hardware.gpus": 2, "zones of one region merged": 1,
    }  # fmt: skip
    assert sum(step.removed for step in funnel.filters) == funnel.offered - funnel.admitted
    assert funnel.line().startswith("9 offers -> 8 after infra -> 6 after hardware.spot")


def test_zones_merge_at_their_highest_price_unless_named() -> None:
    catalog, spot = table(*OFFERS), Hardware(spot=True, allow=["c6i.*"])
    merged = filter_offers(catalog, spot, ["aws/us-east-1"]).offers
    assert merged.price_usd_per_hour.tolist() == [0.085, 0.04]
    assert set(merged.zone) == {""}
    named = filter_offers(catalog, spot, ["aws/us-east-1/use1-az1"]).offers
    assert named.price_usd_per_hour.tolist() == [0.085, 0.03]
    assert set(named.zone) == {"use1-az1"}
    both = filter_offers(catalog, spot, ["aws/us-east-1/use1-az1", "aws/us-east-1"]).offers
    assert both.price_usd_per_hour.tolist() == [0.085, 0.04]


def test_bounds_forgive_what_units_round() -> None:
    catalog = table("m.large,,,2,8,1,,r,")
    eight_gib_in_gb = 8.589934592 * (1e9 / 2**30)
    assert len(filter_offers(catalog, Hardware(memory=Range(eight_gib_in_gb, eight_gib_in_gb)), ["aws"]).offers) == 1


def test_the_words_for_accelerators() -> None:
    assert gpu_type("none") is None
    assert gpu_type("T4") == gpu_type("T4:1") == Gpu(name="T4", count=1)
    catalog = table(*OFFERS)
    assert matches_gpu(catalog, "T4:4").sum() == 1
    assert matches_infra(catalog, "aws/us-east-1/use1-az2").sum() == 2
    assert matches_names(catalog, ["*.large", "[cm]6i.*"]).sum() == 7


def test_fifty_thousand_offers_are_little_work() -> None:
    n = 50_000
    rng = np.random.default_rng(7)
    vcpus = rng.choice([2.0, 4, 8, 16, 32, 64, 96], n)
    words = strings([""] * n)
    catalog = Catalog(
        about=About("test", "", "", ""), cloud=strings(["aws"] * n), zone=words, gpu=words, family=words,
        region=strings(rng.choice(["us-east-1", "us-west-1", "eu-west-1"], n).tolist()),
        instance=strings([f"c{i}.large" for i in range(n)]), vcpus=vcpus, memory_gib=vcpus * rng.choice([2.0, 4, 8], n),
        gpu_count=np.zeros(n), gpu_memory_gib=np.full(n, np.nan), price_usd_per_hour=rng.uniform(0.1, 9, n),
        spot=np.zeros(n, dtype=np.bool_), arch=strings(["x86_64"] * n), physical_cores=vcpus / 2,
        clock_ghz=np.full(n, 3.0), burstable=np.zeros(n, dtype=np.bool_),
    )  # fmt: skip
    wanted = Hardware(cpus=Range(2, 64), deny=["c1.*"])
    assert filter_offers(catalog, wanted, ["aws"]).funnel.admitted > 30_000
    assert work_of(lambda: filter_offers(catalog, wanted, ["aws"]), 3) < 60
