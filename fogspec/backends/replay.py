"""Replay of samples that were measured before, with their failures, durations and prices."""

import json
from collections.abc import Callable, Collection, Sequence
from itertools import islice
from pathlib import Path

from fogspec.backends.naming import Owner
from fogspec.backends.protocol import Costs, Job, LaunchRefused, SampleStatus
from fogspec.base.files import read_bounded
from fogspec.plan.schema import PartName
from fogspec.results.io import PACKED_LIMIT, Recording, unpacked


class ReplaySamples:
    """Replays recordings by infra and instance type; `pace` is the seconds waited per recorded second (0: no wait)."""

    name = "replay"
    costs = Costs.RECORDED
    notes: tuple[str, ...] = ()

    def __init__(
        self,
        recordings: Sequence[Recording],
        source: str,
        now_s: Callable[[], float],
        pace: float = 0.0,
        at_once: int = 64,
    ) -> None:
        self._recordings = [one for one in recordings if one.record.nested_in is None]
        self._parts = [one for one in recordings if one.record.nested_in is not None]
        self.source = source
        self._now_s, self._pace = now_s, pace
        self.at_once = at_once
        self.poll_s = 0.05 if pace else 0.0

    def start(self, job: Job) -> None:
        """Find the recording; raise LaunchRefused if this machine was not recorded, or not so often."""
        number = self._find(job)
        if number is None:
            further = "" if job.replicate == 1 else "further "
            raise LaunchRefused("capacity", f"there is no {further}recording of {job.machine_name}")
        job.files.make_folder(job.directory)
        state = {"recording": number, "at_s": self._now_s()}
        job.files.write(job.directory / "replay.json", json.dumps(state).encode())

    def poll(self, job: Job) -> SampleStatus:
        """Return the record as soon as its time is over."""
        try:
            state = json.loads(job.files.read(job.directory / "replay.json"))
            recording = self._recordings[state["recording"]]
        except (OSError, ValueError, KeyError, IndexError, TypeError):
            return SampleStatus(running=False, lost=True, detail="the replay had not begun")
        record = recording.record
        if not recording.priced and job.machine is not None:
            record = record.model_copy(update={"spent": job.machine.price * record.duration / 3600})
        running = self._now_s() - state["at_s"] < record.duration * self._pace
        timings = None if running else _unpacked(recording, job)
        return SampleStatus(
            running=running,
            timings=timings,
            measured_on=record.measured_on,
            billed_s=record.duration,
            recorded=None if running else record,
            parts={} if running else self._recorded_parts(job, record.id),
        )

    def _recorded_parts(self, job: Job, sample: str) -> dict[PartName, SampleStatus]:
        """Return the parts of a job's machine that were recorded with that sample."""
        found: dict[PartName, SampleStatus] = {}
        for part in job.parts:
            for one in self._parts:
                where = one.record.nested_in
                if where is not None and (where.sample, where.part) == (sample, part.part):
                    timings = _unpacked(one, job, part.part)
                    found[part.part] = SampleStatus(
                        running=False,
                        timings=timings,
                        measured_on=one.record.measured_on,
                        billed_s=one.record.duration,
                        recorded=one.record,
                        confined=where.confined,
                    )
        return found

    def stop(self, job: Job) -> None:
        """Do nothing: nothing runs, so nothing is left."""

    def check_access(self, places: Collection[str]) -> None:
        """Do nothing: nothing is started."""

    def list(self, owner: Owner, directory: Path) -> Sequence[str]:
        """Return nothing: recordings have no machines."""
        return ()

    def _find(self, job: Job) -> int | None:
        machine = job.machine
        if machine is None:
            return None
        wanted = machine.instance, machine.spot
        recorded = [one.record.machine for one in self._recordings]
        same = [n for n, one in enumerate(recorded) if (one.instance, one.spot) == wanted]
        exact = [n for n in same if recorded[n].infra == machine.infra]
        # A sweep need not say where it was measured; two places that differ are not mixed up.
        anywhere = [n for n in same if not recorded[n].infra]
        return next(islice(exact or anywhere, job.replicate - 1, None), None)


def _unpacked(recording: Recording, job: Job, part: str = "") -> Path | None:
    if recording.timings is None:
        return None
    path = job.directory / part / "timings.jsonl"
    job.files.write(path, unpacked(read_bounded(recording.timings, PACKED_LIMIT), recording.timings))
    return path
