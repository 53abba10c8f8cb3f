"""Which machines are candidates by default, told from names and from what else is on offer."""

import pytest

from fogspec.base.errors import InvalidInput
from fogspec.catalog.classes import accelerated, burstable, cpu_kind, left_out, platforms
from fogspec.catalog.filters import filter_offers, offers_for
from fogspec.catalog.sources import load_catalog
from fogspec.language.schema import Hardware, Ros
from fogspec.plan.design import design
from tests.conftest import SHARED
from tests.support.catalogs import application, table

FAMILIES = ["t3", "m4", "m5", "m6i", "m6a", "m7i", "m8i", "c5", "c6i", "c7i-flex", "f2", "vt1", "z1d"]
OFFERS = [f"{family}.large,,,2,8,0.1,,us-east-1,a" for family in FAMILIES]
T4 = "g4dn.xlarge,T4,1,4,16,0.526,,us-east-1,a"


def names(*rows: str, hardware: Hardware | None = None, infra: str = "aws", cloud: str = "aws") -> list[str]:
    offers = filter_offers(table(*rows, cloud=cloud), hardware or Hardware(), [infra]).offers
    return [str(name).removesuffix(".large") for name in offers.instance]


def test_by_default_machines_are_current_with_a_cpu_of_their_own_and_nothing_else() -> None:
    assert names(*OFFERS, T4) == ["c5", "c6i", "m6a", "m6i", "m7i", "m8i", "z1d"], "c5 has one newer, m5 three"
    found = filter_offers(table(*OFFERS, T4), Hardware(), ["aws"])
    assert dict(found.left_out) == {"previous-generation": 2, "burstable": 2}
    assert found.left_out_line() == (
        "left out: 2 previous-generation, 2 burstable; "
        "to admit them: spec.hardware.allow: [standard, previous-generation, burstable]"
    )


def test_what_other_fields_exclude_is_not_counted_as_left_out() -> None:
    large = Hardware.model_validate({"cpus": "4.."})
    assert not filter_offers(table(*OFFERS, "m6i.xlarge,,,4,16,0.2,,us-east-1,a"), large, ["aws"]).left_out


@pytest.mark.parametrize(
    ("allow", "more"),
    [
        (["standard", "burstable"], {"t3", "c7i-flex"}),
        (["standard", "previous-generation", "burstable"], {"t3", "c7i-flex", "m4", "m5"}),
        (["standard", "m5.*", "t3.*", "f2.*"], {"m5", "t3"}),
    ],
)
def test_allow_admits_the_classes_and_names_that_it_lists(allow: list[str], more: set[str]) -> None:
    found = set(names(*OFFERS, hardware=Hardware(allow=allow)))
    assert found - set(names(*OFFERS)) == more
    assert "f2" not in found, "no accelerator is no accelerator"


@pytest.mark.parametrize(
    ("cloud", "left"),
    [("aws", ["c7a"]), ("runpod", ["c7a"]), ("slurm", ["c7a", "c7a.medium"]), ("rack", ["c7a", "c7a.medium"])],
)
def test_a_clouds_machine_with_little_memory_is_measured_when_asked_for(cloud: str, left: list[str]) -> None:
    """SkyPilot takes up to 1 GiB of it; the shape of a job is meant, and who writes a price list chose its machines."""
    rows = ["c7a.medium,,,1,2,0.05,,r1,", "c7a.large,,,2,4,0.1,,r1,"]
    assert names(*rows, infra=cloud, cloud=cloud) == left
    asked = Hardware(allow=["standard", "low-memory"])
    assert names(*rows, infra=cloud, cloud=cloud, hardware=asked) == ["c7a", "c7a.medium"]
    assert names(*rows, infra=cloud, cloud=cloud, hardware=Hardware(allow=["c7a.*"])) == ["c7a", "c7a.medium"]


def test_a_place_with_nothing_newer_keeps_what_it_has() -> None:
    rows = [f"{family}.large,,,2,8,0.1,,us-east-1,a" for family in ("m5", "m6i", "m7i", "m8i")]
    far = [f"{family}.large,,,2,8,0.1,,ap-south-1,a" for family in ("m5", "m6i")]
    assert names(*rows, *far, infra="aws/ap-south-1") == ["m5", "m6i"]
    assert names(*rows, *far, infra="aws/us-east-1") == ["m6i", "m7i", "m8i"]


