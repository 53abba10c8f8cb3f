"""Jobs on machines of any infra that SkyPilot knows: one cluster of one machine for each job, named like it.

Samples never wait for SkyPilot: a poll sends one call, and a later one takes its result. State that another process needs to
resume is in the job's directory: `launch.json` from before a machine can exist, `ended.json` once the job is over.
Deployments wait for each call; their state is read from the end of the job's log, which works on every infra and opens no port.
"""

import contextlib
import tempfile
import time
from collections.abc import Collection, Mapping, Sequence
from concurrent import futures
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from fogspec.backends import agent_state
from fogspec.backends.naming import Owner
from fogspec.backends.protocol import (
    Costs,
    DeploymentStatus,
    Job,
    LaunchRefused,
    NoAnswer,
    SampleStatus,
    Unreachable,
    no_access,
)
from fogspec.backends.skypilot import job_outcome, logs, secrets_file
from fogspec.backends.skypilot.client import Client, result
from fogspec.backends.skypilot.errors import FORGOTTEN, CloudProblem
from fogspec.backends.skypilot.job_outcome import LOG, load, save
from fogspec.backends.skypilot.logs import LogTail
from fogspec.backends.task_check import check_sources, check_task
from fogspec.base.clouds import cloud_of, split_infra
from fogspec.base.errors import CloudError
from fogspec.base.text import shell_command, visible

# A machine that starts takes a process of SkyPilot's API server, 0.4 GiB by its own count (LONG_WORKER_MEM_GB): eight fit
# beside other work on a laptop. A mistake in the set-up then costs eight machines, not the whole plan.
AT_ONCE = 8
LAUNCH_POLL_S = 2.0
JOB_POLL_S = 10.0
HANGS_S = 300.0
NAMED = 6  # places in a message
READS = 3  # of a log that lacks its end: it may have been cut on its way
ACCESS_S = 300.0  # it may have to start an API server and to ask each cloud
CALL_S = 240.0  # the first call may have to start an API server
STOP_S = 900.0
WAIT_S = 1.0  # for a call that is usually quick
TAIL_LINES, MANY_LINES = 2000, 200_000
TAIL_BYTES = 256 * 2**20
OVER = ("SUCCEEDED", "FAILED", "FAILED_SETUP", "FAILED_DRIVER", "CANCELLED")


class Stage(StrEnum):
    """The stages of a sample's job, named after the operation of `fogspec.backends.skypilot.api` that each calls."""

    LAUNCH = "launch"
    FIND = "find"
    LAUNCHED = "launched"
    JOBS = "jobs"
    FOLLOW = "follow"  # the log, while the job runs
    LOG = "log"  # the whole log


class SkyPilotBackend:
    """What samples and deployments have in common: the worker, the launch's secrets, and the list of machines."""

    name = "skypilot"

    def __init__(self, client: Client | None = None) -> None:
        self._client = client or Client()

    def list(self, owner: Owner, directory: Path) -> Sequence[str]:
        """Return the machines with the owner's name and label, those that are still being launched included."""
        try:
            known = [one["name"] for one in self._call("clusters") if owner.has(one["name"], one.get("labels"))]
            return sorted({*known, *filter(owner.has, self._call("waiting"))})
        except (CloudProblem, CloudError) as problem:
            raise Unreachable(str(problem)) from None

    def close(self) -> None:
        """End the worker."""
        self._client.close()

    def check_access(self, places: Collection[str], briefly: bool = False) -> None:
        """Raise CloudError if SkyPilot does not answer, or has no access to the cloud, context or cluster of a place.

        If `briefly`, an API server that this starts is ended.
        """
        clouds, ran = sorted({cloud_of(place).name for place in places}), True
        try:
            ran = not briefly or self._client.call("serves", CALL_S)
            denied = self._client.call("denied", ACCESS_S, clouds=clouds)
            named = sorted({name for place in places if (name := _pool(place)) is not None})
            known = self._client.call("infras", ACCESS_S) if named and not denied else []
        except (CloudProblem, Unreachable) as problem:
            raise NoAnswer(f"SkyPilot does not answer: {problem}", "see what it says itself: sky api status") from None
        finally:
            if not ran:
                with contextlib.suppress(CloudProblem, CloudError, Unreachable):
                    self._client.call("end_server", CALL_S)
        if denied:
            raise no_access(f"it has no access to {', '.join(denied)}", denied)
        for name in named:
            _check_known(name, known)

    def _call(self, op: str, **arguments: Any) -> Any:
        return self._client.call(op, CALL_S, **arguments)


