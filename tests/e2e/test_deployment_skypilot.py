"""A manifest's life on a cloud, with SkyPilot as the tests simulate it; tests/slurm does it with the real one."""

import json
import os
import signal
import time
from collections.abc import Iterator, Mapping
from typing import Any

import pytest

from fogspec.backends import registry
from fogspec.backends.protocol import Unreachable
from fogspec.backends.skypilot.backend import SkyPilotDeployments
from fogspec.backends.skypilot.errors import CloudProblem
from tests.support.fake_sky import Cloud, SimulatedClient
from tests.support.running import Shell, measure, project, shell  # noqa: F401

AT = ("--catalog", "offers.csv")
MANIFEST = "compiled/demo/manifest.yaml"
WORK = """\
import time
import fogspec_probe
while True:
    fogspec_probe.start("plan")
    time.sleep(0.02)
    fogspec_probe.stop("plan")
"""


@pytest.fixture
def cloud(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cloud]:
    project(shell)
    shell.write("specs/work.py", WORK)
    measure(shell)
    shell("compile", "specs/demo.yaml", *AT)
    made = Cloud(shell.folder.parent / "cloud")
    monkeypatch.setattr(SkyPilotDeployments, "poll_s", 0.05)
    monkeypatch.setattr(registry, "deployment_backend", lambda infra: SkyPilotDeployments(SimulatedClient(made)))
    yield made
    for name in list(made.machines):
        made.end(name)


def change(shell: Shell, old: str, new: str) -> None:
    before = shell.read("specs/demo.yaml")
    assert old in before
    shell.write("specs/demo.yaml", before.replace(old, new))


def status(shell: Shell) -> dict:
    return json.loads(shell("status", *AT, "-o", "json").out)[0]["deployment"]


def test_from_apply_to_down(shell: Shell, cloud: Cloud) -> None:
    shell("apply", MANIFEST, *AT, "--yes")
    (name,) = cloud.machines
    assert "-demo-" in name
    assert "192.0.2.1" in shell("apply", MANIFEST, *AT, "--yes").out
    end = time.monotonic() + 120
    while not (live := status(shell))["observed"]["requests"]:
        assert time.monotonic() < end
        time.sleep(0.5)
    # The node answers in 20 ms: the results in this test said a second.
    assert (live["sync"], live["observed"]["requests"] > 0) == ("Synced", True)

    change(shell, "alpha: 0.5", "alpha: 0")
    shell("apply", MANIFEST, *AT, "--yes", code=3)
    shell("compile", "specs/demo.yaml", *AT)
    assert status(shell)["sync"] == "OutOfSync"
    shell("apply", MANIFEST, *AT, "--yes")
    (other,) = cloud.machines
    assert other != name
    assert "1 ended" in shell("down", "demo").out
    assert cloud.machines == {}
    assert not (shell.folder / ".fogspec").exists()


def test_the_deployment_is_found_by_its_label_when_the_state_is_lost(shell: Shell, cloud: Cloud) -> None:
    shell("apply", MANIFEST, *AT, "--yes")
    (shell.folder / ".fogspec/demo/deployment.yaml").unlink()
    (name,) = cloud.machines
    refused = shell("apply", MANIFEST, *AT, "--yes", code=5).err
    assert name in refused, "a second one beside it would cost twice, and nobody would know"
    assert "fogspec down demo" in refused
    assert list(cloud.machines) == [name]
    assert "1 ended" in shell("down", "demo").out
    assert cloud.machines == {}


def test_a_price_that_rose_at_the_launch_is_refused(shell: Shell, cloud: Cloud) -> None:
    cloud.fails = lambda op, _words: CloudProblem("budget", "it costs $0.5 per hour now") if op == "launch" else None
    assert "it costs $0.5 per hour now" in shell("apply", MANIFEST, *AT, "--yes", code=5).err
    assert cloud.machines == {}


def test_no_contact_while_it_serves(shell: Shell, cloud: Cloud) -> None:
    shell("apply", MANIFEST, *AT, "--yes")
    cloud.fails = lambda _op, _words: Unreachable("the network is down")
    assert status(shell)["health"] == "Unknown"
    shell("status", *AT, "--exit-code", code=3)
    assert "status unknown, no contact" in shell("apply", MANIFEST, *AT, "--yes", code=6).err
    assert "the network is down" in shell("down", "demo", code=6).err
    cloud.fails = lambda _op, _words: None
    assert len(cloud.machines) == 1
    shell("down", "demo")
    assert cloud.machines == {}


def test_an_api_server_that_dies_while_it_is_asked(shell: Shell, cloud: Cloud) -> None:
    left = iter([None, None, Unreachable("API server died"), Unreachable("API server died")])
    cloud.fails = lambda op, _words: next(left, None) if op in ("find", "launched", "jobs") else None
    shell("apply", MANIFEST, *AT, "--yes")
    assert len(cloud.machines) == 1, "asked for once"
    shell("down", "demo")


