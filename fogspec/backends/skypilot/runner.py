"""Samples on machines of any infra that SkyPilot knows: one cluster of one machine a sample, named like the job.

No method waits for SkyPilot: a question is asked in one call and its answer taken in a later one. What another process
needs to go on is in the job's folder: `launch.json` from before a machine can exist, `ended.json` once it is over.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from fogspec.backends import job_outcome
from fogspec.backends.job_outcome import LOG, load, save, where
from fogspec.backends.protocol import Job, LaunchRefused, Progress, Unreachable
from fogspec.backends.skypilot import logs, secrets_file
from fogspec.backends.skypilot.client import Call, Client
from fogspec.backends.skypilot.errors import FORGOTTEN, CloudProblem
from fogspec.backends.skypilot.logs import LogTail

AT_ONCE = 8
LAUNCH_POLL_S = 2.0
JOB_POLL_S = 10.0
HANGS_S = 300.0
READS = 3  # of a log without the end that every job's has: it may have been cut on its way
STRAYS_S = 240.0  # the first question may have to start an API server
OVER = ("SUCCEEDED", "FAILED", "FAILED_SETUP", "FAILED_DRIVER", "CANCELLED")
NO_MACHINE = ("quota", "capacity", "budget")  # refusals of a machine: nothing was up, so nothing is paid
Stage = Literal["launch", "find", "launched", "jobs", "follow", "log"]


@dataclass(slots=True)
class Watch:
    """What this process knows of a job that has not ended: the next question and when it is worth asking.

    `heard` is what its log said so far, `own` whether this process started it, `reads` how often its log was read to the end.
    """

    stage: Stage
    progress: Progress
    call: Call | None = None
    due_s: float = 0.0
    job: int | None = None
    record: Mapping[str, Any] | None = None
    heard: LogTail = field(default_factory=LogTail)
    own: bool = False
    reads: int = 0


class SkyPilotRunner:
    """Runs each sample's reviewed task on a machine of its own."""

    name = "skypilot"
    poll_s = 0.5
    costs: Literal["real"] = "real"

    def __init__(self, at_once: int = AT_ONCE, client: Client | None = None) -> None:
        self._client = client or Client()
        self.at_once = at_once
        self.source = f"measured with SkyPilot {self._client.version} on the machines that each sample names"
        self._watched: dict[str, Watch] = {}
        self._ending: dict[str, Call] = {}

    def start(self, job: Job) -> None:
        """Ask for the machine; whether it can be had is said by `look`."""
        try:
            secrets_file.check(job.task)
        except CloudProblem as problem:
            raise LaunchRefused(problem.reason, problem.detail) from None
        job.folder.mkdir(parents=True)
        save(job.folder / "launch.json", {"name": job.name, "at_s": time.time()})
        call = self._client.begin("launch", task=job.task, name=job.name, root=str(job.root.absolute()))
        progress = Progress(running=True, ready=False, measured_on=where(job))
        self._watched[job.name] = Watch("launch", progress, call, own=True)

    def look(self, job: Job) -> Progress:
        """What is known of it, from its folder or from the last answer; asks the next question when it is time to."""
        if (over := job_outcome.kept(job.folder)) is not None:
            return over
        watch = self._watched.get(job.name) or self._found(job)
        if watch is None:
            return Progress(running=False, lost=True, measured_on=where(job), detail="its launch was never asked for")
        if watch.stage == "follow":
            watch.heard = logs.read_log(job.folder / LOG, watch.heard)
            watch.progress = replace(watch.progress, ready=watch.heard.ready, so_far=watch.heard.so_far)
        if watch.call is None:
            if time.monotonic() >= watch.due_s:
                watch.call = self._ask(job, watch)
        elif watch.call.done:
            call, watch.call = watch.call, None
            self._take(job, watch, call)
        elif watch.stage != "follow" and time.monotonic() - watch.call.asked_s > HANGS_S:
            watch.call = None
            if watch.stage == "launch":
                self._client.close()  # it must not be asked for later on
                watch.stage = "find"
            raise Unreachable(f"SkyPilot has not answered within {HANGS_S:g} s: {watch.stage}")
        if not watch.progress.running:
            watch.progress = replace(watch.progress, so_far=None)
            del self._watched[job.name]
            job_outcome.keep(job.folder, watch.progress)
        return watch.progress

    def end(self, job: Job) -> None:
        """Take its machine down; raises Unreachable until the cloud says that it is gone."""
        call = self._ending.get(job.name)
        if call is None:
            self._await_launch(job)
            call = self._ending[job.name] = self._client.begin("end", name=job.name)
            call.wait(1.0)
        if not call.done and time.monotonic() - call.asked_s < HANGS_S:
            raise Unreachable("its machine is being taken down")
        del self._ending[job.name]
        if not call.done:
            raise Unreachable(f"SkyPilot has not taken it down within {HANGS_S:g} s")
        try:
            call.value()
        except CloudProblem as problem:
            raise Unreachable(problem.detail) from None
        self._watched.pop(job.name, None)

    def _await_launch(self, job: Job) -> None:
        """Raise Unreachable while its launch is on its way from here."""
        watch = self._watched.get(job.name)
        if watch is not None and watch.stage == "launch" and watch.call is not None and not watch.call.wait(1.0):
            if time.monotonic() - watch.call.asked_s < HANGS_S:
                raise Unreachable("its launch is on its way to SkyPilot")
            self._client.close()

    def strays(self, prefix: str, folder: Path) -> Sequence[str]:
        """Names of machines that SkyPilot has, or is about to have."""
        try:
            known = [one["name"] for one in self._client.ask("clusters", STRAYS_S, prefix=prefix)]
            return sorted({*known, *self._client.ask("waiting", STRAYS_S, prefix=prefix)})
        except CloudProblem as problem:
            raise Unreachable(problem.detail) from None

    def _found(self, job: Job) -> Watch | None:
        """A job that another process started."""
        launch = load(job.folder / "launch.json")
        if launch is None:
            return None
        stage: Stage = "launched" if "request" in launch else "find"
        watch = Watch(stage, Progress(running=True, ready=False, measured_on=where(job)))
        return self._watched.setdefault(job.name, watch)

    def _ask(self, job: Job, watch: Watch) -> Call:
        if watch.stage == "launched":
            launch = load(job.folder / "launch.json") or {}
            return self._client.begin("launched", request=launch["request"], name=job.name)
        if watch.stage in ("follow", "log"):
            path, follow = str((job.folder / LOG).absolute()), watch.stage == "follow"
            return self._client.begin(
                "log", name=job.name, job=watch.job, path=path, limit=logs.LOG_LIMIT, follow=follow
            )
        return self._client.begin(watch.stage, name=job.name)

    def _take(self, job: Job, watch: Watch, call: Call) -> None:
        """Go on with an answer."""
        try:
            value = call.value()
        except Unreachable:
            # A log that breaks off says nothing of the job: that is asked for next.
            watch.stage = "jobs" if watch.stage == "follow" else watch.stage
            watch.stage = "find" if watch.stage == "launch" else watch.stage
            watch.due_s = time.monotonic() + JOB_POLL_S
            raise
        except CloudProblem as problem:
            watch.progress = _refused(watch, problem)
            watch.stage, watch.due_s = "jobs" if watch.job is not None else watch.stage, time.monotonic() + JOB_POLL_S
            if watch.progress.running:
                raise Unreachable(problem.detail) from None
            return
        getattr(self, f"_after_{watch.stage}")(job, watch, value)

    def _after_launch(self, job: Job, watch: Watch, value: Mapping[str, Any]) -> None:
        launch = load(job.folder / "launch.json") or {}
        save(job.folder / "launch.json", {**launch, "request": value["request"]})
        watch.stage, watch.due_s = "launched", 0.0

    def _after_find(self, job: Job, watch: Watch, value: Mapping[str, Any] | None) -> None:
        if value is None:
            watch.progress = replace(watch.progress, running=False, lost=True, detail=FORGOTTEN)
        elif "job" in value:
            self._after_launched(job, watch, value)
        else:
            self._after_launch(job, watch, value)

    def _after_launched(self, job: Job, watch: Watch, value: Mapping[str, Any] | None) -> None:
        if value is None:
            watch.due_s = time.monotonic() + LAUNCH_POLL_S
        else:
            watch.job, watch.stage, watch.due_s = value["job"], "follow", 0.0
            watch.progress = replace(watch.progress, detail="its machine is up")

    def _after_follow(self, job: Job, watch: Watch, value: int) -> None:
        # Whoever comes to it later cannot tell from the log when it was written.
        if logs.unpack(job.folder / LOG, job.folder / "out") and watch.own:
            over_s = time.time()
            watch.progress = job_outcome.ended(job, {"status": "ended", "end_at": over_s}, self._asked_s(job))
        else:
            watch.stage, watch.due_s = "jobs", 0.0

    def _after_jobs(self, job: Job, watch: Watch, value: Sequence[Mapping[str, Any]]) -> None:
        watch.record = next((one for one in value if one["job"] == watch.job), None)
        if watch.record is None:
            watch.progress = replace(watch.progress, running=False, lost=True, detail="its machine knows no such job")
        elif watch.record["status"] in OVER:
            watch.stage, watch.due_s = "log", 0.0
        else:
            ready = watch.record["status"] == "RUNNING"
            watch.stage, watch.due_s = "follow", time.monotonic() + JOB_POLL_S
            watch.progress = replace(watch.progress, ready=ready, detail=None)

    def _after_log(self, job: Job, watch: Watch, value: int) -> None:
        watch.reads += 1
        if logs.unpack(job.folder / LOG, job.folder / "out") or watch.reads == READS:
            watch.progress = job_outcome.ended(job, watch.record or {}, self._asked_s(job))
        else:
            watch.due_s = time.monotonic() + LAUNCH_POLL_S

    def _asked_s(self, job: Job) -> float:
        return float((load(job.folder / "launch.json") or {})["at_s"])


def _refused(watch: Watch, problem: CloudProblem) -> Progress:
    """A machine that could not be had, or is no more; still running where only the question failed."""
    if watch.stage in ("launch", "find", "launched"):
        never = problem.reason in NO_MACHINE
        over = replace(watch.progress, running=False, again=problem.again, detail=problem.detail,
                       billed_s=0.0 if never else None)  # fmt: skip
        return replace(over, lost=True) if problem.gone else replace(over, reason=problem.reason)
    if problem.gone:
        return replace(
            watch.progress, running=False, lost=True, detail="its machine ended before its results were here"
        )
    return watch.progress