def _pool(place: str) -> str | None:
    """Return the context, node pool or Slurm cluster that a place names, with its cloud; None if it names none."""
    cloud, (_, *below) = cloud_of(place), split_infra(place)
    return f"{cloud.name}/{below[0]}" if below and (cloud.context_regions or cloud.places_in_zones) else None


def _check_known(name: str, known: Sequence[str]) -> None:
    """Raise CloudError if SkyPilot has other contexts, pools or clusters, and not this one."""
    cloud = name.partition("/")[0]
    others = sorted(one for one in known if one.lower().startswith(f"{cloud}/"))
    if others and name.partition("/")[2] not in {one.partition("/")[2] for one in others}:
        raise CloudError(
            f"spec.infra: SkyPilot has no {visible(name)}",
            f"write one that it has: {', '.join(map(visible, others[:NAMED]))}",
            f"or configure {visible(name.partition('/')[2])}, then: {shell_command('sky', 'check', cloud)}",
        )


@dataclass(slots=True, kw_only=True)
class Watch:
    """The state in this process of a job that has not ended: the call in flight, or the next one and when it is due.

    `tail` is the log read so far, `own` tells that this process started the job, `reads` counts reads of the whole log.
    """

    stage: Stage
    status: SampleStatus
    call: Future[Any] | None = None
    called_s: float = 0.0
    due_s: float = 0.0
    job: int | None = None
    record: Mapping[str, Any] | None = None
    tail: LogTail = field(default_factory=LogTail)
    own: bool = False
    reads: int = 0


