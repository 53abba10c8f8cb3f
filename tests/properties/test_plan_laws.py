"""What holds of every plan: it stays in the search box, depends on values alone, and says what it costs."""

import math
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from fogspec.base.errors import Infeasible
from fogspec.plan.design import make_plan
from fogspec.plan.schema import Plan
from tests.support.catalogs import application, table

FAMILIES = {"c6i": 2, "m6i": 4, "r6i": 8, "x2g": 16}
REGIONS = ("us-east-1", "us-west-1", "eu-west-1")


@st.composite
def offers(draw: st.DrawFn) -> str:
    cpus = draw(st.sampled_from([1, 2, 4, 8, 16, 48, 96]))
    family, gib = draw(st.sampled_from(sorted(FAMILIES.items())))
    gpu = draw(st.sampled_from([",", ",", "T4,1", "T4,4", "A10G,1"]))
    price = draw(st.sampled_from(["", "0", "0.1", "0.25", "1.5", "9"]))
    spot = draw(st.sampled_from(["", "0.05", "0.4"]))
    region, zone = draw(st.sampled_from(REGIONS)), draw(st.sampled_from(["a", "b"]))
    return f"{family}.x{cpus},{gpu},{cpus},{cpus * gib},{price},{spot},{region},{zone}"


@st.composite
def applications(draw: st.DrawFn) -> Any:
    hardware = {
        "cpus": draw(st.sampled_from(["2..64", "..8", "4..", "1..96"])),
        "memory": draw(st.sampled_from(["4GiB..512GiB", "..64GiB"])),
        "gpus": draw(st.lists(st.sampled_from(["none", "T4", "T4:4", "A10G"]), min_size=1, max_size=3, unique=True)),
        "arch": ["x86_64", "arm64"],
        "spot": draw(st.booleans()),
        "deny": draw(st.sampled_from([[], ["c6i.*"]])),
    }
    infra = draw(
        st.lists(st.sampled_from(["aws", "aws/us-east-1", "aws/us-west-1/a"]), min_size=1, max_size=2, unique=True)
    )
    return application(hardware, infra)


def planned(application: Any, rows: list[str]) -> Plan | None:
    try:
        return make_plan(application, table(*rows))
    except Infeasible:
        return None


@given(applications(), st.lists(offers(), min_size=1, max_size=40), st.randoms(use_true_random=False))
def test_the_order_of_the_catalog_changes_nothing(application: Any, rows: list[str], random: Any) -> None:
    shuffled = random.sample(rows, len(rows))
    one, other = planned(application, rows), planned(application, shuffled)
    assert one == other
    assert one is None or one.model_dump_json() == other.model_dump_json()  # type: ignore[union-attr]


@given(applications(), st.lists(offers(), min_size=1, max_size=40))
def test_no_sample_leaves_the_search_box(application: Any, rows: list[str]) -> None:
    plan = planned(application, rows)
    if plan is None:
        return
    hardware, infra = application.spec.hardware, application.spec.infra
    for sample in plan.spec.samples:
        machine = sample.machine
        gpu = f"{machine.gpu.name}:{machine.gpu.count:g}" if machine.gpu else "none"
        assert hardware.cpus.holds(machine.cpus)
        assert hardware.memory.holds(machine.memory)
        assert gpu.removesuffix(":1") in hardware.gpus
        assert hardware.spot or not machine.spot
        assert not any(machine.instance.startswith(denied[:-1]) for denied in hardware.deny)
        assert any(f"{machine.infra}/".startswith(f"{entry}/") for entry in infra)
        assert machine.price > 0


@given(applications(), st.lists(offers(), min_size=1, max_size=40))
def test_samples_are_distinct_and_at_most_nine_a_place_and_accelerator(application: Any, rows: list[str]) -> None:
    plan = planned(application, rows)
    if plan is None:
        return
    ids = [sample.id for sample in plan.spec.samples]
    assert len(ids) == len(set(ids))
    assert 1 <= len(ids) <= 9 * len(application.spec.infra) * len(application.spec.hardware.gpus)


@given(applications(), st.lists(offers(), min_size=1, max_size=40))
def test_the_estimate_is_the_sum_of_the_samples(application: Any, rows: list[str]) -> None:
    plan = planned(application, rows)
    if plan is None:
        return
    estimate, price = plan.spec.estimate, sum(sample.machine.paid_usd_per_hour for sample in plan.spec.samples)
    assert math.isclose(estimate.measuring, price * plan.spec.duration / 3600, abs_tol=1e-6)
    parts = estimate.measuring + estimate.setup + estimate.overhead
    assert math.isclose(estimate.total, parts, abs_tol=2e-6)


@given(applications(), st.lists(offers(), min_size=1, max_size=40))
def test_a_plan_read_back_is_the_same_plan(application: Any, rows: list[str]) -> None:
    plan = planned(application, rows)
    assert plan is None or Plan.model_validate(plan.model_dump(mode="json")) == plan
