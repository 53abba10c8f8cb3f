"""The conformance suite of the Backend protocol: every backend, with samples and with deployments."""

import contextlib
import gzip
import itertools
import json
import os
import secrets
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from fogspec.backends import registry
from fogspec.backends.local import backend as local_backend
from fogspec.backends.local import processes
from fogspec.backends.local.backend import MARK, LocalDeployments, LocalSamples, mark_of
from fogspec.backends.naming import Owner
from fogspec.backends.protocol import Costs, DeploymentStatus, Job, LaunchRefused, SampleStatus, Unreachable
from fogspec.backends.skypilot.backend import SkyPilotDeployments, SkyPilotSamples
from fogspec.backends.skypilot.errors import CloudProblem
from fogspec.base.templates import render
from fogspec.catalog.machine import Gpu, Machine
from fogspec.results.schema import LatencySummary, Measured
from fogspec_lab.recordings import Recording
from fogspec_lab.replay import ReplaySamples
from tests.support.agent import AGENT
from tests.support.fake_sky import Cloud, SimulatedClient
from tests.support.jobs import changed, config, job_of, resources

RECORD = {"name": "work", "start_s": 1.0, "latency_s": 0.25, "ok": True, "metrics": {}, "reason": None}
LINE = json.dumps(RECORD)
WORK = f"""import os, time
while not os.path.exists("crash"):
    with open(os.environ["FOGSPEC_TIMINGS"], "a") as file:
        file.write('{LINE}' + chr(10))
    time.sleep(0.02)
raise SystemExit("no such model")
"""
MEASURE = (
    'exec python3 "$FOGSPEC_AGENT" sample --out "$FOGSPEC_OUT" --steps 3 --after 600 --warmup 1 --startup 120'
    """ --process '["python3", "work.py"]'\n"""
)
SERVE = (
    "agent=${FOGSPEC_AGENT:-$HOME/.fogspec/agent.pyz}\nout=${FOGSPEC_OUT:-$HOME/.fogspec/deployment}\n"
    'exec python3 "$agent" supervisor --out "$out" %s'
    """ --process '["python3", "work.py"]'\n"""
)
MOUNTS = {"~/.fogspec/agent.pyz": "agent.pyz"}
PATIENCE_S = 1200.0  # it only bounds hangs
OWNER = Owner("forge.test/lab/robots", "default", "demo")
Status = SampleStatus | DeploymentStatus


@dataclass
class Bed:
    """A backend, the same one as another process would make it, and jobs for it.

    `job` makes another job each time; `unavailable` needs a machine that the backend does not have.
    """

    backend: Any
    another: Callable[[], Any]
    job: Callable[[], Job]
    unavailable: Job
    folder: Path
    cloud: Cloud | None = None

    def until(self, job: Job, done: Callable[[Any], bool], backend: Any = None) -> Any:
        end = time.monotonic() + PATIENCE_S
        while not done(status := (backend or self.backend).poll(job)):
            assert time.monotonic() < end, status
            time.sleep(0.02)
        return status

    def list(self, backend: Any = None) -> list[str]:
        return list((backend or self.backend).list(OWNER, self.folder / ".fogspec" / "demo"))

    def workdir(self, job: Job) -> Path:
        """Where the job's processes run."""
        return self.folder / "specs" if self.cloud is None else self.cloud.machines[job.name].folder / "sky_workdir"


OTHERS = (
    {"application": "demo-two"},
    {"application": "dem"},
    {"environment": "prod"},
    {"repository": "forge.test/fork/robots"},
)


def up(status: Status) -> bool:
    """Whether the job runs, or a deployment's nodes answer."""
    return status.running if isinstance(status, SampleStatus) else status.state == "ready"


def over(status: Status) -> bool:
    return not status.running if isinstance(status, SampleStatus) else status.state in ("gone", "ended")


def machine(instance: str, infra: str = "local", cpus: float = 1, gpu: Gpu | None = None) -> Machine:
    return Machine.model_construct(
        infra=infra, instance=instance, cpus=cpus, memory=1.0, gpu=gpu, spot=False, price=0.1
    )


def project(folder: Path) -> Path:
    (folder / "specs").mkdir()
    (folder / "specs" / "work.py").write_text(WORK)
    shutil.copy(AGENT, folder / "agent.pyz")
    return folder


