"""The plan of the paper's motion planning, to the cent, and what a plan records."""

import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from fogspec.catalog.sources.snapshot import Snapshot
from fogspec.catalog.table import Catalog
from fogspec.language.warned import sentence
from fogspec.plan.commitment import PATIENCE_S, PROVISIONING_S, TEARDOWN_S, Commitment, room_s
from fogspec.plan.design import make_plan
from fogspec.plan.schema import Plan
from tests.support.catalogs import PAPER_HARDWARE, application, table

BESIDE_5_MIN = (16.46 / 730 + 0.005) / 12  # of disk and address in us-east-1, which the paper leaves out


@cache
def snapshot() -> Catalog:
    return Snapshot("", []).load()


@cache
def paper() -> Plan:
    return make_plan(application(PAPER_HARDWARE, stop={"duration": "5min"}), snapshot())


def test_the_papers_grid_is_nine_machines() -> None:
    sampled = [(sample.machine.instance, sample.machine.cpus, sample.machine.memory) for sample in paper().spec.samples]
    assert sampled == [
        ("c6i.large", 2, 4), ("m6i.large", 2, 8), ("r6i.large", 2, 16),
        ("c6i.4xlarge", 16, 32), ("m6i.4xlarge", 16, 64), ("r6i.4xlarge", 16, 128),
        ("c6i.16xlarge", 64, 128), ("m6i.16xlarge", 64, 256), ("r6i.16xlarge", 64, 512),
    ]  # fmt: skip
    assert paper().spec.notes == []


def test_five_minutes_of_it_cost_what_table_two_says() -> None:
    assert sum(sample.machine.price for sample in paper().spec.samples) == pytest.approx(12.587, abs=1e-9)
    assert round(100 * (paper().spec.estimate.measuring - 9 * BESIDE_5_MIN), 3) == 104.892


def test_without_the_failed_machine_it_costs_what_table_two_says_of_cubicles() -> None:
    hardware = {**PAPER_HARDWARE, "allow": ["c6i.*", "m6i.*", "r6i.*"], "deny": ["r6i.large"]}
    found = make_plan(application(hardware, stop={"duration": "5min"}), snapshot()).spec
    assert len(found.samples) == 8
    assert round(100 * (found.estimate.measuring - 8 * BESIDE_5_MIN), 3) == 103.842
    assert "no machine has 6 GiB, the nearest on offer is 8 GiB" in sentence(found.notes[0])


def test_the_papers_gpu_machines_are_the_grid_of_the_t4() -> None:
    hardware = {"cpus": "2..16", "memory": "4GiB..512GiB", "memory_per_cpu": "2GiB..8GiB", "gpus": ["T4"]}
    found = make_plan(application(hardware, ["aws/us-west-1"]), snapshot()).spec
    assert [(sample.machine.instance, sample.machine.price) for sample in found.samples] == [
        ("g4dn.xlarge", 0.631), ("g4dn.2xlarge", 0.902), ("g4dn.4xlarge", 1.445),
    ]  # fmt: skip


@pytest.mark.slow
def test_no_hash_seed_changes_a_byte_and_no_scipy_is_loaded() -> None:
    code = (
        "import sys; from tests.unit.plan.test_schema import paper; print(paper().model_dump_json());"
        "sys.exit('scipy' in sys.modules)"
    )
    root = Path(__file__).resolve().parents[3]
    made = {
        subprocess.run([sys.executable, "-c", code], cwd=root, env={"PYTHONHASHSEED": seed, "PATH": ""},
                       capture_output=True, check=True).stdout
        for seed in ("1", "2")
    }  # fmt: skip
    assert made == {paper().model_dump_json().encode() + b"\n"}


def test_all_machines_at_once_the_estimate_adds_up() -> None:
    offers = table("c6i.large,,,2,4,0.36,,us-east-1,a", cloud="lambda")
    found = make_plan(
        application({}, ["lambda"], stop={"duration": "10min"}, ready_timeout="5min"), offers
    ).spec.estimate
    assert (found.measuring, found.setup, found.wall) == (0.06, 0.03, 900.0)
    # 5 min until its own end is armed, 20 min of lifetime (15 and 5 to collect), 2 min until it is gone.
    assert (found.overhead, found.total) == (0.072, 0.162)


def test_a_plan_records_its_catalog_and_its_search_box() -> None:
    body = paper().spec
    assert (body.catalog.revision, body.catalog.date) == ("moto 5.2.5, apache-libcloud 3.9.1", "2025-03-02")
    assert body.catalog.digest == snapshot().about.digest
    assert body.inputs["spec.benchmark.warmup"] == body.warmup
    assert (body.infra, body.sampler, body.duration) == (["aws/us-east-1"], "grid", 300.0)


def test_a_plan_reads_back_as_it_was_written() -> None:
    assert Plan.model_validate(paper().model_dump(mode="json")) == paper()


def test_a_listed_plan_says_so() -> None:
    found = make_plan(application(machines=["c6i.large"]), snapshot())
    assert found.spec.sampler == "list"
    assert [sample.id for sample in found.spec.samples] == ["aws-us-east-1-c6i-large"]


def test_a_machine_ends_itself_after_whole_minutes() -> None:
    assert Commitment(measuring_s=300, setup_s=300).lifetime_s == 900
    assert Commitment(measuring_s=301, setup_s=300).lifetime_s == 960


def test_what_a_sample_may_cost_covers_the_time_before_and_after_its_lifetime() -> None:
    each = Commitment(measuring_s=300, setup_s=300)
    assert each.machine_s == PROVISIONING_S + each.lifetime_s
    assert each.paid_s == each.machine_s + TEARDOWN_S
    assert each.deadline_s + PATIENCE_S + TEARDOWN_S <= each.paid_s, "a controller that can act stops it in time"


@pytest.mark.parametrize("paid_s", [900.0, 1320.0, 1379.0, 5000.0])
def test_the_room_for_measuring_is_the_longest_that_is_paid(paid_s: float) -> None:
    room = room_s(paid_s)
    assert Commitment(measuring_s=room - 30, setup_s=30).paid_s <= paid_s
    assert Commitment(measuring_s=room - 30 + 61, setup_s=30).paid_s > paid_s
