"""What every runner must do, whichever it is: the conformance suite of the Runner seam."""

import gzip
import itertools
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

import fogspec.agent
from fogspec.backends import registry
from fogspec.backends.local import runner as runner_local
from fogspec.backends.local.runner import LocalRunner
from fogspec.backends.protocol import Job, LaunchRefused, ListsMachines, Progress, Runner
from fogspec.backends.replay import ReplayRunner
from fogspec.backends.skypilot.errors import CloudProblem
from fogspec.backends.skypilot.runner import SkyPilotRunner
from fogspec.base.templates import render
from fogspec.catalog.machine import Gpu, Machine
from fogspec.plan.schema import Sample
from fogspec.results.io import Recording
from fogspec.results.schema import LatencySummary, Measured
from tests.support.fake_sky import Cloud, SimulatedClient

LINE = json.dumps({"name": "work", "start_s": 1.0, "latency_s": 0.25, "ok": True, "metrics": {}, "reason": None})
RUN = (
    'exec python3 "$FOGSPEC_AGENT" --out "$FOGSPEC_OUT" --steps 3 --after 600 --warmup 1 --startup 120'
    """ --process '["python3", "work.py"]'\n"""
)
WORK = f"""import os, time
while True:
    open(os.environ["FOGSPEC_TIMINGS"], "a").write('{LINE}' + chr(10))
    time.sleep(0.02)
"""
PATIENCE_S = 120.0  # it only bounds hangs


@dataclass
class Bed:
    """A runner, the same runner as another process would make it anew, and machines it has and has not."""

    runner: Runner
    anew: Callable[[], Runner]
    job: Callable[[str], Job]
    too_big: Job


def machine(instance: str, infra: str = "local", cpus: float = 1, gpu: Gpu | None = None) -> Machine:
    return Machine.model_construct(
        infra=infra, instance=instance, cpus=cpus, memory=1.0, gpu=gpu, spot=False, price=0.0
    )


def job_on(folder: Path, name: str, ref: Machine, run: str = RUN) -> Job:
    sample = Sample(id="one", machine=ref, reason="")
    return Job(name, sample, {"run": run, "workdir": "."}, folder, folder / "attempts" / name, 900.0)


def local(folder: Path) -> Bed:
    (folder / "work.py").write_text(WORK)
    big = machine("9999cpu-1gib", cpus=9999)
    unique = f"{os.getpid()}-{time.monotonic_ns()}"
    return Bed(LocalRunner(), LocalRunner, lambda name: job_on(folder, f"{name}-{unique}", machine("1cpu-1gib")),
               job_on(folder, f"big-{unique}", big))  # fmt: skip


def lasting(job: Job) -> Job:
    """The same job without an end in the length of a test; a recording has an end of its own."""
    return replace(job, task={**job.task, "run": str(job.task["run"]).replace("--steps 3", "--steps 1000000")})


def replay(folder: Path, now_s: Callable[[], float] | None = None) -> Bed:
    """Without another clock it is a twentieth of a second later whenever it is asked."""
    ticks = itertools.count()
    now_s = now_s or (lambda: 0.05 * next(ticks))
    kept = folder / "kept.jsonl.gz"
    kept.write_bytes(gzip.compress(f"{LINE}\n".encode() * 4))
    latency = LatencySummary.model_construct(mean=0.25, sd=None, p50=None, p95=None, p99=None)
    record = Measured.model_construct(
        id="other", machine=machine("c6i.large", "aws/us-east-1"), measured_on="aws/c6i.large", state="ok",
        requests=3, failed_requests=0, latency=latency, duration=100.0, spent=0.25, metrics={},
    )  # fmt: skip

    def made() -> Runner:
        return ReplayRunner([Recording(record, kept)], "a test", now_s, pace=0.002)

    return Bed(made(), made, lambda name: job_on(folder, name, record.machine),
               job_on(folder, "big", machine("c9.huge", "aws/us-east-1")))  # fmt: skip


def skypilot(folder: Path) -> Bed:
    """The runner on a simulated SkyPilot; tests/slurm has it on the real one."""
    (folder / "work.py").write_text(WORK)
    (folder / "agent").symlink_to(next(iter(fogspec.agent.__path__)))
    cloud = Cloud(folder / "cloud")
    limits = ["--steps", "3", "--after", "600", "--warmup", "1", "--startup", "120"]
    run = render("run_sample.sh.j2", distro=None, workspace=None, secrets=[], limits=limits, lifetime_s=900,
                 processes=[["python3", "work.py"]])  # fmt: skip

    def job(name: str, instance: str = "2CPU--4GB") -> Job:
        made = job_on(folder, f"fogspec-{name}", machine(instance, "slurm/lab/small"), run)
        return replace(made, task={**made.task, "file_mounts": {"~/.fogspec/agent": "agent"}})

    too_big = job("big", "9999CPU--1GB")
    cloud.refused[too_big.name] = CloudProblem("capacity", "no partition has 9999 CPUs")

    def made() -> Runner:
        return SkyPilotRunner(client=SimulatedClient(cloud))  # type: ignore[arg-type]

    return Bed(made(), made, job, too_big)


@pytest.fixture(params=[local, replay, skypilot], ids=["local", "replay", "skypilot"])
def bed(request, tmp_path):
    return request.param(tmp_path)


def awaited(runner: Runner, job: Job) -> Progress:
    end = time.monotonic() + PATIENCE_S
    while (progress := runner.look(job)).running:
        assert time.monotonic() < end
        time.sleep(0.02)
    return progress


