"""Requirements of `bench` and `apply`, which `--dry-run` prints before any money; it starts no machine and writes nothing."""

import importlib.metadata
import json
from pathlib import Path
from typing import Any

import pytest

from fogspec.backends import registry
from fogspec.backends.protocol import Unreachable
from fogspec.backends.skypilot import backend, client
from fogspec.base import clouds
from tests.support.fake_sky import Cloud, SimulatedClient
from tests.support.running import Shell, measure, project, shell, spec  # noqa: F401

AT = ("--catalog", "offers.csv")
LOCAL = {"infra": "[local]", "hardware": "{cpus: 1..2}"}
BEGIN = client.Client.begin  # in whose place is that of tests, which starts no process


@pytest.fixture
def cloud(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> Cloud:
    made = Cloud(shell.folder.parent / "cloud")
    monkeypatch.setattr(registry, "deployment_backend", lambda _: backend.SkyPilotDeployments(SimulatedClient(made)))
    return made


def checked(shell: Shell, *words: str, code: int | None = 0) -> dict[str, list[dict[str, Any]]]:
    """The checks by what they look at; and nothing was written."""
    before = files(shell.folder)
    said = json.loads(shell("bench", *words, "--dry-run", "-o", "json", code=code).out)
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
    shell("lock", *AT)
    monkeypatch.setattr(registry, "deployment_backend", lambda _: pytest.fail("a backend was asked"))
    found = checked(shell, "demo")
    assert {one["state"] for each in found.values() for one in each} == {"ok", "not checked"}
    assert found.keys() == {"files", "plan", "catalog", "lock", "disk", "state", "left over"}
    assert [(one["state"], one["fixes"]) for one in found["plan"]] == [
        ("not checked", ["fogspec compile specs/demo.yaml"])
    ]
    assert [one["state"] for one in found["lock"]] == ["ok"]
    text = shell("bench", "demo", "--dry-run").out
    assert text.startswith("demo\n  ok ")
    assert text.endswith("next: fogspec compile specs/demo.yaml\n")
    assert "problem" not in text


def test_a_missing_file_is_a_problem(shell: Shell) -> None:
    local(shell)
    (shell.folder / "specs/work.py").unlink()
    (missing,) = checked(shell, "demo", code=1)["files"]
    assert missing["state"] == "problem"
    assert "FS545" in missing["detail"]
    assert "work.py" in missing["detail"]
    assert missing["fixes"]


def test_secrets_images_and_the_lock(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    local(shell)
    monkeypatch.delenv("ROBOT_TOKEN", raising=False)
    shell("lock", "specs/demo.yaml", *AT)
    assert checked(shell, "demo")["lock"][0]["state"] == "ok"
    shell.write("specs/work.py", "print('other work')\n")
    assert checked(shell, "demo")["lock"][0]["state"] == "ok", "it freezes the catalog and the image only"
    shell.write("specs/demo.yaml", spec(**LOCAL, secrets="[ROBOT_TOKEN]", ros="{distro: jazzy, image: 'ros:jazzy'}"))
    found = checked(shell, "demo", code=1)
    assert "ROBOT_TOKEN" in found["secrets"][0]["detail"]
    assert found["image"][0]["state"] == "not checked", "bench may measure it"
    assert "ros:jazzy is not pinned" in found["image"][0]["detail"]


def test_a_full_disk_is_a_problem(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    from fogspec.deploy import checks

    local(shell)
    monkeypatch.setattr(checks, "SPARE_BYTES", 2**80)
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
    from fogspec.language.loader import read_document
    from fogspec.plan.schema import Plan

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
    shown = shell("bench", "demo", "--dry-run")
    assert "if its API server does not run on this computer, that starts, and ends then" in shown.err
    assert shown.out.index("SkyPilot has access to aws") < shown.out.index("for disk and address, at most $"), (
        "and the price"
    )
    assert found["quota"][0]["fixes"] == [clouds.cloud_of("aws").quota.format(region="r1")]
    cloud.without_access = ("aws",)
    monkeypatch.setattr(client.importlib.metadata, "version", lambda _: "0.9.0")
    found = checked(shell, "demo", code=1)
    assert "0.9.0 is installed" in found["SkyPilot"][0]["detail"]
    assert found["access"][0]["state"] == "problem"
    assert "sky check aws" in found["access"][0]["fixes"][1]


@pytest.mark.parametrize("access", ["granted", "denied", "unknown"])
@pytest.mark.parametrize("served", [True, False])
def test_the_server_that_a_dry_run_starts_is_ended(shell: Shell, cloud: Cloud, access: str, served: bool) -> None:
    project(shell)
    cloud.served = served
    if access == "denied":
        cloud.without_access = ("aws",)
    if access == "unknown":
        cloud.fails = lambda op, _: Unreachable("no contact") if op == "denied" else None
    assert "that starts, and ends then" in shell("bench", "demo", "--dry-run", code=None).err
    assert cloud.servers_ended == (0 if served else 1)


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
    shell.write(
        "specs/demo.yaml", spec(**LOCAL, benchmark="{budget: $5, machines: [local/1cpu-1gib, local/2cpu-1gib]}")
    )
    text = shell("compile", "demo", "--catalog", "snapshot").out
    assert "AWS on-demand, Linux: no machine in local\n            the shapes of this host: --catalog host" in text
    assert "next: fogspec compile specs/demo.yaml --catalog host\n" in text
    assert "fogspec bench" not in text
    assert "next: fogspec bench specs/demo.yaml" in shell("compile", "demo", "--catalog", "host").out
    shell.write("specs/demo.yaml", spec(infra="[local, slurm/lab]", hardware="{cpus: 1..2}"))
    text = shell("bench", "demo", "--dry-run", code=None).out
    assert "catalog    no price list has machines in local, slurm/lab" in text
    assert "fogspec lock specs/demo.yaml --catalog FILE" in text
    shell.write("specs/demo.yaml", spec(infra="[gcp/us-central1]", hardware="{cpus: 1..2}"))
    (missing,) = checked(shell, "demo", code=3)["catalog"]
    assert missing["detail"].endswith("no machine in gcp/us-central1")


def test_an_api_server_without_an_answer_is_not_checked_and_the_price_is_printed(
    shell: Shell, cloud: Cloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    project(shell)
    monkeypatch.setattr(client.importlib.metadata, "version", lambda _: "0.14.1")
    cloud.fails = lambda _op, _words: Unreachable("connection refused")
    found = checked(shell, "demo")
    assert (found["access"][0]["state"], found["access"][0]["fixes"]) == (
        "not checked",
        ["see what it says itself: sky api status"],
    )
    shown = shell("bench", "demo", "--dry-run")
    assert "not checked  access     SkyPilot does not answer: connection refused" in shown.out
    assert "4 of 4 samples to measure: at most $" in shown.err


def test_skypilot_itself_answers_as_its_stand_in_in_tests(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    project(shell)
    by_stand_in = checked(shell, "demo", code=None)
    monkeypatch.setattr(client.Client, "begin", BEGIN)
    itself = checked(shell, "demo", code=None)
    for (one,) in (by_stand_in["access"], itself["access"]):
        assert one.pop("detail").startswith("SkyPilot does not answer: ")
    assert itself == by_stand_in


def test_apply_has_its_own_requirements(shell: Shell, cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    project(shell)
    measure(shell)
    shell("compile", "demo", *AT)
    monkeypatch.setattr(client.importlib.metadata, "version", lambda _: "0.14.1")
    before = files(shell.folder)
    fine = shell("apply", "demo", "--dry-run")
    assert "ok           access     SkyPilot has access to aws" in fine.out
    assert "costs     $" in fine.err
    assert "next: fogspec apply" in fine.out
    cloud.without_access = ("aws",)
    found = json.loads(shell("apply", "demo", "--dry-run", "-o", "json", code=1).out)
    (access,) = [one for one in found if one["what"] == "access"]
    assert (access["state"], access["application"]) == ("problem", None)
    assert files(shell.folder) == before
    assert (cloud.machines, cloud.closed) == ({}, 2), "no worker is left"