def sample(folder: Path, ref: Machine, run: str = MEASURE, **task: Any) -> Job:
    name = f"{OWNER.prefix}one-{secrets.token_hex(4)}-1"
    return job_of(
        folder,
        {
            "run": run,
            "workdir": "specs",
            "file_mounts": MOUNTS,
            "resources": resources(ref, 900.0),
            **config(ref, 900.0),
            **task,
        },
        name=name,
        owner=OWNER,
        machine=ref,
        directory=folder / ".fogspec" / "demo" / "attempts" / name,
        lifetime_s=900.0,
    )


def deployment(folder: Path, ref: Machine, ready: str = "", **task: Any) -> Job:
    name = OWNER.deployment_name(f"sha256:{secrets.token_hex(4)}", secrets.token_hex(3))
    return job_of(
        folder,
        {"run": SERVE % ready, "workdir": "specs", "file_mounts": MOUNTS, "resources": resources(ref), **task},
        name=name,
        owner=OWNER,
        machine=ref,
        directory=folder / ".fogspec" / "demo" / "deployed" / name,
    )


def lasting(job: Job) -> Job:
    """The same sample without an end in the length of a test; a recording has an end of its own."""
    return changed(job, run=str(job.task["run"]).replace("--steps 3", "--steps 1000000"))


def local_samples(folder: Path) -> Bed:
    project(folder)
    big = sample(folder, machine("9999cpu-1gib", cpus=9999))
    return Bed(LocalSamples(), LocalSamples, lambda: sample(folder, machine("1cpu-1gib")), big, folder)


def replay_samples(folder: Path, now_s: Callable[[], float] | None = None) -> Bed:
    """Without another clock, a twentieth of a second passes at each look at it."""
    ticks = itertools.count()
    now_s = now_s or (lambda: 0.05 * next(ticks))
    kept = folder / "kept.jsonl.gz"
    kept.write_bytes(gzip.compress(f"{LINE}\n".encode() * 4))
    latency = LatencySummary.model_construct(mean=0.25, sd=None, p50=None, p95=None, p99=None)
    record = Measured.model_construct(
        id="other", machine=machine("c6i.large", "aws/us-east-1"), measured_on="aws/c6i.large", state="ok",
        requests=3, failed_requests=0, latency=latency, duration=100.0, spent=0.25, metrics={},
    )  # fmt: skip

    def make() -> ReplaySamples:
        return ReplaySamples([Recording(record, kept)], "a test", now_s, pace=0.002)

    huge = sample(folder, machine("c9.huge", "aws/us-east-1"))
    return Bed(make(), make, lambda: sample(folder, record.machine), huge, folder)


def skypilot_samples(folder: Path) -> Bed:
    """On a simulated SkyPilot; tests/slurm has the real one."""
    cloud = Cloud(project(folder) / "cloud")
    limits = ["--steps", "3", "--after", "600", "--warmup", "1", "--startup", "120"]
    run = render("measure.sh.j2", distro=None, workspace=None, secrets=[], limits=limits, lifetime_s=900,
                 processes=[["python3", "work.py"]], origin="x", source="x")  # fmt: skip

    def job(instance: str = "2CPU--4GB") -> Job:
        return sample(folder, machine(instance, "slurm/lab/small"), run)

    big = job("9999CPU--1GB")
    cloud.refused[big.name] = CloudProblem("capacity", "no partition has 9999 CPUs", refused=True)

    def make() -> SkyPilotSamples:
        return SkyPilotSamples(SimulatedClient(cloud))  # type: ignore[arg-type]

    return Bed(make(), make, job, big, folder, cloud)


def local_deployments(folder: Path) -> Bed:
    project(folder)
    big = deployment(folder, machine("9999cpu-1gib", cpus=9999))
    return Bed(LocalDeployments(), LocalDeployments, lambda: deployment(folder, machine("1cpu-1gib")), big, folder)


def skypilot_deployments(folder: Path) -> Bed:
    cloud = Cloud(project(folder) / "cloud")
    big = deployment(folder, machine("9999cpu", "aws/r1", cpus=9999))
    cloud.refused[big.name] = CloudProblem("capacity", "InsufficientInstanceCapacity")

    def make() -> SkyPilotDeployments:
        return SkyPilotDeployments(SimulatedClient(cloud))  # type: ignore[arg-type]

    return Bed(make(), make, lambda: deployment(folder, machine("1cpu", "aws/r1")), big, folder, cloud)


SAMPLES = (local_samples, replay_samples, skypilot_samples)
DEPLOYMENTS = (local_deployments, skypilot_deployments)


