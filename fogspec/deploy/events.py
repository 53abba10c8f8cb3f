"""The events of an application: one line of JSON each, in a file that is only appended to."""

import json
import os
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from fogspec.base.errors import InvalidInput
from fogspec.base.layout import Layout
from fogspec.base.redaction import without_secrets
from fogspec.deploy.schema import date_of
from fogspec.deploy.state import WallClock

RESTART = "restart"
TAIL_BYTES = 2**20
HOUR_S = 3600.0


@dataclass(slots=True)
class Events:
    """The events of one application; restarts of this process count also when the file is gone."""

    layout: Layout
    times: WallClock
    _own: list[float] = field(default_factory=list)

    def add(self, event: str, text: str, machine: str | None = None) -> dict[str, Any]:
        """Append an event, durably, and return it; raise InvalidInput if that fails."""
        found = {
            "date": date_of(self.times.date().timestamp()),
            "application": self.layout.name,
            "event": event,
            "machine": machine,
            "text": without_secrets(text),
            "at_s": round(self.times.now_s(), 3),
            "boot": self.times.boot(),
        }
        line = (json.dumps(found) + "\n").encode()
        try:
            with self.layout.files.append(self.layout.events) as file:
                size = os.fstat(file.fileno()).st_size
                # A process that was killed while it wrote leaves a line without its end.
                if size and (file.seek(size - 1), file.read(1))[1] != b"\n":
                    line = b"\n" + line
                file.write(line)
                os.fsync(file.fileno())
        except OSError as problem:
            raise InvalidInput(
                f"{self.layout.events}: {problem.strerror or problem}", "free space or rights, then run again"
            ) from None
        if event == RESTART:
            self._own.append(self.times.now_s())
        return found

    def read(self) -> list[dict[str, Any]]:
        """Return the latest events, without lines that cannot be read; raise InvalidInput if the file cannot be read."""
        files, path = self.layout.files, self.layout.events
        if not files.exists(path):
            return []
        try:
            with files.open(path) as file:
                size = os.fstat(file.fileno()).st_size
                file.seek(max(0, size - TAIL_BYTES))
                lines = file.read(TAIL_BYTES).split(b"\n")[1 if size > TAIL_BYTES else 0 :]
        except OSError as problem:
            raise InvalidInput(
                f"{path}: {problem.strerror or problem}", "without it restarts cannot be counted"
            ) from None
        return [one for one in map(_event, lines) if one is not None]

    def restarts(self) -> int:
        """Return how many restarts are among the latest events."""
        return sum(one["event"] == RESTART for one in self.read())

    def ages_s(self) -> list[float]:
        """Return how long ago the restarts of the last hour were, the latest last; one dated in the future counts as now."""
        found = [self._age_s(one) for one in self.read() if one["event"] == RESTART]
        own = [self.times.now_s() - at_s for at_s in self._own]
        recent, mine = ([age_s for age_s in ages_s if age_s < HOUR_S] for ages_s in (found, own))
        return recent if len(recent) >= len(mine) else mine

    def _age_s(self, event: dict[str, Any]) -> float:
        if event["boot"] == self.times.boot():
            return max(0.0, self.times.now_s() - float(event["at_s"]))
        return max(0.0, (self.times.date() - datetime.fromisoformat(event["date"])).total_seconds())


def _event(line: bytes) -> dict[str, Any] | None:
    """Return the event in a line; None for anything else."""
    try:
        found = json.loads(line)
        known = isinstance(found["event"], str) and isinstance(found["boot"], str)
        dated = datetime.fromisoformat(found["date"]).tzinfo is not None
        float(found["at_s"])
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return found if known and dated else None
