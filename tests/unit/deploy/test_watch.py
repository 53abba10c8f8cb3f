"""What a watcher decides, from what it sees alone."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client.parser import text_string_to_metric_families

from fogspec.backends.protocol import DeploymentStatus
from fogspec.base.text import INVISIBLE
from fogspec.catalog.machine import Machine
from fogspec.deploy.health import HealthReport
from fogspec.deploy.metrics import escaped, metrics_text
from fogspec.deploy.schema import DeployedMachine
from fogspec.deploy.watch import LONGEST_WAIT_S, Action, action_of, wait_s


def record(state: str, name: str = "one") -> DeployedMachine:
    return DeployedMachine(
        name=name, deployer="skypilot", state=state, manifest="sha256:1", runs="sha256:2", files={}, at=0.0, boot="b",
        since="2026-11-22T12:00:00+00:00", machine=Machine(infra="aws/r1", instance="m5.large", cpus=2, memory=8.0, price=0.1),
    )  # fmt: skip


def report(live: str | None, *states: str) -> HealthReport:
    machines = tuple(record(state, f"m{number}") for number, state in enumerate(states))
    return HealthReport(
        sync="Synced", health="Healthy", reasons=(), changes=(), machines=machines,
        serving=next((one for one in machines if one.state == "serving"), None),
        live=None if live is None else DeploymentStatus(state=live), observed=None, manifest=None, spent_usd=0.0, up_s=1.0,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("live", "states", "action"),
    [
        ("ready", ["serving"], Action.NOTHING),
        ("starting", ["serving"], Action.NOTHING),
        ("gone", ["serving"], Action.RESTART),
        ("ended", ["serving"], Action.RESTART),
        (None, ["serving"], Action.NOTHING),
        (None, ["starting"], Action.NOTHING),
        (None, ["serving", "starting"], Action.NOTHING),
        ("starting", ["starting"], Action.RESTART),
        ("gone", ["serving", "starting"], Action.RESTART),
        ("ready", ["serving", "starting"], Action.FINISH),
        ("ready", ["serving", "ending"], Action.FINISH),
        ("gone", ["ending"], Action.FINISH),
        (None, ["ending"], Action.FINISH),
    ],
)
def test_what_is_done(live: str | None, states: list[str], action: Action) -> None:
    assert action_of(report(live, *states), machine_ended=False) is action


def test_a_machine_that_came_to_its_end_is_not_replaced() -> None:
    assert action_of(report("gone", "serving"), machine_ended=True) is Action.FINISH
    assert action_of(report("ready", "serving"), machine_ended=True) is Action.NOTHING


@given(st.lists(st.floats(0, 3600), max_size=60))
def test_restarts_wait_and_the_first_does_not(ages_s: list[float]) -> None:
    assert 0 <= wait_s(ages_s) <= LONGEST_WAIT_S
    assert wait_s([]) == 0
    assert wait_s([*ages_s, 0.0]) >= wait_s([0.0])
    assert wait_s([*ages_s, LONGEST_WAIT_S]) == 0


@given(st.text(min_size=1))
def test_a_label_comes_back_as_it_is_shown(value: str) -> None:
    hostile = replace(report("ready", "serving"), live=DeploymentStatus(state="ready", restarts={value: 3}))
    text = metrics_text({"demo": hostile}, {"demo": 2}, 1e9)
    assert not INVISIBLE.search(text)
    (family,) = [one for one in text_string_to_metric_families(text) if one.name == "fogspec_node_restarts_total"]
    (sample,) = family.samples
    assert sample.value == 3
    assert escaped(sample.labels["node"]) == escaped(escaped(value).replace("\\\\", "\\").replace('\\"', '"'))
