"""A task is refused at the launch unless it asks for the job's own machine, price, end and files."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fogspec.backends.local.backend import LocalSamples
from fogspec.backends.naming import Owner
from fogspec.backends.protocol import Job, LaunchRefused
from fogspec.backends.skypilot.backend import SkyPilotDeployments, SkyPilotSamples
from fogspec.backends.task_check import check_sources, check_task
from fogspec.base import digest
from fogspec.catalog.machine import Gpu, Machine
from tests.support.fake_sky import Cloud, SimulatedClient
from tests.support.jobs import config, job_of, resources

OWNER = Owner("a repository", "default", "demo")
MACHINES = {
    "plain": Machine(infra="aws/r1", instance="c6i.large", cpus=2, memory="4GiB", price="$0.085/h"),
    "spot": Machine(infra="aws/r1", instance="c6i.large", cpus=2, memory="4GiB", price="$0.03/h", spot=True),
    "gpu": Machine(
        infra="gcp/r1", instance="n1-4", cpus=4, memory="16GiB", price="$0.7/h", gpu=Gpu(name="T4", count=1)
    ),
    "partition": Machine(infra="slurm/lab/small", instance="s", cpus=2, memory="4GiB", price="$0.1/h"),
    "preempted": Machine(infra="slurm/lab/spare", instance="s", cpus=2, memory="4GiB", price="$0.1/h", spot=True),
}
# What selects no machine, has no price and moves no file is compared by the commands that compile.
FREE = {"name", "setup", "run", "workdir", "resources.labels.fogspec-application"}
ADDED: dict[str, Any] = {
    "num_nodes": 100,
    "service": {"replicas": 9},
    "volumes": {"/data": "disk"},
    "config": {"kubernetes": {}},
    "resources.any_of": [{"instance_type": "p5.48xlarge"}],
    "resources.ordered": [{"instance_type": "p5.48xlarge"}],
    "resources.accelerators": "H100:8",
    "resources.use_spot": True,
    "resources.disk_size": 10_000,
    "resources.region": "r2",
    "resources.zone": "r2a",
    "resources.job_recovery": "failover",
    "resources.autostop.hook": "sleep 99999",
    "file_mounts.~/.aws": "work",
    "file_mounts.~/.fogspec/link": "~/.aws",
}
OTHER: dict[str, Any] = {
    "resources.infra": "aws/r2",
    "resources.instance_type": "p5.48xlarge",
    "resources.cpus": "96+",
    "resources.memory": "999",
    "resources.max_hourly_cost": 99.0,
    "resources.disk_size": 256,
    "resources.use_spot": False,
    "resources.accelerators": "H100:8",
    "resources.autostop.idle_minutes": 60_000,
    "resources.autostop.down": False,
    "resources.autostop.wait_for": "jobs_and_ssh",
    "resources.autostop": False,
    "resources": {},
    "config": {"slurm": {"sbatch_options": {"time": 60_000}}},
    "workdir": "..",
    "file_mounts.~/.fogspec/agent.pyz": "~/.ssh/id_ed25519",
    "file_mounts": {"/root/.aws": "~/.aws"},
}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "project"
    (folder / "specs").mkdir(parents=True)
    (folder / "agent.pyz").write_text("the agent")
    (folder / "link").mkdir()
    (folder / "link" / "link.sh").write_text("a script")
    return folder


def job(root: Path, machine: Machine, sample: bool, task: Mapping[str, Any] | None = None) -> Job:
    lifetime_s = 600.0 if sample else None
    compiled = {
        "name": "demo",
        "resources": {
            **resources(machine, lifetime_s),
            **({"use_spot": True} if machine.spot and not machine.infra.startswith("slurm/") else {}),
            **({"accelerators": machine.gpu.key} if machine.gpu else {}),
            "labels": {"fogspec-application": "demo"},
        },
        "workdir": "specs",
        "file_mounts": {"~/.fogspec/agent.pyz": "agent.pyz"},
        "setup": "true",
        "run": "true",
        **config(machine, lifetime_s),
    }
    name = f"{OWNER.prefix}one"
    return job_of(root, task or compiled, name=name, owner=OWNER, directory=root / "job", machine=machine,
                  lifetime_s=lifetime_s)  # fmt: skip


def paths(task: Mapping[str, Any], above: str = "") -> Iterator[str]:
    for key, value in task.items():
        yield f"{above}{key}"
        if isinstance(value, Mapping):
            yield from paths(value, f"{above}{key}.")


def edited(task: Mapping[str, Any], path: str, value: Any) -> dict[str, Any]:
    """The task with one value changed or added, or dropped for None. Targets of mounts have dots: they are one key."""
    key, _, rest = path.partition(".")
    if not rest or key == "file_mounts":
        inner = value if not rest else edited_mounts(task[key], rest, value)
        found = {**task, key: inner}
    else:
        found = {**task, key: edited(task[key], rest, value)}
    return {name: one for name, one in found.items() if one is not None}


def edited_mounts(mounts: Mapping[str, Any], target: str, value: Any) -> dict[str, Any]:
    return {name: one for name, one in {**mounts, target: value}.items() if one is not None}


def edits(whole: Job) -> Iterator[tuple[str, dict[str, Any]]]:
    present = list(paths(whole.task))
    for path in present:
        if path not in FREE:
            yield f"{path} dropped", edited(whole.task, path, None)
        if path in OTHER:
            yield f"{path} changed", edited(whole.task, path, OTHER[path])
    for path, value in ADDED.items():
        if path not in present:
            yield f"{path} added", edited(whole.task, path, value)


@pytest.mark.parametrize("sample", [True, False], ids=["sample", "deployment"])
@pytest.mark.parametrize("machine", MACHINES.values(), ids=MACHINES)
def test_every_other_key_is_refused_before_anything_is_started(root: Path, machine: Machine, sample: bool) -> None:
    cloud = Cloud(root.parent / "cloud")
    backend = (SkyPilotSamples if sample else SkyPilotDeployments)(SimulatedClient(cloud))
    harmless = {"file_mounts dropped", "file_mounts.~/.fogspec/agent.pyz dropped", "resources.labels dropped"}
    tried = 0
    for what, task in edits(job(root, machine, sample)):
        if what in harmless:
            continue
        tried += 1
        with pytest.raises(LaunchRefused, match="so nothing was started"):
            start(backend, job(root, machine, sample, task), what)
    assert tried >= 24
    assert cloud.machines == {}
    assert not (root / "job").exists()
    backend.start(job(root, machine, sample))
    assert len(cloud.machines) == 1


def start(backend: Any, tampered: Job, what: str) -> None:
    backend.start(tampered)
    pytest.fail(what)


SOURCES = ("~", "~/.aws", "~root/.ssh", "/etc", "..", "specs/../../outside", "s3://bucket/x", "", {"name": "bucket"}, None,
           "outside", "specs/outside")  # fmt: skip


@pytest.mark.parametrize("key", ["workdir", "file_mounts.~/.fogspec/link"])
@pytest.mark.parametrize("source", SOURCES, ids=repr)
def test_nothing_outside_the_project_is_sent(root: Path, key: str, source: object) -> None:
    """Not by its name, and not through a link of the checkout, for any runner."""
    (root.parent / "outside").mkdir()
    for place in (root / "outside", root / "specs" / "outside"):
        place.symlink_to(root.parent / "outside")
    machine = MACHINES["plain"]
    local = Machine(infra="local", instance="1cpu-1gib", cpus=1, memory="1GiB", price="$0/h")
    cloud = Cloud(root.parent / "cloud")
    for backend, ref in ((SkyPilotSamples(SimulatedClient(cloud)), machine), (LocalSamples(), local)):
        whole = job(root, ref, sample=True)
        task = {**edited(whole.task, key, "x"), **({"workdir": source} if key == "workdir" else {})}
        if key != "workdir":
            task["file_mounts"] = {"~/.fogspec/link": source}
        with pytest.raises(LaunchRefused, match="so nothing was started"):
            backend.start(job(root, ref, True, task))
    assert cloud.machines == {}


def test_a_folder_that_is_sent_has_no_link_that_leads_out(root: Path) -> None:
    cloud = Cloud(root.parent / "cloud")
    backend = SkyPilotDeployments(SimulatedClient(cloud))
    whole = job(root, MACHINES["plain"], sample=False)
    task = {**whole.task, "file_mounts": {**whole.task["file_mounts"], "~/.fogspec/link": "link"}}
    (root / "link" / "inside").symlink_to("link.sh")
    backend.start(job(root, MACHINES["plain"], False, task))
    (root / "link" / "key").symlink_to(os.path.expanduser("~"))
    with pytest.raises(LaunchRefused, match="link/key leads out of the project"):
        backend.start(job(root, MACHINES["plain"], False, task))


@pytest.mark.parametrize("edit", [lambda path: path.write_text("curl evil"), Path.unlink], ids=["edited", "missing"])
@pytest.mark.parametrize("place", ["cloud", "host"])
def test_a_file_that_is_not_the_reviewed_one_is_not_sent(root: Path, place: str, edit: Any) -> None:
    here = Machine(infra="local", instance="1cpu-1gib", cpus=1, memory="1GiB", price="$0/h")
    cloud = Cloud(root.parent / "cloud")
    ref, backend = (
        (here, LocalSamples()) if place == "host" else (MACHINES["plain"], SkyPilotSamples(SimulatedClient(cloud)))
    )
    whole = job(root, ref, sample=True)
    assert whole.work is not None
    reviewed = {"agent.pyz": digest.of_bytes(b"the agent")}
    check_sources(replace(whole, work=replace(whole.work, digests=reviewed)))
    edit(root / "agent.pyz")
    with pytest.raises(LaunchRefused, match=r"agent\.pyz is not what was reviewed, so nothing was started"):
        backend.start(replace(whole, work=replace(whole.work, digests=reviewed)))
    assert cloud.machines == {}
    assert not (root / "job").exists()


def test_a_deployment_may_cost_what_its_user_allows(root: Path) -> None:
    whole = job(root, MACHINES["plain"], sample=False)
    for cap, allowed in ((0.1, 0.2), (0.2, 0.2)):
        task = edited(whole.task, "resources.max_hourly_cost", cap)
        made = Job(name=whole.name, owner=OWNER, task=task, root=root, directory=root / "job", machine=whole.machine,
                   cap_usd_per_hour=allowed)  # fmt: skip
        SkyPilotDeployments(SimulatedClient(Cloud(root.parent / f"cloud{cap}"))).start(made)
    with pytest.raises(LaunchRefused, match="max_hourly_cost"):
        SkyPilotDeployments(SimulatedClient(Cloud(root.parent / "cloud"))).start(
            job(root, MACHINES["plain"], False, task)
        )


@pytest.mark.parametrize(("cap", "fits"), [(None, True), (0.01, False), (99.0, False), (0, False)])
def test_a_machine_without_a_price_has_no_cap(root: Path, cap: float | None, fits: bool) -> None:
    free = Machine(infra="slurm/lab/small", instance="s", cpus=2, memory="4GiB", price="$0/h")
    whole = job(root, free, sample=True)
    task = edited(whole.task, "resources.max_hourly_cost", cap)
    if fits:
        check_task(replace(whole, task=task))
    else:
        with pytest.raises(LaunchRefused, match="max_hourly_cost"):
            check_task(replace(whole, task=task))


def test_the_mounts_of_compiled_tasks_are_these(root: Path) -> None:
    mounts = {
        "~/.fogspec/agent.pyz": "agent.pyz",
        **{f"~/.fogspec/{name}.sh": "agent.pyz" for name in ("setup", "measure", "deploy")},
        "~/.fogspec/link": "link",
        "~/.fogspec/launch/cloud.launch.py": "agent.pyz",
    }
    whole = job(root, MACHINES["plain"], sample=False)
    check_sources(replace(whole, task={**whole.task, "file_mounts": mounts}))


@pytest.mark.parametrize(("lifetime_s", "most"), [(3600.0, 60), (7200.0, 120), (7201.0, 121)])
def test_the_end_of_a_sample_is_its_lifetime_in_whole_minutes(tmp_path: Path, lifetime_s: float, most: int) -> None:
    one = replace(job(tmp_path, MACHINES["plain"], sample=True), lifetime_s=lifetime_s)
    one.task["resources"]["autostop"]["idle_minutes"] = most + 1  # type: ignore[index]
    with pytest.raises(LaunchRefused, match=f"idle_minutes is {most + 1}, of the job at most {most}$"):
        check_task(one)
