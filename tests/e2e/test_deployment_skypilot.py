"""What SkyPilot, as the tests simulate it, does to a deployment; tests/slurm and tests/aws have the real one.

A life from apply to down on such a cloud: tests/e2e/test_shared_cloud.py.
"""

import json
import os
import signal
from collections.abc import Mapping
from typing import Any

import pytest

from fogspec.backends.protocol import Unreachable
from fogspec.backends.skypilot.errors import CloudProblem
from tests.support.deployed_cloud import AT, MANIFEST, cloud  # noqa: F401
from tests.support.fake_sky import Cloud
from tests.support.results import remove
from tests.support.running import Shell, measure, shell  # noqa: F401


def change(shell: Shell, old: str, new: str) -> None:
    before = shell.read("specs/demo.yaml")
    assert old in before
    shell.write("specs/demo.yaml", before.replace(old, new))


def status(shell: Shell) -> dict:
    return json.loads(shell("status", "-o", "json").out)[0]["deployment"]


def test_the_deployment_is_found_by_its_label_when_the_state_is_lost(shell: Shell, cloud: Cloud) -> None:
    shell("apply", MANIFEST, "--yes")
    (shell.folder / ".fogspec/demo/deployment.yaml").unlink()
    (name,) = cloud.machines
    refused = shell("apply", MANIFEST, "--yes", code=5).err
    assert name in refused, "a second one beside it would cost twice, and nobody would know"
    assert "fogspec down demo" in refused
    assert list(cloud.machines) == [name]
    assert "1 ended" in shell("down", "demo").out
    assert cloud.machines == {}


def test_a_price_that_rose_at_the_launch_is_refused(shell: Shell, cloud: Cloud) -> None:
    cloud.fails = lambda op, _words: CloudProblem("budget", "it costs $0.5 per hour now") if op == "launch" else None
    assert "it costs $0.5 per hour now" in shell("apply", MANIFEST, "--yes", code=5).err
    assert cloud.machines == {}


def test_no_contact_while_it_serves(shell: Shell, cloud: Cloud) -> None:
    shell("apply", MANIFEST, "--yes")
    cloud.fails = lambda _op, _words: Unreachable("the network is down")
    assert status(shell)["health"] == "Unknown"
    assert "status unknown: no contact with the machine: the network is down" in shell("status").out
    assert "status unknown, no contact" in shell("apply", MANIFEST, "--yes", code=6).err
    assert "the network is down" in shell("down", "demo", code=6).err
    cloud.fails = lambda _op, _words: None
    assert len(cloud.machines) == 1
    shell("down", "demo")
    assert cloud.machines == {}
    left = [path.name for path in (shell.folder / ".fogspec/demo").iterdir()]
    assert left == ["deployment.yaml"], "the history"


def test_a_rented_machine_that_was_rebooted_is_still_paid(shell: Shell, cloud: Cloud) -> None:
    shell("apply", MANIFEST, "--yes")
    (name,) = cloud.machines
    cloud.not_up[name] = "INIT"
    said = shell("status").out
    assert "Unknown" in said
    assert "it is there and still paid, and SkyPilot on it does not answer, as after a reboot" in said
    cloud.not_up[name] = "STOPPED"
    said = shell("status").out
    assert "Degraded" in said
    assert "its machine was turned off, and its disk is still paid" in said
    shell("down", "demo")
    assert cloud.machines == {}


def test_an_api_server_that_dies_while_it_is_asked(shell: Shell, cloud: Cloud) -> None:
    left = iter([None, None, Unreachable("API server died"), Unreachable("API server died")])
    cloud.fails = lambda op, _words: next(left, None) if op in ("find", "launched", "jobs") else None
    shell("apply", MANIFEST, "--yes")
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
    said = shell("apply", MANIFEST, "--yes", code=0 if times == 1 else 6).err
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
    assert "what was being started is gone" in shell("apply", MANIFEST, "--yes", code=130).err
    assert len(asked) == 1
    assert cloud.machines == {}


def test_a_machine_that_was_reclaimed(shell: Shell, cloud: Cloud) -> None:
    shell("apply", MANIFEST, "--yes")
    (name,) = cloud.machines
    cloud.end(name)
    assert status(shell)["health"] == "Missing"
    shell("apply", MANIFEST, "--yes")
    assert list(cloud.machines) != [name]
    shell("down", "demo")


def test_a_watch_replaces_a_reclaimed_machine_once_and_starts_nothing_without_contact(
    shell: Shell, cloud: Cloud
) -> None:
    watch = ("watch", "demo", "--once", "--yes")
    shell("apply", MANIFEST, "--yes")
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
    change(shell, "  probe:", "  deployment: {until: 2h, budget: $1}\n  probe:")
    shell("compile", "specs/demo.yaml", *AT)
    said = shell("apply", MANIFEST, "--yes").err
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
    shell("watch", "demo", "--once", "--yes")
    assert cloud.machines == {}
    assert status(shell) is None


def test_an_image_without_a_digest(shell: Shell, cloud: Cloud) -> None:
    change(shell, "  probe:", "  ros: {distro: jazzy, image: 'ros:jazzy'}\n  probe:")
    shell("compile", "specs/demo.yaml", *AT)
    remove(shell.folder / "results/demo")
    measure(shell)
    shell("compile", "specs/demo.yaml", *AT)
    refused = shell("apply", MANIFEST, "--yes", code=5).err
    assert "image ros:jazzy is not pinned" in refused
    assert "--resolve-image" in refused
    assert cloud.machines == {}
