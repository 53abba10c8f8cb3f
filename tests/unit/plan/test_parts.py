"""Parts of machines stand for offers of the same family, place and shape."""

import pytest

from fogspec.catalog.filters import filter_offers
from fogspec.catalog.machine import Machine
from fogspec.plan.commitment import MOST_PARTS, PART_S, Commitment
from fogspec.plan.design import make_plan
from fogspec.plan.parts import local_parts
from fogspec.plan.schema import Plan, Sample, sample_on
from tests.support.catalogs import application, table

ROWS = (
    "c6i.large,,,2,4,0.1,,us-east-1,", "c6i.xlarge,,,4,8,0.2,,us-east-1,", "c6i.2xlarge,,,8,16,0.4,,us-east-1,",
    "c6i.4xlarge,,,16,32,0.8,,us-east-1,", "m6i.2xlarge,,,8,32,0.5,,us-east-1,", "m6i.xlarge,,,4,16,0.25,,us-east-1,",
)  # fmt: skip


def test_shapes_of_this_host_are_halved_while_their_cpus_can_be() -> None:
    found = local_parts(Machine(infra="local", instance="4cpu-2gib", cpus=4, memory=2, price=0))
    assert [(one.part, one.machine.instance, one.machine.cpus, one.machine.memory) for one in found] == [
        ("half", "2cpu-1gib", 2, 1), ("quarter", "1cpu-0.5gib", 1, 0.5),
    ]  # fmt: skip
    assert local_parts(Machine(infra="local", instance="1cpu-2gib", cpus=1, memory=2, price=0)) == []


def plan_of(**benchmark: object) -> Plan:
    catalog = table(*ROWS)
    spec = application({"cpus": "2..64"}, **benchmark)
    return make_plan(
        spec, "specs/x.yaml", catalog, admissible=filter_offers(catalog, spec.spec.hardware, spec.spec.infra)
    )


def test_a_listed_machine_is_measured_with_the_parts_that_are_on_offer() -> None:
    plan = plan_of(machines=["c6i.4xlarge", "m6i.2xlarge", "c6i.large"], shapes="nested")
    parts = {one.machine.instance: [p.machine.instance for p in one.parts] for one in plan.spec.samples}
    assert parts == {
        "c6i.4xlarge": ["c6i.2xlarge", "c6i.xlarge", "c6i.large"],
        "m6i.2xlarge": ["m6i.xlarge"],
        "c6i.large": [],
    }
    (first, second, last) = plan.spec.notes[-3:]
    assert first.startswith(
        "nested in c6i.4xlarge: c6i.2xlarge (a half), c6i.xlarge (a quarter), c6i.large (an eighth)"
    )
    assert second.startswith("nested in m6i.2xlarge: m6i.xlarge (a half)")
    assert (
        last
        == "nested shapes spare 4 starts of a machine: at most $0.14 more, where samples of their own cost at most $0.3483"
    )


def test_parts_are_paid_for_in_the_plan_and_absent_from_plans_without_them() -> None:
    own, nested = plan_of(machines=["c6i.4xlarge"]), plan_of(machines=["c6i.4xlarge"], shapes="nested")
    longer = nested.spec.commitment.paid_s - own.spec.commitment.paid_s
    assert longer == MOST_PARTS * PART_S
    assert nested.spec.estimate.total - own.spec.estimate.total == pytest.approx(0.8 * longer / 3600, abs=1e-5)
    assert own.spec.application.digest != nested.spec.application.digest
    dumped = own.model_dump(mode="json")
    assert "shapes" not in dumped["spec"]
    assert "parts" not in dumped["spec"]["samples"][0]
    assert Plan.model_validate(nested.model_dump(mode="json")) == nested


def test_a_commitment_counts_parts_only_with_nested_shapes() -> None:
    assert Commitment(measuring_s=300, setup_s=300).parts_s == 0
    assert Commitment(measuring_s=300, setup_s=300, nested=True).wall_s == 600 + MOST_PARTS * PART_S


def test_the_sample_of_a_part_is_named_by_its_machine() -> None:
    (part, *_) = local_parts(Machine(infra="local", instance="4cpu-2gib", cpus=4, memory=2, price=0))
    sample: Sample = sample_on(Machine(infra="local", instance="4cpu-2gib", cpus=4, memory=2, price=0), "why")
    assert sample.nested(part).id == "local-4cpu-2gib-half"
    assert sample.nested(part).reason == "a half of 4cpu-2gib"
