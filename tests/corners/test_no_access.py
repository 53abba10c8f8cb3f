"""A login that is missing or has expired costs nothing: no record, no money, and what was measured stays."""

import importlib.metadata
import json
from collections.abc import Iterator

import pytest

from fogspec.backends import registry
from fogspec.backends.protocol import Unreachable
from fogspec.backends.skypilot import backend, client
from fogspec.backends.skypilot.errors import CloudProblem
from fogspec.bench import attempt
from fogspec.catalog import sources
from tests.e2e.test_bench_money import _Shop
from tests.support import results as measured_files
from tests.support.fake_sky import Cloud, SimulatedClient
from tests.support.running import Ended, Shell, measure, project, shell, spec  # noqa: F401

AT = ("--catalog", "offers.csv")
DENIED = CloudProblem("access", "NoCloudAccessError: the security token in the request is expired", refused=True)
WORK = """\
import time
import fogspec_probe
for _ in range(400):
    fogspec_probe.start("plan")
    time.sleep(0.002)
    fogspec_probe.stop("plan")
"""


@pytest.fixture
def cloud(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cloud]:
    monkeypatch.setattr(sources, "load_catalog", _Shop(lambda *_: (_ for _ in ()).throw(sources_missing())))
    project(shell)
    shell.write("specs/work.py", WORK)
    shell("compile", "specs/demo.yaml", *AT)
    made = Cloud(shell.folder.parent / "cloud")
    monkeypatch.setattr(backend.SkyPilotSamples, "poll_s", 0.05)
    monkeypatch.setattr(backend, "LAUNCH_POLL_S", 0.05)
    monkeypatch.setattr(registry, "sample_backend", lambda _: lambda: backend.SkyPilotSamples(SimulatedClient(made)))
    monkeypatch.setattr(registry, "deployment_backend", lambda _: backend.SkyPilotDeployments(SimulatedClient(made)))
    yield made
    for name in list(made.machines):
        made.end(name)


def sources_missing() -> Exception:
    from fogspec.base.errors import InvalidInput

    return InvalidInput("no SkyPilot here")


def bench(shell: Shell, *words: str, code: int = 0) -> Ended:
    return shell("bench", "specs/demo.yaml", "--runner", "skypilot", "--yes", *words, code=code)


def results(shell: Shell) -> dict:
    return measured_files.document(shell.folder / "results/demo")


def test_without_access_nothing_is_started_recorded_or_paid(shell: Shell, cloud: Cloud) -> None:
    cloud.without_access = ("aws",)
    said = bench(shell, code=6)
    assert "SkyPilot cannot start a machine: it has no access to aws" in said.err
    assert "sky check aws" in said.err
    assert cloud.machines == {}
    assert not (shell.folder / "results").exists()
    cloud.without_access = ()
    assert "4 of 4 samples to measure" in bench(shell, "--dry-run").err


def test_an_api_server_that_does_not_answer_costs_nothing(shell: Shell, cloud: Cloud) -> None:
    cloud.fails = lambda _op, _words: Unreachable("connection refused")
    said = bench(shell, code=6)
    assert "SkyPilot does not answer: connection refused" in said.err
    assert "sky api status" in said.err
    assert not (shell.folder / "results").exists()


@pytest.mark.parametrize("op", ["launch", "launched"])
def test_a_launch_that_is_denied_ends_the_bench_without_a_record(shell: Shell, cloud: Cloud, op: str) -> None:
    """What SkyPilot remembers of the login was true once."""
    cloud.fails = lambda asked, _words: DENIED if asked == op else None
    said = bench(shell, code=6)
    assert "the security token in the request is expired" in said.err
    assert not (shell.folder / "results").exists()
    journal = [json.loads(line) for line in shell.read(".fogspec/demo/journal.jsonl").splitlines()]
    assert [one["spent_usd"] for one in journal if one["do"] == "end"]
    assert sum(one["spent_usd"] for one in journal if one["do"] == "end") == 0
    cloud.fails = lambda *_: None
    bench(shell)
    assert {one["state"] for one in results(shell)["samples"]} == {"ok"}


