"""`fogspec doctor`: what is wrong on this side, before any money; it starts and writes nothing."""

import importlib.metadata
import json
from pathlib import Path
from typing import Any

import pytest

from fogspec.backends import registry
from fogspec.backends.skypilot import backend, client
from fogspec.base import clouds
from tests.support.fake_sky import Cloud, SimulatedClient
from tests.support.running import Shell, project, shell, spec  # noqa: F401

AT = ("--catalog", "offers.csv")
LOCAL = {"infra": "[local]", "hardware": "{cpus: 1..2}"}


@pytest.fixture
def cloud(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> Cloud:
    made = Cloud(shell.folder.parent / "cloud")
    monkeypatch.setattr(registry, "deployment_backend", lambda _: backend.SkyPilotDeployments(SimulatedClient(made)))
    return made


def checked(shell: Shell, *words: str, code: int | None = 0) -> dict[str, list[dict[str, Any]]]:
    """The checks by what they look at; and nothing was written."""
    before = files(shell.folder)
    said = json.loads(shell("doctor", *words, *AT, "-o", "json", code=code).out)
    assert files(shell.folder) == before
    return {one["what"]: [other for other in said if other["what"] == one["what"]] for one in said}


def files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def local(shell: Shell) -> None:
    shell.write("offers.csv", "Cloud,InstanceType,vCPUs,MemoryGiB,Price,Region\nlocal,1cpu-1gib,1,1,0.02,\n")
    shell.write("specs/work.py", "print('work')\n")
    shell.write("specs/demo.yaml", spec(**LOCAL))


def test_a_local_spec_is_fine_and_skypilot_is_not_asked(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    local(shell)
    monkeypatch.setattr(registry, "deployment_backend", lambda _: pytest.fail("a backend was asked"))
    found = checked(shell, "demo")
    assert {one["state"] for each in found.values() for one in each} == {"ok", "not checked"}
    assert found.keys() == {"files", "catalog", "lock", "disk", "state", "left over"}
    assert [one["fixes"] for one in found["lock"]] == [["fogspec lock specs/demo.yaml"]]
    text = shell("doctor", *AT).out
    assert text.startswith("demo\n  ok ")
    assert "problem" not in text


def test_a_missing_file_is_a_problem(shell: Shell) -> None:
    local(shell)
    (shell.folder / "specs/work.py").unlink()
    (missing,) = checked(shell, "demo", code=1)["files"]
    assert missing["state"] == "problem"
    assert "FS545" in missing["detail"]
    assert "work.py" in missing["detail"]
    assert missing["fixes"]


def test_secrets_images_and_what_changed_since_the_lock(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    local(shell)
    monkeypatch.delenv("ROBOT_TOKEN", raising=False)
    shell("lock", "specs/demo.yaml", *AT)
    assert checked(shell, "demo")["lock"][0]["state"] == "ok"
    shell.write("specs/work.py", "print('other work')\n")
    changed = checked(shell, "demo", code=1)["lock"][0]
    assert changed["detail"] == "work.py is not what the lock says"
    shell.write("specs/demo.yaml", spec(**LOCAL, secrets="[ROBOT_TOKEN]", ros="{distro: jazzy, image: 'ros:jazzy'}"))
    found = checked(shell, "demo", code=1)
    assert "ROBOT_TOKEN" in found["secrets"][0]["detail"]
    assert "ros:jazzy is not pinned" in found["image"][0]["detail"]


def test_a_full_disk_is_a_problem(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    from fogspec.deploy import doctor

    local(shell)
    monkeypatch.setattr(doctor, "SPARE_BYTES", 2**80)
    assert checked(shell, "demo", code=1)["disk"][0]["state"] == "problem"


def test_machines_left_over_are_a_problem(shell: Shell, cloud: Cloud) -> None:
    project(shell)
    fine = checked(shell, "demo", code=None)
    assert [one["state"] for one in fine["left over"]] == ["ok"]
    live = ".fogspec/demo/deployment.yaml"
    shell.write(live, "spec: {machines: [\n")
    damaged = checked(shell, "demo", code=1)["left over"]
    assert [one["state"] for one in damaged] == ["problem"]
    assert live in damaged[0]["detail"]
    assert "fogspec down demo" in damaged[0]["fixes"][0]


def test_a_machine_in_the_journal_that_was_not_verified_gone(shell: Shell, cloud: Cloud) -> None:
    project(shell)
    sample = plan_sample(shell)
    started = {
        "do": "start", "name": "fogspec-demo-1", "runner": "skypilot", "application": "a", "sample": sample,
        "price_usd_per_hour": 0.1, "lifetime_s": 60.0, "paid_s": 90.0, "at_s": 1.0, "at_unix_s": 1.0, "boot": "b",
    }  # fmt: skip
    begun = {"do": "campaign", "runner": "skypilot", "application": "a", "plan": "p", "base_usd": 0.0}
    shell.write(".fogspec/demo/journal.jsonl", "".join(json.dumps(one) + "\n" for one in (begun, started)))
    (left,) = checked(shell, "demo", code=1)["left over"]
    assert left["detail"] == "fogspec-demo-1 was measuring and is not verified gone"
    assert left["fixes"][0].startswith("fogspec bench specs/demo.yaml")


def plan_sample(shell: Shell) -> dict[str, Any]:
    from fogspec.plan.schema import Plan
    from fogspec.spec.loader import read_document

    plan = read_document(shell.folder / "compiled/demo/plan.yaml", Plan)
    return plan.spec.samples[0].model_dump(mode="json")


def test_without_skypilot_its_access_is_not_checked(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    project(shell)

    def missing(_: str) -> str:
        raise importlib.metadata.PackageNotFoundError

    monkeypatch.setattr(client.importlib.metadata, "version", missing)
    found = checked(shell, "demo", code=1)
    assert found["SkyPilot"][0]["fixes"] == ["pip install 'fogspec[sky]'"]
    assert found["access"][0]["state"] == "not checked"


def test_access_and_version_are_skypilots_own(shell: Shell, cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    project(shell)
    monkeypatch.setattr(client.importlib.metadata, "version", lambda _: "0.14.1")
    found = checked(shell, "demo", code=None)
    assert (found["SkyPilot"][0]["state"], found["access"][0]["state"]) == ("ok", "ok")
    assert found["quota"][0]["fixes"] == [clouds.cloud_of("aws").quota.format(region="r1")]
    cloud.without_access = ("aws",)
    monkeypatch.setattr(client.importlib.metadata, "version", lambda _: "0.9.0")
    found = checked(shell, "demo", code=1)
    assert "0.9.0 is installed" in found["SkyPilot"][0]["detail"]
    assert found["access"][0]["state"] == "problem"
    assert "sky check aws" in found["access"][0]["fixes"][1]


@pytest.mark.parametrize("tool", ["ssh", "rsync"])
def test_a_tool_that_is_not_there_is_a_problem(
    shell: Shell, cloud: Cloud, monkeypatch: pytest.MonkeyPatch, tool: str
) -> None:
    project(shell)
    monkeypatch.setenv("PATH", str(shell.folder))
    assert checked(shell, "demo", code=1)[tool][0]["fixes"] == [f"install {tool}"]


def test_state_that_git_tracks_is_a_problem(shell: Shell) -> None:
    import subprocess

    local(shell)
    shell.write(".fogspec/demo/deployment.yaml", "spec: {machines: []}\n")
    for words in (["init", "-q"], ["add", "-f", "."]):
        subprocess.run(["git", "-C", str(shell.folder), *words], check=True)
    found = checked(shell, "demo", code=1)
    assert "git tracks it" in found["state"][0]["detail"]
    assert "left over" not in found


def test_a_place_without_prices_is_a_problem_and_no_other_clouds_list_is_named(shell: Shell) -> None:
    local(shell)
    text = shell("doctor", "demo", "--catalog", "snapshot", code=1).out
    assert "problem      catalog    no price list has machines in local" in text
    assert "fogspec lock specs/demo.yaml --catalog FILE" in text
    assert "AWS" not in text
    shell.write(
        "specs/demo.yaml", spec(**LOCAL, benchmark="{budget: $5, machines: [local/1cpu-1gib, local/2cpu-1gib]}")
    )
    text = shell("compile", "demo", "--catalog", "snapshot").out
    assert "catalog   no price list has machines in local\n            write a CSV with the columns Cloud," in text
    assert "next: fogspec lock specs/demo.yaml --catalog FILE" in text
    assert "AWS" not in text
    assert "fogspec bench" not in text
    shell.write("prices.csv", (shell.folder / "offers.csv").read_text())
    shell("lock", "specs/demo.yaml", "--catalog", "prices.csv")
    assert "next: fogspec bench specs/demo.yaml" in shell("compile", "demo").out, "the command is the right one"
    shell.write("specs/demo.yaml", spec(infra="[gcp/us-central1]", hardware="{cpus: 1..2}"))
    (missing,) = checked(shell, "demo", code=1)["catalog"]
    assert missing["detail"].endswith("no machine in gcp/us-central1")
