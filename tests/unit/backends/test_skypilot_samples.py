"""The SkyPilot runner when things go wrong between it and SkyPilot, on a simulated one."""

import json
import shlex
import time
from concurrent.futures import Future

import pytest

from fogspec.backends.protocol import Job, LaunchRefused, SampleStatus, Unreachable
from fogspec.backends.skypilot import backend as module
from fogspec.backends.skypilot.backend import SkyPilotSamples
from fogspec.backends.skypilot.errors import CloudProblem
from tests.conformance.test_backends import Bed, lasting, skypilot_samples
from tests.support.fake_sky import Cloud, SimulatedClient


@pytest.fixture(autouse=True)
def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LAUNCH_POLL_S", 0.05)
    monkeypatch.setattr(module, "JOB_POLL_S", 0.05)


@pytest.fixture
def bed(tmp_path) -> Bed:
    return skypilot_samples(tmp_path)


def cloud_of(bed: Bed) -> Cloud:
    client = bed.backend._client
    assert isinstance(client, SimulatedClient)
    return client.cloud


def patient(backend: SkyPilotSamples, job: Job, patience_s: float = 1200.0) -> tuple[SampleStatus, int]:
    """How it ended, and how often nothing was heard of it."""
    end, silent = time.monotonic() + patience_s, 0
    while True:
        try:
            if not (progress := backend.poll(job)).running:
                return progress, silent
        except Unreachable:
            silent += 1
        assert time.monotonic() < end
        time.sleep(0.02)


def once(op: str, problem: Exception, times: int = 1):
    """The first `times` questions of this kind get this answer."""
    left = [times]

    def fails(asked: str, _words) -> Exception | None:
        if asked != op or not left[0]:
            return None
        left[0] -= 1
        return problem

    return fails


@pytest.mark.slow
@pytest.mark.parametrize("op", ["launched", "log", "jobs"])
def test_silence_in_the_middle_is_survived(bed, op):
    cloud, job = cloud_of(bed), bed.job()
    cloud.fails = once(op, Unreachable("the network is down"), 3)
    bed.backend.start(job)
    progress, silent = patient(bed.backend, job)
    assert (progress.reason, progress.lost) == (None, False)
    if op == "launched":
        assert silent == 3


@pytest.mark.slow
def test_a_launch_whose_answer_is_lost_is_found_by_its_name(bed):
    cloud, job = cloud_of(bed), bed.job()
    bed.backend.start(job)
    lost = bed.backend._watched[job.name].call = Future()
    lost.set_exception(Unreachable("cut off"))
    progress, silent = patient(bed.backend, job)
    assert (progress.reason, progress.lost, silent) == (None, False, 1)
    assert len(cloud.machines) == 1


def test_a_launch_that_never_arrived_is_lost_and_measured_again(bed):
    job = bed.job()
    cloud_of(bed).fails = once("launch", Unreachable("no server"))
    bed.backend.start(job)
    progress, _ = patient(bed.backend, job)
    assert (progress.lost, progress.reason) == (True, None)


@pytest.mark.slow
def test_a_controller_killed_while_it_asked_for_the_launch_goes_on_by_name(bed):
    job = bed.job()
    bed.backend.start(job)
    assert "request" not in json.loads((job.directory / "launch.json").read_text())
    progress, _ = patient(bed.another(), job)
    assert (progress.reason, progress.lost) == (None, False)
    assert progress.measured_s is not None


def test_a_machine_that_goes_away_takes_its_results_with_it(bed):
    cloud, job = cloud_of(bed), lasting(bed.job())
    bed.backend.start(job)
    while bed.backend.poll(job).detail != "its machine is up":
        time.sleep(0.02)
    cloud.end(job.name)
    progress, _ = patient(bed.backend, job)
    assert (progress.lost, progress.running) == (True, False)
    assert bed.another().poll(job).lost, "and that is written down"


@pytest.mark.parametrize(
    ("problem", "again", "billed_s"),
    [
        (CloudProblem("quota", "VcpuLimitExceeded", refused=True), False, 0.0),
        (CloudProblem("capacity", "none left", again=True, refused=True), True, 0.0),
        (CloudProblem("capacity", "Failed to acquire resources in all zones", again=True), True, None),
        (CloudProblem("access", "Permission denied"), False, None),
        (CloudProblem("image", "manifest unknown"), False, None),
    ],
)
def test_refusals_keep_their_reason_and_cost_nothing_where_there_was_no_machine_for_certain(
    bed, problem, again, billed_s
):
    job = bed.job()
    cloud_of(bed).refused[job.name] = problem
    bed.backend.start(job)
    progress, _ = patient(bed.backend, job)
    assert (progress.reason, progress.again, progress.billed_s) == (problem.reason, again, billed_s)
    assert progress.detail == problem.detail


