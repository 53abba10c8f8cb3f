"""When a deployment ends by itself, and that each engine is given what ends its machine."""

import dataclasses
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogspec.backends.naming import Owner
from fogspec.backends.protocol import Job
from fogspec.backends.task_check import check_task
from fogspec.base.clouds import CLOUDS
from fogspec.base.errors import Refused
from fogspec.base.layout import Layout
from fogspec.catalog.machine import Machine
from fogspec.compile.tasks import deploy_task, deploy_work
from fogspec.deploy.lifetime import KEPT_BY, End, ended, left_s, limited
from fogspec.language.schema import Application
from fogspec.plan.commitment import PROVISIONING_S, TEARDOWN_S, power_off_s

NOW = datetime(2026, 11, 22, 12, tzinfo=UTC)
OWNER = Owner("a repository", "default", "demo")


def machine(infra: str = "aws/us-east-1", price: float = 0.5) -> Machine:
    return Machine(infra=infra, instance="m5.large", cpus=2.0, memory=8.0, price=price)


def test_a_duration_counts_from_now_and_a_date_does_not() -> None:
    assert End("8h").date(machine(), NOW, 0.0) == "2026-11-22T20:00:00+00:00"
    assert End("2026-11-23T01:00:00+01:00").date(machine(), NOW, 0.0) == "2026-11-23T00:00:00+00:00"
    assert not End()


@given(
    most=st.floats(0.2, 1e4),
    share=st.floats(0, 0.5),
    price=st.floats(0.01, 100),
    infra=st.sampled_from(["aws/us-east-1", "slurm/lab/small", "paperspace/East", "local"]),
)
def test_no_more_is_spent_than_allowed(most: float, share: float, price: float, infra: str) -> None:
    """From the request to the machine's own end, at its latest, and with what was spent before."""
    spent = share * most
    paid = machine(infra, price).paid_usd_per_hour  # with disk and address
    beside = {"aws": 20.11 / 730, "paperspace": 0.06}.get(infra.partition("/")[0], 0.0)
    assert paid == pytest.approx(price + beside)
    try:
        date = End(None, most).date(machine(infra, price), NOW, spent)
    except Refused:
        room_s = (most - spent) / paid * 3600
        room_s -= room_s % 3600 if infra.startswith("paperspace") else 0.0  # which bills each hour that begins
        assert room_s < PROVISIONING_S + TEARDOWN_S + 62
        return
    away_s = 0.0 if infra == "local" else PROVISIONING_S + TEARDOWN_S
    assert spent + machine(infra, price).usd(left_s(date, NOW) + away_s) <= most * (1 + 1e-9)


@pytest.mark.parametrize(
    ("end", "reason"),
    [(End("30s"), "until"), (End("2020-01-01T00:00:00Z"), "until"), (End("8h", 1.0), "budget")],
)
def test_an_end_that_is_now_starts_nothing(end: End, reason: str) -> None:
    with pytest.raises(Refused, match=f"deployment.{reason} is reached"):
        end.date(machine(), NOW, 0.99)


def test_an_end_that_has_passed() -> None:
    assert ended((NOW - timedelta(seconds=1)).isoformat(), NOW)
    assert not ended((NOW + timedelta(seconds=1)).isoformat(), NOW)
    assert not ended(None, NOW)


def compiled(infra: str) -> dict[str, Any]:
    app = Application.model_validate(
        {
            "apiVersion": "fogspec.dev/v1alpha1", "kind": "Application", "metadata": {"name": "demo"},
            "spec": {"cloud": [{"cmd": ["true"]}], "probe": {"callback": "x"}, "infra": [infra],
                     "deployment": {"until": "2h"}},
        }
    )  # fmt: skip
    return deploy_task(app, machine(infra), deploy_work(app, Layout(Path(), Path("specs/demo.yaml"), "demo")))


POD = {"pod_config": {"spec": {"activeDeadlineSeconds": 7500}}}


@pytest.mark.parametrize(
    ("infra", "config", "off_s"),
    [
        ("aws/us-east-1", None, 7500.0),
        ("gcp/us-central1", None, 7500.0),
        ("azure/eastus", None, None),
        ("slurm/lab/cpu", {"slurm": {"sbatch_options": {"time": 125}}}, None),
        ("kubernetes", {"kubernetes": {"set_pod_resource_limits": True, **POD}}, None),
        ("ssh/pool", {"ssh": POD}, None),
    ],
)
def test_each_engine_ends_the_machine_without_the_computer_that_applied(
    infra: str, config: dict[str, Any] | None, off_s: float | None, tmp_path: Path
) -> None:
    task = limited(compiled(infra), machine(infra), "2026-11-22T14:00:00+00:00", 7200.0)
    assert task["resources"]["autostop"] == {"idle_minutes": 120, "down": True, "wait_for": "none"}
    assert task["envs"] == {"FOGSPEC_LIFETIME_S": "7200", "FOGSPEC_ENDS": "1795356000"}
    assert task.get("config") == config
    assert power_off_s(task) == off_s
    job = Job(
        name=OWNER.deployment_name("sha256:01234567", "abcdef"), owner=OWNER, task=task, root=tmp_path,
        directory=tmp_path, machine=machine(infra), lifetime_s=7200.0,
    )  # fmt: skip
    check_task(job)
    for wrong in (None, 3600.0):
        with pytest.raises(Exception, match="not what was approved"):
            check_task(dataclasses.replace(job, lifetime_s=wrong))


def test_every_kind_of_end_is_said() -> None:
    assert {row.own_end for row in CLOUDS.values()} == set(KEPT_BY)
    assert End("8h", 25.0).text("slurm/lab/cpu") == (
        "8h after apply, and before $25.00 are spent, by autostop on the machine, and the job's time limit"
    )