class SkyPilotSamples(SkyPilotBackend):
    """Measures each sample on a machine of its own."""

    poll_s = 0.5
    costs = Costs.REAL
    notes: tuple[str, ...] = ()

    @property
    def source(self) -> str:
        """Which figures they are."""
        return f"measured with SkyPilot {self._client.version} on the machines that each sample names"

    def __init__(self, client: Client | None = None) -> None:
        super().__init__(client)
        self.at_once = AT_ONCE
        self._watched: dict[str, Watch] = {}
        self._stopping: dict[str, tuple[Future[Any], float]] = {}

    def start(self, job: Job) -> None:
        """Request the machine; `poll` tells whether it is available."""
        check_task(job)
        check_sources(job)
        try:
            secrets_file.check(job.task)
        except CloudProblem as problem:
            raise LaunchRefused(problem.reason, problem.detail) from None
        job.files.make_folder(job.directory)
        save(job, "launch.json", {"name": job.name, "at_s": time.time()})
        status = SampleStatus(running=True, ready=False, measured_on=job.machine_name)
        watch = self._watched[job.name] = Watch(stage=Stage.LAUNCH, status=status, own=True)
        self._begin(job, watch)

    def poll(self, job: Job) -> SampleStatus:
        """Return the status from the job's directory or the last call; begin the next call when it is due."""
        if (final := job_outcome.read_final(job)) is not None:
            return final
        watch = self._watched.get(job.name) or self._resumed(job)
        if watch is None:
            detail = "its launch was never requested"
            return SampleStatus(running=False, lost=True, measured_on=job.machine_name, detail=detail)
        if watch.stage is Stage.FOLLOW:
            watch.tail = logs.read_log(job.files, job.directory / LOG, watch.tail)
            watch.status = replace(watch.status, ready=watch.tail.ready, so_far=watch.tail.so_far)
        if watch.call is None:
            if time.monotonic() >= watch.due_s:
                self._begin(job, watch)
        elif watch.call.done():
            call, watch.call = watch.call, None
            self._take(job, watch, call)
        elif watch.stage is not Stage.FOLLOW and time.monotonic() - watch.called_s > HANGS_S:
            watch.call = None
            if watch.stage is Stage.LAUNCH:
                self._client.close()  # the request must not go out later
                watch.stage = Stage.FIND
            raise Unreachable(f"SkyPilot has not answered within {HANGS_S:g} s: {watch.stage}")
        if not watch.status.running:
            watch.status = replace(watch.status, so_far=None)
            del self._watched[job.name]
            job_outcome.write_final(job, watch.status)
        return watch.status

    def stop(self, job: Job) -> int | None:
        """Terminate its machine; raise Unreachable until the cloud has confirmed it. Return how many it says that it had."""
        if job.name not in self._stopping:
            self._await_launch(job)
            self._stopping[job.name] = self._client.begin("end", name=job.name), time.monotonic()
            futures.wait([self._stopping[job.name][0]], WAIT_S)
        call, called_s = self._stopping[job.name]
        if not call.done() and time.monotonic() - called_s < HANGS_S:
            raise Unreachable("its machine is being taken down")
        del self._stopping[job.name]
        if not call.done():
            raise Unreachable(f"SkyPilot has not taken it down within {HANGS_S:g} s")
        try:
            machines: int | None = call.result()
        except CloudProblem as problem:
            raise Unreachable(problem.detail) from None
        self._watched.pop(job.name, None)
        return machines

    def _await_launch(self, job: Job) -> None:
        """Raise Unreachable while the launch request is in flight."""
        watch = self._watched.get(job.name)
        if watch is None or watch.stage is not Stage.LAUNCH or watch.call is None:
            return
        if futures.wait([watch.call], WAIT_S).done:
            return
        if time.monotonic() - watch.called_s < HANGS_S:
            raise Unreachable("its launch is on its way to SkyPilot")
        self._client.close()

    def _resumed(self, job: Job) -> Watch | None:
        """Watch a job that another process started; None if there is none."""
        launch = load(job, "launch.json")
        if launch is None:
            return None
        stage = Stage.LAUNCHED if "request" in launch else Stage.FIND
        watch = Watch(stage=stage, status=SampleStatus(running=True, ready=False, measured_on=job.machine_name))
        return self._watched.setdefault(job.name, watch)

    def _begin(self, job: Job, watch: Watch) -> None:
        """Begin the call of the watch's stage."""
        op, arguments = str(watch.stage), dict[str, Any]()
        if watch.stage is Stage.LAUNCH:
            arguments = {"task": _labelled(job), "root": str(job.root.absolute())}
        elif watch.stage is Stage.LAUNCHED:
            arguments = {"request": (load(job, "launch.json") or {})["request"]}
        elif watch.stage in (Stage.FOLLOW, Stage.LOG):
            op, follow = "log", watch.stage is Stage.FOLLOW
            place = _absolute(job.root, job.directory / LOG)
            arguments = {"job": watch.job, **place, "limit": logs.LOG_LIMIT, "follow": follow}
        watch.called_s = time.monotonic()
        watch.call = self._client.begin(op, name=job.name, **arguments)

    def _take(self, job: Job, watch: Watch, call: Future[Any]) -> None:
        """Continue with the result of a call."""
        try:
            value = call.result()
        except Unreachable:
            # A log that breaks off tells nothing about the job, whose record comes next.
            watch.stage = {Stage.FOLLOW: Stage.JOBS, Stage.LAUNCH: Stage.FIND}.get(watch.stage, watch.stage)
            watch.due_s = time.monotonic() + JOB_POLL_S
            raise
        except CloudProblem as problem:
            watch.status = _failed(watch, problem)
            watch.stage = Stage.JOBS if watch.job is not None else watch.stage
            watch.due_s = time.monotonic() + JOB_POLL_S
            if watch.status.running:
                raise Unreachable(problem.detail) from None
            return
        match watch.stage:
            case Stage.LAUNCH:
                self._after_launch(job, watch, value)
            case Stage.FIND:
                self._after_find(job, watch, value)
            case Stage.LAUNCHED:
                self._after_launched(watch, value)
            case Stage.FOLLOW:
                self._after_follow(job, watch)
            case Stage.JOBS:
                self._after_jobs(watch, value)
            case Stage.LOG:
                self._after_log(job, watch)

    def _after_launch(self, job: Job, watch: Watch, value: Mapping[str, Any]) -> None:
        launch = load(job, "launch.json") or {}
        save(job, "launch.json", {**launch, "request": value["request"]})
        watch.stage, watch.due_s = Stage.LAUNCHED, 0.0

    def _after_find(self, job: Job, watch: Watch, value: Mapping[str, Any] | None) -> None:
        if value is None:
            watch.status = replace(watch.status, running=False, lost=True, detail=FORGOTTEN)
        elif "job" in value:
            self._after_launched(watch, value)
        else:
            self._after_launch(job, watch, value)

    def _after_launched(self, watch: Watch, value: Mapping[str, Any] | None) -> None:
        if value is None:
            watch.due_s = time.monotonic() + LAUNCH_POLL_S
        else:
            watch.job, watch.stage, watch.due_s = value["job"], Stage.FOLLOW, 0.0
            watch.status = replace(watch.status, detail="its machine is up")

    def _after_follow(self, job: Job, watch: Watch) -> None:
        # Another process cannot tell from the log when it was written.
        if logs.unpack(job.files, job.directory / LOG, job.directory / "out") and watch.own:
            record = {"status": "ended", "end_at": time.time()}
            watch.status = job_outcome.final_status(job, record, _launched_s(job))
        else:
            watch.stage, watch.due_s = Stage.JOBS, 0.0

    def _after_jobs(self, watch: Watch, value: Sequence[Mapping[str, Any]]) -> None:
        watch.record = next((one for one in value if one["job"] == watch.job), None)
        if watch.record is None:
            watch.status = replace(watch.status, running=False, lost=True, detail="its machine knows no such job")
        elif watch.record["status"] in OVER:
            watch.stage, watch.due_s = Stage.LOG, 0.0
        else:
            ready = watch.record["status"] == "RUNNING"
            watch.stage, watch.due_s = Stage.FOLLOW, time.monotonic() + JOB_POLL_S
            watch.status = replace(watch.status, ready=ready, detail=None)

    def _after_log(self, job: Job, watch: Watch) -> None:
        watch.reads += 1
        if logs.unpack(job.files, job.directory / LOG, job.directory / "out") or watch.reads == READS:
            watch.status = job_outcome.final_status(job, watch.record or {}, _launched_s(job))
        else:
            watch.due_s = time.monotonic() + LAUNCH_POLL_S


