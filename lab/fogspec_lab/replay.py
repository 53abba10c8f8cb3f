"""Replay of samples that were measured before, with their failures, durations and prices."""

import json
from collections.abc import Callable, Collection, Sequence
from itertools import islice
from pathlib import Path

from fogspec.backends.naming import Owner
from fogspec.backends.protocol import Costs, Job, LaunchRefused, SampleStatus
from fogspec.base.files import read_bounded
from fogspec.base.layout import MOST_BYTES
from fogspec.results.io import PACKED_LIMIT, unpacked
from fogspec_lab.recordings import Recording


class ReplaySamples:
    """Replays recordings by infra and instance type; `pace` is the seconds waited per recorded second (0: no wait)."""

    costs = Costs.RECORDED
    at_once = 64
    notes: tuple[str, ...] = ()

    def __init__(
        self,
        recordings: Sequence[Recording],
        source: str,
        now_s: Callable[[], float],
        pace: float = 0.0,
    ) -> None:
        self._recordings = list(recordings)
        self.name = self._recordings[0].runner if self._recordings else "replay"
        self.source = source
        self._now_s, self._pace = now_s, pace
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
            state = json.loads(job.files.read(job.directory / "replay.json", MOST_BYTES))
            recording = self._recordings[state["recording"]]
        except (OSError, ValueError, KeyError, IndexError, TypeError):
            return SampleStatus(running=False, lost=True, detail="the replay had not begun")
        record = recording.record
        if not recording.priced and job.machine is not None:
            record = record.model_copy(update={"spent": job.machine.paid_usd_per_hour * record.duration / 3600})
        running = self._now_s() - state["at_s"] < record.duration * self._pace
        timings = None if running else _unpacked(recording, job)
        return SampleStatus(
            running=running,
            timings=timings,
            measured_on=record.measured_on,
            billed_s=record.duration,
            recorded=None if running else record,
        )

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


def _unpacked(recording: Recording, job: Job) -> Path | None:
    if recording.timings is None:
        return None
    path = job.directory / "timings.jsonl"
    job.files.write(path, unpacked(read_bounded(recording.timings, PACKED_LIMIT), recording.timings))
    return path