def test_a_gpu_is_admitted_whatever_the_generation_of_its_host() -> None:
    carrier = (
        "n1-standard-4,,,4,15,0.2,,us-central1,b",
        ",T4,1,,,0.35,,us-central1,b",
        "n2-standard-4,,,4,16,0.2,,us-central1,b",
    )
    assert names(*carrier, infra="gcp", cloud="gcp") == ["n2-standard-4"]
    assert names(*carrier, infra="gcp", cloud="gcp", hardware=Hardware(gpus=["T4"])) == ["n1-standard-4"]


@pytest.mark.parametrize(
    ("cloud", "instance", "what"),
    [
        ("aws", "vt1.3xlarge", "accelerated"), ("aws", "dl1.24xlarge", "accelerated"), ("aws", "f2.6xlarge", "accelerated"),
        ("azure", "Standard_NP10s", "accelerated"), ("azure", "Standard_PB6s", "accelerated"),
        ("gcp", "ct5lp-hightpu-1t", "accelerated"),
        ("aws", "t4g.small", "burstable"), ("aws", "m7i-flex.large", "burstable"), ("azure", "Standard_B2ats_v2", "burstable"),
        ("gcp", "e2-micro", "burstable"), ("gcp", "f1-micro", "burstable"),
        ("azure", "Standard_D4_v2", "previous"), ("azure", "Standard_F4s_v2", "previous"),
        ("azure", "Standard_A4m_v2", "previous"),
        ("gcp", "n1-highmem-8", "previous"), ("aws", "r3.large", "previous"), ("aws", "a1.large", "previous"),
        ("aws", "c6i.large", ""), ("aws", "g.large", ""), ("azure", "Standard_D4ads_v5", ""), ("gcp", "e2-standard-4", ""),
        ("aws", "c7i.metal-48xl", "metal"), ("aws", "c6id.metal", "metal"), ("gcp", "c3-standard-192-metal", "metal"),
        ("oci", "BM.Standard.E5.192$_192_2304", "metal"), ("ibm", "bx2-metal-96x384", "metal"), ("aws", "m4.metal", "previous"),
        ("gcp", "c4-standard-4", ""), ("lambda", "gpu_1x_a10", ""), ("slurm", "t3.large", ""),
    ],
)  # fmt: skip
def test_what_the_name_of_a_machine_tells(cloud: str, instance: str, what: str) -> None:
    one = table(f"{instance},,,4,16,0.1,,r1,", cloud=cloud)
    left = left_out(one)
    found = (accelerated(one)[0], burstable(one)[0], left["previous-generation"][0], left["bare-metal"][0])
    assert found == tuple(what == name for name in ("accelerated", "burstable", "previous", "metal"))


def test_bare_metal_is_a_candidate_where_a_gpu_is_named() -> None:
    rows = ["g4dn.metal,T4,8,96,384,7.8,,us-east-1,a", "c7i.metal-48xl,,,192,384,8.6,,us-east-1,a", *OFFERS]
    assert names(*rows, hardware=Hardware(gpus=["T4:8"])) == ["g4dn.metal"]
    assert "c7i.metal-48xl" not in names(*rows)
    assert "c7i.metal-48xl" in names(*rows, hardware=Hardware(allow=["standard", "bare-metal"]))


def test_families_of_one_kind_of_cpu() -> None:
    for cloud, instances, kind in (
        ("aws", ("c6i.large", "m6i.large", "r6i.4xlarge"), "6i"),
        ("azure", ("Standard_D4as_v5", "Standard_E4as_v5"), "asv5"),
        ("gcp", ("n2-standard-4", "n2-highmem-4"), "n2"),
        ("slurm", ("4CPU--16GB", "8CPU--16GB"), ""),
    ):
        rows = [f"{name},,,4,16,0.1,,r1," for name in instances]
        assert set(platforms(table(*rows, cloud=cloud))) == {kind}


def test_what_stands_for_a_cpu_that_no_catalog_names() -> None:
    assert len({cpu_kind("aws", "x86_64", one) for one in ("c5", "m5", "c6i", "m6i")}) == 4
    assert cpu_kind("gcp", "x86_64", "c4d") != cpu_kind("aws", "x86_64", "c4d")
    # A shape of Slurm is not a family, and a measured machine that is not on offer has none.
    assert not cpu_kind("slurm", "x86_64", "4CPU")
    assert not cpu_kind("aws", "", "")