class SkyPilotDeployments(SkyPilotBackend):
    """Keeps each deployment running on a machine of its own."""

    poll_s = 5.0

    def __init__(self, client: Client | None = None) -> None:
        super().__init__(client)
        self._jobs: dict[str, int] = {}

    def start(self, job: Job) -> None:
        """Request the machine; `poll` tells whether it is available."""
        check_task(job)
        check_sources(job)
        try:
            secrets_file.check(job.task)
            self._call("launch", task=_labelled(job), name=job.name, root=str(job.root.absolute()))
        except CloudProblem as problem:
            raise LaunchRefused(problem.reason, problem.detail, again=problem.again) from None
        except CloudError as failed:
            raise LaunchRefused("setup", failed.message) from None

    def poll(self, job: Job) -> DeploymentStatus:
        """Return the status from the launch, then from the job and the end of its log."""
        number = self._jobs.get(job.name)
        if number is None:
            found = self._job_number(job.name)
            if isinstance(found, DeploymentStatus):
                return found
            number = self._jobs[job.name] = found
        try:
            job_status, reported = self._job_state(job.name, number)
        except CloudProblem as problem:
            if problem.gone:
                return DeploymentStatus(state="gone", detail=problem.detail)
            return self._without_answer(job.name, problem)
        if job_status is None:
            return DeploymentStatus(state="ended", detail="its machine knows no such job")
        if job_status in OVER:
            detail = None if reported is None else reported.detail
            return DeploymentStatus(state="ended", detail=detail or f"the job ended as {job_status}")
        if job_status != "RUNNING":
            return DeploymentStatus(state="starting", detail=f"the job is {job_status.lower()}")
        return reported or DeploymentStatus(state="starting", detail="the nodes have not said anything yet")

    def _without_answer(self, name: str, problem: CloudProblem) -> DeploymentStatus:
        """Return the status of a machine that was turned off; raise Unreachable, with what is known of it, for any other.

        SkyPilot has asked its cloud just now. After a reboot nothing of SkyPilot's or fogspec's runs on a machine.
        """
        status = None
        with contextlib.suppress(CloudProblem, CloudError, Unreachable):
            status = next((one["status"] for one in self._call("clusters", names=[name]) if one["name"] == name), None)
        if status == "STOPPED":
            return DeploymentStatus(state="ended", detail="its machine was turned off, and its disk is still paid")
        if status == "INIT":
            raise Unreachable("it is there and still paid, and SkyPilot on it does not answer, as after a reboot")
        raise Unreachable(problem.detail)

    def stop(self, job: Job) -> None:
        """Terminate its machine; raise Unreachable if the cloud has not confirmed it."""
        try:
            self._client.call("end", STOP_S, name=job.name)
        except (CloudProblem, CloudError) as problem:
            raise Unreachable(str(problem)) from None
        self._jobs.pop(job.name, None)

    def labels(self, job: Job) -> Mapping[str, str]:
        """Return the labels of the job's machine; none if there is no machine."""
        try:
            found = self._call("clusters", names=[job.name])
        except (CloudProblem, CloudError) as problem:
            raise Unreachable(str(problem)) from None
        return next((one.get("labels") or {} for one in found if one["name"] == job.name), {})

    def read_log(self, job: Job) -> bytes:
        """Return the last lines of the job's log; raise Unreachable."""
        try:
            number = self._jobs.get(job.name) or self._job_number(job.name)
            if isinstance(number, DeploymentStatus):
                return b""
            with tempfile.TemporaryDirectory(prefix="fogspec-") as folder:
                begun = self._begin_log(job.name, number, TAIL_LINES, Path(folder))
                return self._read_log(begun, Path(folder))
        except (CloudProblem, LaunchRefused) as problem:
            raise Unreachable(problem.detail) from None

    def _job_number(self, name: str) -> int | DeploymentStatus:
        """Return the job's number once the machine is up; raise LaunchRefused if the machine is unavailable."""
        try:
            found = self._call("find", name=name)
            if found is None:
                return DeploymentStatus(state="gone", detail=FORGOTTEN)
            value = found if "job" in found else self._call("launched", request=found["request"], name=name)
        except CloudProblem as problem:
            if problem.gone:
                return DeploymentStatus(state="gone", detail=problem.detail)
            raise LaunchRefused(problem.reason, problem.detail, again=problem.again) from None
        if value is None:
            return DeploymentStatus(state="starting", detail="its machine is being started")
        return int(value["job"])

    def _job_state(self, name: str, job: int) -> tuple[str | None, DeploymentStatus | None]:
        """Return the job's status and the last report in its log; the calls run at once, for each takes seconds."""
        with tempfile.TemporaryDirectory(prefix="fogspec-") as folder:
            log = self._begin_log(name, job, TAIL_LINES, Path(folder))
            jobs, clusters = self._client.begin("jobs", name=name), self._client.begin("clusters", names=[name])
            rows: Sequence[Mapping[str, Any]] = result(jobs, CALL_S, "jobs")
            status = next((str(row["status"]) for row in rows if row["job"] == job), None)
            machines = result(clusters, CALL_S, "clusters")
            address = next((row.get("ip") for row in machines if row["name"] == name), None)
            reported = agent_state.status_in_log(self._read_log(log, Path(folder)), address)
            if reported is None and status in (*OVER, "RUNNING"):
                # Nodes that print much push the supervisor's reports out of the last lines.
                log = self._begin_log(name, job, MANY_LINES, Path(folder))
                reported = agent_state.status_in_log(self._read_log(log, Path(folder)), address)
        return status, reported

    def _begin_log(self, name: str, job: int, lines: int, folder: Path) -> Future[Any]:
        place = _absolute(folder, folder / "tail.log")
        return self._client.begin("log", name=name, job=job, **place, limit=TAIL_BYTES, tail=lines)

    def _read_log(self, log: Future[Any], folder: Path) -> bytes:
        """Return the requested lines; none if they are unavailable just now."""
        with contextlib.suppress(Unreachable):
            result(log, CALL_S, "log")
        path = folder / "tail.log"
        return path.read_bytes() if path.is_file() else b""