def made(request: pytest.FixtureRequest, folder: Path) -> Iterator[Bed]:
    bed: Bed = request.param(folder)
    yield bed
    for name in bed.list():
        bed.backend.stop(Job(name=name, owner=OWNER, root=folder, directory=folder))


@pytest.fixture(params=(*SAMPLES, *DEPLOYMENTS), ids=lambda one: one.__name__)
def bed(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bed]:
    """Any backend."""
    yield from made(request, tmp_path)


@pytest.fixture(
    params=[one for one in (*SAMPLES, *DEPLOYMENTS) if one is not replay_samples], ids=lambda one: one.__name__
)
def machines(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bed]:
    """A backend that has machines."""
    yield from made(request, tmp_path)


@pytest.fixture(params=SAMPLES, ids=lambda one: one.__name__)
def samples(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bed]:
    yield from made(request, tmp_path)


@pytest.fixture(params=DEPLOYMENTS, ids=lambda one: one.__name__)
def deployments(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bed]:
    yield from made(request, tmp_path)


# Any job on any backend


def test_a_backend_has_its_name_in_the_registry(bed: Bed) -> None:
    assert bed.backend.poll_s >= 0
    if isinstance(bed.backend, ReplaySamples):  # the lab brings its own
        assert bed.backend.name not in registry.SAMPLES
        return
    known = {registry.sample_backend(name) for name in registry.SAMPLES}
    known |= {type(registry.deployment_backend("local"))} if bed.cloud is None else {SkyPilotDeployments}
    assert type(bed.backend) in known
    assert bed.backend.name in registry.SAMPLES


def test_a_job_that_was_never_started_is_over_and_may_be_stopped(bed: Bed) -> None:
    job = bed.job()
    status = bed.backend.poll(job)
    assert status.lost if isinstance(status, SampleStatus) else status.state == "gone"
    assert over(status)
    bed.backend.stop(job)


def test_a_job_runs_until_it_is_stopped_and_may_be_stopped_twice(bed: Bed, monkeypatch: pytest.MonkeyPatch) -> None:
    # Neither the job nor the grace of its stop is over before this test is.
    monkeypatch.setattr(local_backend, "GRACE_S", 600.0)
    job = lasting(bed.job())
    bed.backend.start(job)
    bed.until(job, up)
    bed.backend.stop(job)
    bed.backend.stop(job)
    assert bed.list() == []


def test_a_job_gets_the_snapshot_and_nothing_else_of_the_folder(machines: Bed) -> None:
    snapshot = machines.folder / "snapshot"
    snapshot.mkdir()
    (snapshot / "work.py").write_text(WORK)
    (snapshot / "only-in-the-snapshot").write_text("")
    (machines.folder / "specs" / "changed-since").write_text("")
    job = replace(lasting(machines.job()), tree=snapshot)
    machines.backend.start(job)
    machines.until(job, up)
    here = {local_backend.LocalSamples: job.directory / "work", local_backend.LocalDeployments: snapshot}
    at = here[type(machines.backend)] if machines.cloud is None else machines.workdir(job)
    sent = {path.name for path in at.iterdir()}
    assert {"work.py", "only-in-the-snapshot"} <= sent
    assert "changed-since" not in sent
    machines.backend.stop(job)
    assert not (job.directory / "work").exists()
    assert (snapshot / "only-in-the-snapshot").exists(), "it belongs to whoever made it"


def test_another_process_polls_and_stops_it(bed: Bed) -> None:
    job = lasting(bed.job())
    bed.backend.start(job)
    other = bed.another()
    bare = job if job.lifetime_s is not None else replace(job, machine=None, work=None, task={})
    bed.until(bare, up, other)
    other.stop(bare)
    assert bed.list() == []


def test_an_unavailable_machine_is_refused(bed: Bed) -> None:
    try:
        bed.backend.start(bed.unavailable)
        status = bed.until(bed.unavailable, over)
        refusal = status.reason, status.again
    except LaunchRefused as no:
        refusal = no.reason, no.again
    assert refusal == ("capacity", False)
    bed.backend.stop(bed.unavailable)


