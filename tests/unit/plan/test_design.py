"""Which machines are measured: the grid, a list, and what is said where there is none."""

import pytest

from fogspec.base.errors import Infeasible, InvalidInput
from fogspec.catalog.filters import filter_offers
from fogspec.catalog.table import Catalog
from fogspec.language.schema import Application
from fogspec.language.warned import burstable, not_candidate, sampled_once, sentence, warned
from fogspec.plan.design import Design, design
from tests.support.catalogs import application, table

OFFERS = (
    "c6i.large,,,2,4,0.085,0.03,us-east-1,a",
    "c6i.large,,,2,4,0.106,,us-west-1,a",
    "c6a.large,,,2,4,0.0765,,us-east-1,a",
    "m6i.large,,,2,8,0.096,,us-east-1,a",
    "r6i.large,,,2,16,0.126,,us-east-1,a",
    "g4dn.xlarge,T4,1,4,16,0.526,,us-east-1,a",
)


def picked(application: Application, catalog: Catalog) -> Design:
    return design(application.spec, catalog, filter_offers(catalog, application.spec.hardware, application.spec.infra))


def test_the_cheapest_machine_of_each_cell_is_taken_and_every_gap_is_said() -> None:
    found = picked(application({"gpus": ["none", "T4", "A100"]}), table(*OFFERS))
    assert [one.machine.instance for one in found.samples] == ["c6i.large", "m6i.large", "r6i.large", "g4dn.xlarge"]
    assert found.samples[1].reason == "smallest vCPUs (2), median memory (8 GiB)"
    assert found.samples[3].reason == "smallest vCPUs (4), smallest memory (16 GiB) with T4"
    said = "\n".join(map(sentence, found.notes))
    assert "GPU none: sizes of one kind of CPU, c6i, m6i, r6i; sampler: adaptive compares all 2 kinds" in said
    assert "GPU none: the median vCPU count is also the smallest or largest: its cells are skipped" in said
    assert said.count("aws/us-east-1 g4dn.xlarge is a duplicate: sampled once") == 1
    assert "GPU A100: no admissible machine, nothing is sampled" in said


def test_a_burstable_machine_in_the_grid_is_said() -> None:
    offers = table("t3.large,2,8,0.08,us-east-1,1", head="InstanceType,vCPUs,MemoryGiB,Price,Region,Burstable")
    included = application({"allow": ["burstable"]})
    assert warned(burstable, infra="aws/us-east-1", machine="t3.large") in picked(included, offers).notes
    with pytest.raises(Infeasible) as caught:
        picked(application(), offers)
    assert caught.value.hints[-1] == "left out: 1 burstable; to admit them: spec.hardware.allow: [standard, burstable]"


def test_the_grid_compares_sizes_on_one_kind_of_cpu() -> None:
    sizes = {"large": (2, 1), "4xlarge": (16, 8), "16xlarge": (64, 32)}
    families = {
        "c6i": (2, 0.085),
        "m6i": (4, 0.096),
        "r6i": (8, 0.126),
        "c7a": (2, 0.103),
        "m7a": (4, 0.116),
        "c6a": (2, 0.0765),
    }
    offers = [
        f"{family}.{size},,,{cpus},{cpus * gib},{price * times},,us-east-1,a"
        for family, (gib, price) in families.items()
        for size, (cpus, times) in sizes.items()
    ]
    found = picked(application(), table(*offers))
    assert [one.machine.instance for one in found.samples] == [
        f"{family}.{size}" for size in sizes for family in ("c6i", "m6i", "r6i")
    ], "6i spans more memory than 7a and 6a, which have cheaper machines"


def test_ids_name_the_machine_and_nothing_else() -> None:
    one = picked(application(), table(*OFFERS)).samples[0]
    assert one.id == "aws-us-east-1-c6i-large"
    only = application({"spot": True, "allow": ["c6i.*"]})
    assert [one.id for one in picked(only, table(*OFFERS)).samples] == ["aws-us-east-1-c6i-large-spot"]
    carrier = table("n1-standard-4,,,4,15,0.2,,us-central1,b", ",T4,1,,,0.35,,us-central1,b", cloud="gcp")
    wanted = {"gpus": ["none", "T4"], "allow": ["standard", "previous-generation"]}
    both = picked(application(wanted, ["gcp/us-central1"]), carrier)
    assert [one.id for one in both.samples] == ["gcp-us-central1-n1-standard-4", "gcp-us-central1-n1-standard-4-t4-1"]


def test_overlapping_places_sample_a_machine_once() -> None:
    found = picked(application({"allow": ["m6i.*"]}, ["aws/us-east-1", "aws"]), table(*OFFERS))
    assert len(found.samples) == 1
    assert warned(sampled_once, infra="aws/us-east-1", machine="m6i.large") in found.notes


def test_a_list_is_taken_as_it_stands_and_says_what_is_no_candidate() -> None:
    wanted = ["g4dn.xlarge", "c6i.large", "local/2cpu-4gib"]
    found = picked(application(infra=["aws/us-west-1", "aws/us-east-1"], machines=wanted), table(*OFFERS))
    assert [(one.machine.infra, one.machine.instance, one.machine.price) for one in found.samples] == [
        ("aws/us-east-1", "g4dn.xlarge", 0.526),
        ("aws/us-west-1", "c6i.large", 0.106),
        ("aws/us-east-1", "c6i.large", 0.085),
        ("local", "2cpu-4gib", 0.0),
    ]
    assert found.notes == (warned(not_candidate, machine="g4dn.xlarge"),)


def test_an_unknown_listed_machine_is_a_mistake_with_a_suggestion() -> None:
    with pytest.raises(InvalidInput, match=r"no instance type 'c6i\.larg'") as caught:
        picked(application(machines=["c6i.larg"]), table(*OFFERS))
    assert caught.value.hints[0].startswith("did you mean c6i.large, ")
    with pytest.raises(InvalidInput, match=r"no instance type 'm6i\.large' in aws/us-west-1"):
        picked(application(infra=["aws/us-west-1"], machines=["m6i.large"]), table(*OFFERS))


def test_no_machine_is_an_answer_that_says_which_filter_left_none() -> None:
    with pytest.raises(Infeasible) as caught:
        picked(application({"cpus": "128.."}), table(*OFFERS))
    assert (
        caught.value.hints[0]
        == "7 offers -> 6 after infra -> 5 after hardware.spot -> 4 after hardware.gpus -> 0 after hardware.cpus"
    )
    with pytest.raises(Infeasible) as caught:
        picked(application(infra=["aws/us-esat-1"]), table(*OFFERS))
    assert caught.value.hints[0] == "7 offers -> 0 after infra"
    assert caught.value.hints[1].startswith("the catalog has no machine in aws/us-esat-1; did you mean aws/us-")
    with pytest.raises(Infeasible) as caught:
        picked(application(infra=["slurm/lab"]), table(*OFFERS))
    assert "no machine in slurm/lab; --catalog takes a list of its machines" in caught.value.hints[1]


@pytest.mark.parametrize(
    ("hardware", "said"),
    [({"gpus": ["A100"]}, "for hardware.gpus: T4"), ({"cpus": 3}, "for hardware.cpus: "), ({"memory": "3GiB"}, " GiB")],
)
def test_where_no_machine_is_left_what_there_was_is_said(hardware: dict[str, object], said: str) -> None:
    with pytest.raises(Infeasible) as ended:
        picked(application(hardware), table(*OFFERS))
    assert any("on offer there" in hint and said in hint for hint in ended.value.hints)