def _absolute(root: Path, path: Path) -> dict[str, str]:
    """Return the arguments of a call that writes a file below `root`, for the worker has a working folder of its own."""
    return {"root": str(root.absolute()), "path": str(path.absolute())}


def _labelled(job: Job) -> dict[str, Any]:
    """Return the task to launch, with the labels of owner and job; the compiled file has none: it is the same in every fork."""
    resources: Any = job.task.get("resources") or {}
    return {
        **job.launched,
        "resources": {**resources, "labels": {**(resources.get("labels") or {}), **job.labels, **job.owner.labels}},
    }


def _launched_s(job: Job) -> float:
    return float((load(job, "launch.json") or {})["at_s"])


def _failed(watch: Watch, problem: CloudProblem) -> SampleStatus:
    """Return the status after a failed call: ended if the machine is unavailable or gone, else still running."""
    if watch.stage in (Stage.LAUNCH, Stage.FIND, Stage.LAUNCHED):
        billed_s = 0.0 if problem.refused else None
        status = replace(watch.status, running=False, again=problem.again, detail=problem.detail, billed_s=billed_s)
        return replace(status, lost=True) if problem.gone else replace(status, reason=problem.reason)
    if problem.gone:
        detail = "its machine ended before its results were here"
        return replace(watch.status, running=False, lost=True, detail=detail)
    return watch.status