def test_it_says_what_it_is(bed):
    assert bed.runner.name in registry.RUNNERS
    assert bed.runner.at_once >= 1
    assert bed.runner.poll_s >= 0
    assert bed.runner.costs in ("real", "recorded", "nothing")
    assert bed.runner.source


def test_a_job_runs_to_its_end_and_what_it_measured_is_here(bed):
    job = bed.job("a")
    bed.runner.start(job)
    assert bed.runner.look(job).running
    progress = awaited(bed.runner, job)
    assert (progress.reason, progress.lost) == (None, False)
    assert progress.measured_on
    assert progress.timings is not None
    assert progress.timings.read_text().splitlines()[:4] == [LINE] * 4
    assert job.folder in progress.timings.parents
    bed.runner.end(job)


def test_looking_again_says_the_same_from_any_process(bed):
    job = bed.job("a")
    bed.runner.start(job)
    first = awaited(bed.runner, job)
    bed.runner.end(job)
    assert bed.runner.look(job) == first
    assert bed.anew().look(job) == first


def test_another_process_can_watch_and_end_it(bed):
    job = bed.job("a")
    bed.runner.start(job)
    other = bed.anew()
    assert other.look(job).running
    awaited(other, job)
    other.end(job)


def test_ending_waits_for_no_end_and_may_be_said_twice(bed, monkeypatch):
    # Neither the job nor the patience of who ends it is over before this test is.
    monkeypatch.setattr(runner_local, "GRACE_S", 600.0)
    job = lasting(bed.job("a"))
    bed.runner.start(job)
    bed.runner.end(job)
    bed.runner.end(job)


def test_what_was_never_started_is_lost_and_may_be_ended(bed):
    job = bed.job("never")
    progress = bed.runner.look(job)
    assert (progress.running, progress.lost) == (False, True)
    bed.runner.end(job)


def test_a_machine_that_cannot_be_had_is_said(bed):
    try:
        bed.runner.start(bed.too_big)
    except LaunchRefused as no:
        said = no.reason, no.again
        lost = True
    else:
        progress = awaited(bed.runner, bed.too_big)
        said, lost = (progress.reason, progress.again), False
    assert said == ("capacity", False)
    bed.runner.end(bed.too_big)
    assert bed.runner.look(bed.too_big).lost == lost


def test_two_attempts_do_not_touch_each_other(bed):
    first, second = bed.job("a"), bed.job("b")
    bed.runner.start(first)
    done = awaited(bed.runner, first)
    bed.runner.start(second)
    awaited(bed.runner, second)
    bed.runner.end(second)
    assert bed.runner.look(first) == done


def test_machines_are_found_by_their_names_until_they_are_gone(bed):
    job = lasting(bed.job("a"))
    bed.runner.start(job)
    while not bed.runner.look(job).measured_on:
        time.sleep(0.02)
    other, folder = bed.anew(), job.folder.parent
    if not isinstance(other, ListsMachines):
        assert other.costs == "recorded", "only recordings have no machines"
        return
    assert list(other.strays(job.name[:-1], folder)) == [job.name]
    assert list(other.strays("fogspec-nobody", folder)) == []
    other.end(job)
    assert list(bed.runner.strays(job.name, folder)) == []


def test_how_far_a_sample_is_elsewhere_is_known_while_it_runs(tmp_path):
    bed = skypilot(tmp_path)
    job = bed.job("far")
    job = replace(job, task={**job.task, "run": str(job.task["run"]).replace("--steps 3", "--steps 60")})
    bed.runner.start(job)
    said = set()
    while (progress := bed.runner.look(job)).running:
        said.add(progress.so_far)
        time.sleep(0.02)
    told = [one for one in said if one is not None]
    assert told
    assert all(0 < one.requests <= 61 and one.mean_s == 0.25 for one in told if one.mean_s is not None)
    assert progress.so_far is None, "the timings are here"
    bed.runner.end(job)


def test_local_has_no_accelerators(tmp_path):
    with pytest.raises(LaunchRefused, match="no accelerators: T4"):
        LocalRunner().start(job_on(tmp_path, "gpu", machine("x", gpu=Gpu(name="T4", count=1))))


def test_local_does_not_start_without_the_secrets_of_its_task(tmp_path, monkeypatch):
    monkeypatch.delenv("MAP_PASSWORD", raising=False)
    job = job_on(tmp_path, "secret", machine("1cpu-1gib"))
    job = Job(job.name, job.sample, {**job.task, "secrets": {"MAP_PASSWORD": None}}, job.root, job.folder, 900.0)
    with pytest.raises(LaunchRefused, match="MAP_PASSWORD"):
        LocalRunner().start(job)


def test_replay_does_not_mix_up_two_places(tmp_path):
    bed = replay(tmp_path)
    with pytest.raises(LaunchRefused, match=r"no recording of aws/eu-central-1/c6i\.large"):
        bed.runner.start(job_on(tmp_path, "elsewhere", machine("c6i.large", "aws/eu-central-1")))


def test_replay_waits_in_proportion_to_the_recording(tmp_path):
    now_s = 7.0
    bed, job = replay(tmp_path, lambda: now_s), job_on(tmp_path, "a", machine("c6i.large", "aws/us-east-1"))
    bed.runner.start(job)
    assert bed.runner.look(job).running
    now_s = 7.199
    assert bed.runner.look(job).running
    now_s = 7.201
    progress = bed.runner.look(job)
    assert not progress.running
    assert (progress.billed_s, progress.recorded.spent) == (100.0, 0.25)
