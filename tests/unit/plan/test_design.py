"""Which machines are measured: the grid, a list, what is said where there is none; and by which names."""

import pytest

from fogspec.base.errors import Infeasible, InvalidInput
from fogspec.catalog.filters import filter_offers
from fogspec.catalog.machine import Machine
from fogspec.catalog.table import Catalog
from fogspec.language.schema import Application
from fogspec.language.warned import burstable, sampled_once, sentence, warned
from fogspec.plan.design import Design, design, make_plan
from fogspec.plan.schema import Plan, next_on, sample_id
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


def test_a_list_is_taken_as_it_stands() -> None:
    wanted = ["g4dn.xlarge", "c6i.large", "local/2cpu-4gib"]
    both = application({"gpus": ["none", "T4"]}, ["aws/us-west-1", "aws/us-east-1"], machines=wanted)
    found = picked(both, table(*OFFERS))
    assert [(one.machine.infra, one.machine.instance, one.machine.price) for one in found.samples] == [
        ("aws/us-east-1", "g4dn.xlarge", 0.526),
        ("aws/us-west-1", "c6i.large", 0.106),
        ("aws/us-east-1", "c6i.large", 0.085),
        ("local", "2cpu-4gib", 0.0),
    ]
    assert found.notes == ()


@pytest.mark.parametrize(
    ("hardware", "name", "says"),
    [
        ({}, "g4dn.xlarge", "hardware.gpus does not admit it, it has T4:1"),
        ({"gpus": ["T4"]}, "g4dn.12xlarge", "hardware.gpus does not admit it, it has T4:4"),
        ({"gpus": ["T4:4"]}, "g4dn.xlarge", "hardware.gpus does not admit it, it has T4:1"),
        ({"cpus": "4.."}, "c6i.large", "hardware.cpus does not admit it"),
        ({"deny": ["c6i.*"]}, "c6i.large", "hardware.deny does not admit it"),
        ({}, "t3.large", "hardware.allow does not admit it, for its class"),
    ],
)
def test_a_listed_machine_that_can_never_be_chosen_is_an_error(
    hardware: dict[str, object], name: str, says: str
) -> None:
    offers = (*OFFERS, "g4dn.12xlarge,T4,4,48,192,3.912,,us-east-1,a", "t3.large,,,2,8,0.083,,us-east-1,a")
    with pytest.raises(InvalidInput, match=f"{name} could never be chosen: spec.{says}") as caught:
        picked(application(hardware, machines=[name]), table(*offers))
    hint, *more = caught.value.hints
    assert hint == f"admit it in spec.{says.split(' ')[0]}, or leave it out"
    assert bool(more) == (name == "t3.large")
    assert all(one.endswith("to admit them: spec.hardware.allow: [standard, burstable]") for one in more)


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


ALIKE = ("node_a,4,16,0.1,lab", "node-a,16,64,0.4,lab", "node.b,8,32,0.2,lab", "Large,2,8,0.3,lab", "large,4,9,0.5,lab")
LAB = "InstanceType,vCPUs,MemoryGiB,Price,Region"


def names(*rows: str, measured: dict[str, Machine] | None = None) -> dict[str, str]:
    """The ids of the samples of a list, by instance type."""
    app = application({}, ["slurm/lab"], machines=[row.partition(",")[0] for row in rows])
    catalog = table(*rows, head=LAB, cloud="slurm")
    admissible = filter_offers(catalog, app.spec.hardware, app.spec.infra)
    found = design(app.spec, catalog, admissible, measured)
    assert not [note for note in found.notes if note["code"] == "sampled_once"]
    return {one.machine.instance: one.id for one in found.samples}


def node(instance: str) -> Machine:
    return Machine(infra="slurm/lab", instance=instance, cpus=4, memory=16, price=0.1)


def test_two_machines_whose_names_read_alike_are_two_samples() -> None:
    found = names(*ALIKE)
    assert len(set(found.values())) == len(ALIKE)
    assert {name: one[:-7] for name, one in found.items() if name != "node.b"} == {
        "node_a": "slurm-lab-node-a",
        "node-a": "slurm-lab-node-a",
        "Large": "slurm-lab-large",
        "large": "slurm-lab-large",
    }
    assert found["node.b"] == "slurm-lab-node-b"
    assert names(*reversed(ALIKE)) == found
    assert found == {name: sample_id(node(name), apart=name != "node.b") for name in found}


def test_a_machine_that_was_measured_keeps_its_name_in_a_wider_list() -> None:
    alone = names(ALIKE[0])
    assert alone == {"node_a": "slurm-lab-node-a"}
    measured = {name: node(instance) for instance, name in alone.items()}
    wider = names(*ALIKE[:2], measured=measured)
    assert wider["node_a"] == alone["node_a"]
    assert wider["node-a"] == sample_id(node("node-a"), apart=True)
    assert names(ALIKE[1], measured=measured) == {"node-a": wider["node-a"]}


def test_further_samples_of_machines_whose_names_read_alike() -> None:
    taken: dict[str, Machine] = {}
    for instance in ("node_a", "node-a", "node_a", "node-a", "node-a-repeat_2", "node-a-repeat_2"):
        one = next_on(node(instance), "why", taken)
        assert one.id not in taken
        taken[one.id] = one.machine
    first, apart, long = "slurm-lab-node-a", *(sample_id(node(n), apart=True) for n in ("node-a", "node-a-repeat_2"))
    assert list(taken) == [first, apart, f"{first}-repeat-2", f"{apart}-repeat-2", long, f"{long}-repeat-2"]
    assert sample_id(node("node-a-repeat_2")) == long


def test_a_long_name_is_short_enough_for_a_file_and_still_its_own() -> None:
    one, other = (sample_id(node("n" * 300 + end)) for end in "ab")
    assert one != other
    assert max(map(len, (one, other))) < 140


def test_a_plan_with_one_name_for_two_machines_is_refused() -> None:
    plan = make_plan(application({}, ["slurm/lab"]), table(*ALIKE, head=LAB, cloud="slurm"))
    edited = plan.model_dump(mode="json")
    edited["spec"]["samples"][1]["id"] = edited["spec"]["samples"][0]["id"]
    with pytest.raises(ValueError, match="two samples have the id"):
        Plan.model_validate(edited)