def test_a_job_whose_secret_is_missing_is_refused(machines: Bed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MAP_PASSWORD", raising=False)
    job = machines.job()
    job = changed(job, secrets={"MAP_PASSWORD": None})
    with pytest.raises(LaunchRefused, match="MAP_PASSWORD"):
        machines.backend.start(job)
    machines.backend.stop(job)
    assert machines.list() == []


def test_jobs_are_listed_from_any_process_until_they_are_stopped(machines: Bed) -> None:
    first, second = lasting(machines.job()), lasting(machines.job())
    for job in (first, second):
        machines.backend.start(job)
        machines.until(job, up)
    assert machines.list(machines.another()) == sorted([first.name, second.name])
    machines.backend.stop(first)
    assert machines.list() == [second.name]
    assert up(machines.backend.poll(second))
    machines.backend.stop(second)
    assert machines.list(machines.another()) == []


def test_jobs_of_other_applications_are_not_listed(machines: Bed) -> None:
    job = lasting(machines.job())
    machines.backend.start(job)
    machines.until(job, up)
    others = [replace(OWNER, **one) for one in OTHERS]
    for directory in (machines.folder / ".fogspec" / "demo", machines.folder / ".fogspec" / "other"):
        assert [list(machines.backend.list(other, directory)) for other in others] == [[]] * len(OTHERS)
    machines.backend.stop(job)


def test_recordings_have_no_machines(tmp_path: Path) -> None:
    bed = replay_samples(tmp_path)
    bed.backend.start(bed.job())
    assert bed.backend.costs is Costs.RECORDED
    assert bed.list() == []


# Samples


def test_a_backend_for_samples_tells_their_cost_and_worth(samples: Bed) -> None:
    assert samples.backend.at_once >= 1
    assert isinstance(samples.backend.costs, Costs)
    assert samples.backend.source


def test_a_sample_runs_to_its_end_and_its_timings_are_here(samples: Bed) -> None:
    job = samples.job()
    samples.backend.start(job)
    assert samples.backend.poll(job).running
    status = samples.until(job, over)
    assert (status.reason, status.lost) == (None, False)
    assert status.measured_on
    assert status.timings.read_text().splitlines()[:4] == [LINE] * 4
    assert job.directory in status.timings.parents
    samples.backend.stop(job)


def test_a_final_status_stays_the_same_for_any_process(samples: Bed) -> None:
    job = samples.job()
    samples.backend.start(job)
    final = samples.until(job, over)
    samples.backend.stop(job)
    assert samples.backend.poll(job) == final
    assert samples.another().poll(job) == final


def test_another_process_sees_a_sample_to_its_end(samples: Bed) -> None:
    job = samples.job()
    samples.backend.start(job)
    other = samples.another()
    assert other.poll(job).running
    assert samples.until(job, over, other).reason is None
    other.stop(job)


def test_two_attempts_do_not_touch_each_other(samples: Bed) -> None:
    first, second = samples.job(), samples.job()
    samples.backend.start(first)
    final = samples.until(first, over)
    samples.backend.start(second)
    samples.until(second, over)
    samples.backend.stop(second)
    assert samples.backend.poll(first) == final


def test_a_refused_sample_costs_nothing_and_stays_refused(samples: Bed) -> None:
    try:
        samples.backend.start(samples.unavailable)
    except LaunchRefused:
        lost = True
    else:
        lost = samples.until(samples.unavailable, over).lost
        assert samples.backend.poll(samples.unavailable).billed_s == 0.0
    samples.backend.stop(samples.unavailable)
    assert samples.backend.poll(samples.unavailable).lost == lost


def test_the_progress_of_a_sample_elsewhere_is_known_while_it_runs(tmp_path: Path) -> None:
    bed = skypilot_samples(tmp_path)
    job = bed.job()
    job = changed(job, run=str(job.task["run"]).replace("--steps 3", "--steps 60"))
    bed.backend.start(job)
    seen = set()
    while (status := bed.backend.poll(job)).running:
        seen.add(status.so_far)
        time.sleep(0.02)
    partial = [one for one in seen if one is not None]
    assert partial
    assert all(0 < one.requests <= 61 and one.mean_s == 0.25 for one in partial if one.mean_s is not None)
    assert status.so_far is None, "the timings are here"
    bed.backend.stop(job)


def test_this_host_has_no_accelerators(tmp_path: Path) -> None:
    gpu = machine("x", gpu=Gpu(name="T4", count=1))
    with pytest.raises(LaunchRefused, match="no accelerators: T4"):
        LocalSamples().start(sample(tmp_path, gpu))
    with pytest.raises(LaunchRefused, match="no accelerators known to fogspec: T4"):
        LocalDeployments().start(deployment(tmp_path, gpu))


def test_replay_does_not_mix_up_two_places(tmp_path: Path) -> None:
    bed = replay_samples(tmp_path)
    with pytest.raises(LaunchRefused, match=r"no recording of aws/eu-central-1/c6i\.large"):
        bed.backend.start(sample(tmp_path, machine("c6i.large", "aws/eu-central-1")))


def test_replay_waits_in_proportion_to_the_recording(tmp_path: Path) -> None:
    now_s = 7.0
    bed = replay_samples(tmp_path, lambda: now_s)
    job = bed.job()
    bed.backend.start(job)
    assert bed.backend.poll(job).running
    now_s = 7.199
    assert bed.backend.poll(job).running
    now_s = 7.201
    status = bed.backend.poll(job)
    assert not status.running
    assert (status.billed_s, status.recorded.spent) == (100.0, 0.25)


# Deployments


def test_a_deployment_has_an_address_and_is_observed(deployments: Bed) -> None:
    job = deployments.job()
    deployments.backend.start(job)
    status = deployments.until(job, up)
    assert status.address
    assert status.observed
    deployments.backend.stop(job)
    assert over(deployments.backend.poll(job))


def test_a_deployment_is_not_ready_before_the_nodes_answer(deployments: Bed) -> None:
    job = deployments.job()
    asks = SERVE % """--ready '["test", "-e", "answers"]'"""
    job = changed(job, run=asks)
    deployments.backend.start(job)
    deployments.until(job, lambda status: status.state == "starting")
    time.sleep(1.0)
    assert deployments.backend.poll(job).state == "starting"
    deployments.until(job, lambda _: deployments.workdir(job).is_dir())
    (deployments.workdir(job) / "answers").touch()
    deployments.until(job, up)
    deployments.backend.stop(job)


def test_the_end_of_nodes_is_reported_with_their_last_line(deployments: Bed) -> None:
    job = deployments.job()
    deployments.backend.start(job)
    deployments.until(job, up)
    (deployments.workdir(job) / "crash").touch()
    status = deployments.until(job, lambda status: status.state == "ended")
    assert status.detail == "python3 ended with exit code 1: no such model"
    deployments.backend.stop(job)
    assert deployments.list() == []


def test_requests_to_a_deployment_are_seen(deployments: Bed) -> None:
    job = deployments.job()
    deployments.backend.start(job)
    timings = deployments.until(job, lambda status: bool(status.timings)).timings
    first = json.loads(timings.splitlines()[0])
    assert (first["name"], first["latency_s"], first["ok"]) == ("work", 0.25, True)
    deployments.backend.stop(job)


@pytest.mark.parametrize("status", ["INIT", "STOPPED"])
def test_a_machine_that_was_rebooted_or_turned_off_is_still_paid(tmp_path: Path, status: str) -> None:
    bed = skypilot_deployments(tmp_path)
    job = bed.job()
    bed.backend.start(job)
    bed.until(job, up)
    assert bed.cloud is not None
    bed.cloud.not_up[job.name] = status
    if status == "INIT":
        with pytest.raises(Unreachable, match="still paid, and SkyPilot on it does not answer, as after a reboot"):
            bed.backend.poll(job)
    else:
        found = bed.backend.poll(job)
        assert (found.state, found.detail) == ("ended", "its machine was turned off, and its disk is still paid")
    bed.backend.stop(job)
    assert bed.list() == []


def test_silence_is_not_an_end(tmp_path: Path) -> None:
    cloud = Cloud(tmp_path / "cloud", fails=lambda _op, _words: Unreachable("the network is down"))
    backend = SkyPilotDeployments(SimulatedClient(cloud))  # type: ignore[arg-type]
    job = Job(name=OWNER.deployment_name("sha256:0", "0"), owner=OWNER, root=tmp_path, directory=tmp_path)
    with pytest.raises(Unreachable):
        backend.poll(job)
    with pytest.raises(Unreachable):
        backend.stop(job)
    with pytest.raises(Unreachable):
        backend.list(OWNER, tmp_path)


def test_a_killed_supervisor_leaves_no_process(tmp_path: Path) -> None:
    bed = local_deployments(tmp_path)
    job = bed.job()
    bed.backend.start(job)
    bed.until(job, up)
    for pid in processes.marked(MARK, mark_of(job)):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # what supervises others starts short commands
            if b"agent.pyz\0supervisor" in Path("/proc", str(pid), "cmdline").read_bytes():
                os.kill(pid, signal.SIGKILL)
    until_s = time.monotonic() + 1200
    while processes.marked(MARK, mark_of(job)):
        assert time.monotonic() < until_s, "the launcher ends the nodes with their supervisor"
        time.sleep(0.05)
    bed.backend.stop(job)
    assert processes.marked(MARK, mark_of(job)) == []