@pytest.mark.parametrize("times", [1, 2])
def test_a_launch_that_its_api_server_forgot_is_made_once_more(shell: Shell, cloud: Cloud, times: int) -> None:
    forgotten: list[str] = []

    def forgets(op: str, words: Mapping[str, Any]) -> None:
        if op == "find" and words["name"] not in forgotten and len(forgotten) < times:
            forgotten.append(words["name"])
            cloud.end(words["name"])

    cloud.fails = forgets
    said = shell("apply", MANIFEST, *AT, "--yes", code=0 if times == 1 else 6).err
    assert f"{forgotten[0]}: gone" in said, "verified before another is started"
    assert f"{forgotten[0]}: its machine is gone: SkyPilot knows of no launch of it" in said
    assert len(cloud.machines) == 2 - times
    assert ("safe to run again" in said) == (times == 2)
    shell("down", "demo")
    assert cloud.machines == {}


def test_after_ctrl_c_a_machine_that_goes_away_is_not_started_once_more(shell: Shell, cloud: Cloud) -> None:
    asked: list[str] = []

    def interrupts(op: str, words: Mapping[str, Any]) -> None:
        if op == "launch":
            asked.append(words["name"])
        elif op == "find" and words["name"] in cloud.machines:
            cloud.end(words["name"])
            os.kill(os.getpid(), signal.SIGINT)

    cloud.fails = interrupts
    assert "what was being started is gone" in shell("apply", MANIFEST, *AT, "--yes", code=130).err
    assert len(asked) == 1
    assert cloud.machines == {}


def test_a_machine_that_was_reclaimed(shell: Shell, cloud: Cloud) -> None:
    shell("apply", MANIFEST, *AT, "--yes")
    (name,) = cloud.machines
    cloud.end(name)
    assert status(shell)["health"] == "Missing"
    shell("apply", MANIFEST, *AT, "--yes")
    assert list(cloud.machines) != [name]
    shell("down", "demo")


def test_a_watch_replaces_a_reclaimed_machine_once_and_starts_nothing_without_contact(
    shell: Shell, cloud: Cloud
) -> None:
    watch = ("watch", "demo", "--once", "--yes", *AT)
    shell("apply", MANIFEST, *AT, "--yes")
    (name,) = cloud.machines
    shell(*watch)
    assert list(cloud.machines) == [name]
    cloud.fails = lambda _op, _words: Unreachable("the network is down")
    shell(*watch, code=6)
    cloud.fails = lambda _op, _words: None
    assert list(cloud.machines) == [name], "it may be fine"
    cloud.end(name)
    cloud.fails = lambda op, _words: CloudProblem("budget", "it costs $9 an hour now") if op == "launch" else None
    assert "it costs $9 an hour now" in shell(*watch, code=6).err
    assert cloud.machines == {}
    (shell.folder / ".fogspec/demo/events.jsonl").unlink()
    cloud.fails = lambda _op, _words: None
    shell(*watch)
    (other,) = cloud.machines
    assert other != name
    shell("down", "demo")
    shell(*watch)
    assert cloud.machines == {}, "what was ended stays ended"


def test_a_deployment_with_an_end_is_given_it_with_its_task(shell: Shell, cloud: Cloud) -> None:
    change(shell, "  probe:", "  deployment: {until: 2h, max_spend: $1}\n  probe:")
    shell("compile", "specs/demo.yaml", *AT)
    said = shell("apply", MANIFEST, *AT, "--yes").err
    assert "2h after apply, and before $1.00 are spent, by autostop on the machine, and a power-off timer" in said
    (machine,) = cloud.machines.values()
    stop = machine.task["resources"]["autostop"]
    assert (stop["wait_for"], stop["down"]) == ("none", True)
    assert 0 < stop["idle_minutes"] <= 120
    assert 0 < float(machine.task["envs"]["FOGSPEC_LIFETIME_S"]) <= 7200
    assert status(shell)["ends"] is not None
    # The machine comes to its end while nobody looks: nothing takes its place.
    live = shell.folder / ".fogspec/demo/deployment.yaml"
    live.write_text(live.read_text().replace(status(shell)["ends"], "2020-01-01T00:00:00+00:00"))
    cloud.end(next(iter(cloud.machines)))
    shell("watch", "demo", "--once", "--yes", *AT)
    assert cloud.machines == {}
    assert status(shell) is None


def test_an_image_without_a_digest(shell: Shell, cloud: Cloud) -> None:
    change(shell, "  probe:", "  ros: {distro: jazzy, image: 'ros:jazzy'}\n  probe:")
    shell("compile", "specs/demo.yaml", *AT)
    (shell.folder / "results/demo.yaml").unlink()
    measure(shell)
    shell("compile", "specs/demo.yaml", *AT)
    refused = shell("apply", MANIFEST, *AT, "--yes", code=5).err
    assert "image ros:jazzy is not pinned" in refused
    assert "--resolve-image" in refused
    assert cloud.machines == {}