def test_credentials_that_expire_in_the_middle_lose_no_sample(shell: Shell, cloud: Cloud) -> None:
    launched: list[str] = []

    def fails(op: str, words: dict) -> CloudProblem | None:
        if op == "launch":
            launched.append(words["name"])
        return DENIED if op == "launch" and len(launched) > 1 else None

    cloud.fails = fails
    said = bench(shell, "--at-once", "1", code=6)
    assert "expired" in said.err
    assert [one["state"] for one in results(shell)["samples"]] == ["ok"]
    cloud.fails = lambda *_: None
    assert "3 of 4 samples to measure" in bench(shell).err
    assert [one["state"] for one in results(shell)["samples"]] == ["ok"] * 4


def test_a_machine_that_cannot_be_verified_gone_without_access_is_found_again_with_it(
    shell: Shell, cloud: Cloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(attempt, "STOP_BACKOFF_S", 0.1)
    monkeypatch.setattr(attempt, "NO_ACCESS_PATIENCE_S", 0.5)
    cloud.fails = lambda _op, _words: DENIED if cloud.machines else None
    said = bench(shell, "--at-once", "1", code=6)
    (left,) = cloud.machines
    assert left in said.out + said.err
    assert "cannot be verified" in said.err
    said = bench(shell, "--at-once", "1", code=6)
    assert "expired" in said.err
    assert [*cloud.machines] == [left], "nothing more is started"
    assert not (shell.folder / "results").exists()

    cloud.fails = lambda *_: None
    bench(shell, "--resume")
    assert cloud.machines == {}
    assert [one["state"] for one in results(shell)["samples"]] == ["ok"] * 4
    journal = [json.loads(line) for line in shell.read(".fogspec/demo/journal.jsonl").splitlines()]
    assert [one["name"] for one in journal if one["do"] == "start" and one["name"] == left] == [left]
    assert {one["name"] for one in journal if one["do"] == "start"} == {
        one["name"] for one in journal if one["do"] == "end"
    }


def test_a_failed_sample_never_replaces_a_measured_one(shell: Shell, cloud: Cloud) -> None:
    bench(shell)
    before = results(shell)["samples"]
    cloud.fails = lambda op, _words: CloudProblem("image", "manifest unknown") if op == "launched" else None
    bench(shell, "--only", before[0]["id"])
    assert results(shell)["samples"] == before
    assert (shell.folder / f"results/demo/timings/{before[0]['id']}.jsonl.gz").is_file()


def test_a_dry_run_needs_no_skypilot(shell: Shell, cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(_: str) -> str:
        raise importlib.metadata.PackageNotFoundError

    monkeypatch.setattr(client.importlib.metadata, "version", missing)
    monkeypatch.setattr(registry, "sample_backend", lambda _: backend.SkyPilotSamples)
    shown = bench(shell, "--dry-run", code=1)
    assert "at most $" in shown.err
    assert "problem      SkyPilot   SkyPilot is not installed here" in shown.out
    assert "pip install 'fogspec[sky]'" in bench(shell, code=2).err
    assert not (shell.folder / "results").exists()


@pytest.mark.parametrize("when", ["before", "at the launch"])
def test_an_apply_without_access_starts_nothing(shell: Shell, cloud: Cloud, when: str) -> None:
    measure(shell)
    shell("compile", "specs/demo.yaml", *AT)
    if when == "before":
        cloud.without_access = ("aws",)
    else:
        cloud.fails = lambda op, _words: DENIED if op == "launch" else None
    said = shell("apply", "compiled/demo/manifest.yaml", "--yes", code=6)
    assert "SkyPilot cannot start a machine" in said.err
    assert "sky check" in said.err
    assert cloud.machines == {}
    live = json.loads(shell("status", "-o", "json").out)[0]["deployment"]
    assert live is None or live["machine"] is None


FORBIDDEN = 'pods is forbidden: User "me" cannot create resource "pods" in API group "" in the namespace "robots"'


class ResourcesUnavailableError(Exception):
    """As SkyPilot's: what the provider said is in its text."""


def test_a_namespace_without_rights_starts_nothing(shell: Shell, cloud: Cloud) -> None:
    cloud.fails = lambda op, _words: ResourcesUnavailableError(FORBIDDEN) if op == "launched" else None
    said = bench(shell, code=6).err
    assert f"SkyPilot cannot start a machine: {FORBIDDEN}" in said
    assert "kubectl auth can-i create pods" in said
    assert cloud.machines == {}
    assert not (shell.folder / "results").exists()


def test_a_region_without_quota_says_where_to_look(shell: Shell, cloud: Cloud) -> None:
    words = "VcpuLimitExceeded: You have requested more vCPU capacity than your current vCPU limit of 0 allows"
    cloud.fails = lambda op, _words: ResourcesUnavailableError(words) if op == "launched" else None
    said = bench(shell, code=1)
    assert words in said.out
    assert "aws service-quotas list-service-quotas --service-code ec2 --region r1 lists it" in said.out
    assert cloud.machines == {}
    assert {(one["reason"], float(one["spent"].removeprefix("$"))) for one in results(shell)["samples"]} == {
        ("quota", 0.0)
    }


@pytest.mark.parametrize(
    ("place", "known", "words"),
    [
        ("kubernetes/nolab", ("aws", "kubernetes/lab", "kubernetes/office"), "kubernetes/lab, kubernetes/office"),
        ("slurm/nolab", ("slurm/lab",), "slurm/lab"),
    ],
)
def test_a_context_or_cluster_that_is_not_configured_starts_no_machine(
    shell: Shell, cloud: Cloud, place: str, known: tuple[str, ...], words: str
) -> None:
    name, _, region = place.partition("/")
    prices = "Cloud,InstanceType,vCPUs,MemoryGiB,Price,Region\n"
    shell.write("offers.csv", prices + "".join(f"{name},{n}CPU--8GB,{n},8,0.{n},{region}\n" for n in (2, 4, 8)))
    shell.write("specs/demo.yaml", spec(infra=f"[{place}]"))
    shell("compile", "specs/demo.yaml", *AT)
    cloud.known = known
    said = bench(shell, code=6).err
    assert f"spec.infra: SkyPilot has no {place}" in said
    assert f"write one that it has: {words}" in said
    assert f"sky check {name}" in said
    assert cloud.machines == {}
    assert not (shell.folder / "results").exists()
    checked = shell("bench", "demo", "--dry-run", code=1).out
    assert f"problem      access     spec.infra: SkyPilot has no {place}" in checked
    cloud.known = (*known, place)
    assert "SkyPilot has access" in shell("bench", "demo", "--dry-run").out


def test_a_shape_that_no_node_allocates_is_told_where_to_look(shell: Shell, cloud: Cloud) -> None:
    prices = "Cloud,InstanceType,vCPUs,MemoryGiB,Price,Region\n"
    shell.write("offers.csv", prices + "kubernetes,8CPU--8GB,8,8,0.8,lab\n")
    shell.write("specs/demo.yaml", spec(infra="[kubernetes/lab]"))
    shell("compile", "specs/demo.yaml", *AT)
    cloud.known = ("kubernetes/lab",)
    words = "0/1 nodes are available: 1 Insufficient cpu"
    cloud.fails = lambda op, _words: CloudProblem("capacity", words) if op == "launched" else None
    said = bench(shell, code=1).out
    assert words in said
    assert "a pod gets what its node allocates, less than the node has: kubectl describe nodes lists it" in said