@pytest.mark.slow
def test_a_log_cut_on_its_way_is_read_again(bed, monkeypatch):
    cloud, job = cloud_of(bed), bed.job()
    whole, times = cloud.log, []

    def cut(**words) -> int:
        times.append(words)
        return whole(**{**words, "limit": 200 if len(times) < 3 else words["limit"]})

    monkeypatch.setattr(cloud, "log", cut)
    bed.backend.start(job)
    progress, _ = patient(bed.backend, job)
    assert (progress.reason, progress.lost) == (None, False)
    assert progress.timings is not None


@pytest.mark.parametrize(
    ("before", "last", "reason", "said"),
    [
        ("", "E: no such package", "setup", ""),
        ("=== fogspec measures ===", "E: no such package", "crash", ""),
        ("", "c++: fatal error: Killed signal terminated program cc1plus", "setup", "its set-up ran out of memory: "),
        ("", "Task was killed due to the node running low on memory", "setup", "its set-up ran out of memory: "),
        ("=== fogspec measures ===", "Task was killed due to the node running low on memory", "out_of_memory", ""),
    ],
)
def test_a_job_without_an_outcome_says_its_last_words(bed, before, last, reason, said):
    """What fails before the nodes start, such as a build, says nothing about a machine that serves."""
    job = bed.job()
    job.task["run"] = f"echo installing; echo {before!r}; echo {last!r} >&2; exit 100"
    bed.backend.start(job)
    progress, _ = patient(bed.backend, job)
    assert (progress.reason, progress.detail) == (reason, f"{said}the job ended as FAILED: {last}")


def test_what_runs_out_of_memory_says_what_was_used_before(bed):
    use = {"window": 2.0, "vcpus": 1.0, "cpu_mean": 1.0, "cpu_max": 1.0, "overhead": 0.0, "minor_faults": 0,
           "major_faults": 0, "memory_peak": 0.25, "memory_before": 0.75}  # fmt: skip
    outcome = {"state": "failed", "reason": "out_of_memory", "detail": "node ended by signal 9", "resources": use}
    lines = ["measures", "begin outcome.json", "", "end outcome.json", "begin timings.jsonl", "end timings.jsonl"]
    said = [f"=== fogspec {one} ===" if one else json.dumps(outcome) for one in lines]
    job = bed.job()
    job.task["run"] = f"printf '%s\\n' {shlex.join(said)}"
    bed.backend.start(job)
    progress, _ = patient(bed.backend, job)
    assert progress.reason == "out_of_memory"
    used = "of which 768 MiB were used before the nodes started, were not enough: node ended by signal 9"
    assert progress.detail == f"{job.machine.memory:g} GiB, {used}"


@pytest.mark.slow
def test_set_up_is_over_when_the_log_says_so(bed):
    job = bed.job()
    job.task["run"] = "sleep 0.5; " + job.task["run"]
    bed.backend.start(job)
    said = []
    while (progress := bed.backend.poll(job)).running:
        said.append(progress.ready)
        time.sleep(0.01)
    assert said[0] is False
    assert said[-1] is True


def test_an_end_that_takes_long_is_asked_about_again_and_a_failed_one_is_tried_again(bed):
    cloud, job = cloud_of(bed), bed.job()
    bed.backend.start(job)
    cloud.fails = once("end", CloudProblem("setup", "still there", again=True), 2)
    for _ in range(2):
        with pytest.raises(Unreachable, match="still there"):
            bed.backend.stop(job)
    bed.backend.stop(job)
    assert cloud.machines == {}


def test_it_does_not_start_without_the_secrets_of_its_task(bed, monkeypatch):
    monkeypatch.delenv("MAP_PASSWORD", raising=False)
    job = bed.job()
    job.task["secrets"] = {"MAP_PASSWORD": None}
    with pytest.raises(LaunchRefused, match="MAP_PASSWORD"):
        bed.backend.start(job)
    assert cloud_of(bed).machines == {}
