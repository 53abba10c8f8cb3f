"""Samples that were measured before, with their failures, durations and prices."""

import gzip
import json
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from typing import Literal

from fogspec.backends.protocol import Job, LaunchRefused, Progress
from fogspec.plan.design import replicate
from fogspec.results.io import Recording

SIZE_LIMIT = 256 * 2**20


class ReplayRunner:
    """Plays recordings by infra and instance type; `pace` is seconds waited per recorded second (0: at once)."""

    name = "replay"
    costs: Literal["recorded"] = "recorded"

    def __init__(
        self,
        recordings: Sequence[Recording],
        source: str,
        now_s: Callable[[], float],
        pace: float = 0.0,
        at_once: int = 64,
    ) -> None:
        self._recordings = list(recordings)
        self.source = source
        self._now_s, self._pace = now_s, pace
        self.at_once = at_once
        self.poll_s = 0.05 if pace else 0.0

    def start(self, job: Job) -> None:
        """Find the recording; raises LaunchRefused when this machine was not recorded, or not so often."""
        number = self._find(job)
        if number is None:
            machine = job.sample.machine
            further = "" if replicate(job.sample.id) == 1 else "further "
            raise LaunchRefused("capacity", f"there is no {further}recording of {machine.infra}/{machine.instance}")
        job.folder.mkdir(parents=True)
        state = {"recording": number, "at_s": self._now_s()}
        (job.folder / "replay.json").write_text(json.dumps(state), encoding="utf-8")

    def look(self, job: Job) -> Progress:
        """The record, as soon as its time is over."""
        try:
            state = json.loads((job.folder / "replay.json").read_text(encoding="utf-8"))
            recording = self._recordings[state["recording"]]
        except (OSError, ValueError, KeyError, IndexError, TypeError):
            return Progress(running=False, lost=True, detail="the replay had not begun")
        record = recording.record
        if not recording.priced:
            record = record.model_copy(update={"spent": job.sample.machine.price * record.duration / 3600})
        running = self._now_s() - state["at_s"] < record.duration * self._pace
        timings = None if running else _unpacked(recording, job.folder / "timings.jsonl")
        return Progress(
            running=running, timings=timings, measured_on=record.measured_on, billed_s=record.duration,
            recorded=None if running else record,
        )  # fmt: skip

    def end(self, job: Job) -> None:
        """Nothing runs, so nothing is left."""

    def _find(self, job: Job) -> int | None:
        machine = job.sample.machine
        same = [
            n for n, r in enumerate(self._recordings)
            if r.record.machine.instance == machine.instance and r.record.machine.spot == machine.spot
        ]  # fmt: skip
        exact = [n for n in same if self._recordings[n].record.machine.infra == machine.infra]
        # A sweep need not say where it was measured; two places that differ are not mixed up.
        anywhere = [n for n in same if not self._recordings[n].record.machine.infra]
        return next(islice(exact or anywhere, replicate(job.sample.id) - 1, None), None)


def _unpacked(recording: Recording, path: Path) -> Path | None:
    if recording.timings is None:
        return None
    with gzip.open(recording.timings) as packed:
        path.write_bytes(packed.read(SIZE_LIMIT))
    return path