@pytest.mark.parametrize(
    ("infra", "families"),
    [("aws/us-east-1", {"c6a", "m6a", "r6a"}), ("azure/eastus", {"Dasv5", "Easv5"}), ("gcp/us-central1", {"n4"})],
)
def test_the_grid_on_skypilots_real_lists(infra: str, families: set[str]) -> None:
    cloud = infra.partition("/")[0]
    path = SHARED / "data" / "catalog" / "skypilot-v8" / cloud / "vms.csv.gz"
    if not path.is_file():
        pytest.skip("needs the larger data in FOGSPEC_SHARED")
    catalog = load_catalog(str(path), [cloud])
    spec = application({"cpus": "2..64", "memory": "4GiB..512GiB", "memory_per_cpu": "2GiB..8GiB"}, [infra]).spec
    found = design(spec, catalog, filter_offers(catalog, spec.hardware, spec.infra))
    family = dict(zip(catalog.instance.tolist(), catalog.family.tolist(), strict=True))
    assert {family[one.machine.instance] for one in found.samples} == families


@pytest.mark.parametrize(
    ("cloud", "starts", "not_one"),
    [
        ("gcp", ["n2-standard-4", "n4-standard-4", "c3-standard-4"],
         ["c4-standard-4", "c4d-standard-8", "n4d-x-2", "c4a-highmem-1", "n4a-highmem-1", "t2a-standard-1"]),
        ("azure", ["Standard_D4s_v5", "Standard_E4as_v5"], ["Standard_D2s_v6", "Standard_E4ds_v7", "Standard_D4ps_v5"]),
        ("aws", ["c7i.large", "c6i.metal"], []),
        ("verda", [], ["1V100.6V", "CPU.4V.16G"]),  # where SkyPilot's machines cannot end themselves
    ],
)  # fmt: skip
def test_what_skypilot_cannot_start_is_no_candidate_whatever_the_spec_names(
    cloud: str, starts: list[str], not_one: list[str]
) -> None:
    offers = table(*(f"{name},,,2,8,0.1,,r1," for name in starts + not_one), cloud=cloud)
    found = filter_offers(offers, Hardware(allow=["*"], arch=["x86_64", "arm64"]), [cloud])
    assert set(found.offers.instance.tolist()) == set(starts)
    left = next(one for one in found.funnel.filters if one.name == "what SkyPilot can start")
    assert left.removed == len(not_one)
    said = f"left out: {len(not_one)} offers that SkyPilot cannot start"
    assert found.left_out_line() == (said if not_one else None)
    for name in not_one:
        with pytest.raises(InvalidInput, match=f"SkyPilot cannot start '{name}' in {cloud}"):
            design(application({}, [cloud], machines=[name]).spec, offers, found)


def test_machines_that_skypilot_cannot_start_make_no_other_outdated() -> None:
    rows = [f"{family}-standard-4,,,2,8,0.1,,r1," for family in ("c2", "c3", "c4", "c4d")]
    assert names(*rows, infra="gcp", cloud="gcp") == ["c2-standard-4", "c3-standard-4"]


@pytest.mark.parametrize(("cloud", "left"), [("oci", 0), ("cudo", 0), ("aws", 2), ("slurm", 2), ("our-rack", 2)])
def test_where_skypilot_starts_no_images_there_is_no_machine_for_one(cloud: str, left: int) -> None:
    """On a Slurm cluster the image is left out, and `compile` says so."""
    offers = table("a,,,2,8,0.1,,r1,", "b,,,4,16,0.2,,r1,", cloud=cloud)
    spec = application({}, [cloud], machines=["a"]).spec
    assert len(offers_for(offers, spec).offers) == 2
    spec = spec.model_copy(update={"ros": Ros(distro="humble", image="docker.io/library/ros:humble")})
    found = offers_for(offers, spec)
    assert len(found.offers) == left
    said = "left out: 2 offers where SkyPilot starts no container images"
    assert found.left_out_line() == (None if left else said)
    if left:
        assert [one.machine.instance for one in design(spec, offers, found).samples] == ["a"]
    else:
        with pytest.raises(InvalidInput, match="starts no container images where 'a' is"):
            design(spec, offers, found)
