"""The stopping rule: count a sample's requests as they are written, and decide whether there are enough."""

import contextlib
import json
import math
import re
import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .files import open_plain, truncate
from .intervals import LEVEL, STRICT, Interval, interval

TIMINGS_LIMIT = 256 * 2**20
READ_BYTES = 2**18
LINE_LIMIT = 2**16
NOT_REQUESTS = {"open", "unmatched", "metric", "note", "warning", "hold", "missed"}
MOST_PROCESSES = 10_000  # that are told apart
OTHER_NAMES = 5
LEAST = 10  # valid requests before the first check
HEARD_BY_S = 60.0  # after the first valid request
MOST_HEARD = 100


class WarmUp:
    """The first requests that do not count: those of each process that times some, for each has its own to load."""

    def __init__(self, requests: int) -> None:
        self.requests = requests
        self.finished: dict[str, int] = {}
        self.warm = 0  # processes that are past it

    def over(self, process: object) -> bool:
        """Take a finished request of this process; return whether it counts."""
        key = process[:100] if isinstance(process, str) else ""
        key = key if key in self.finished or len(self.finished) < MOST_PROCESSES else ""
        number = self.finished[key] = self.finished.get(key, 0) + 1
        self.warm += number == max(1, self.requests)
        return number > self.requests

    def is_over(self) -> bool:
        """Return whether each process that times requests is past it."""
        return self.warm == len(self.finished) > 0


class Timings:
    """The growing file of records; an incomplete last line is left until it is complete."""

    def __init__(
        self, path: Path, warmup: int, callback: str | None = None, weights: Mapping[str, float] | None = None
    ) -> None:
        self.path, self.warmup, self.callback, self.weights = path, WarmUp(warmup), callback, weights or {}
        self.offset = self.requests = self.counted = self.unreadable = 0
        self.next_check = LEAST
        self.valid: list[float] = []
        self.kinds: list[str] = []  # and their scenarios, if those have weights
        self.rest = b""
        self.note: str | None = None
        self.topic = False  # the note is that a topic is published by nearly this name
        self.others: dict[str, None] = {}
        self.awaited = callback is not None  # no request of its name has started
        self.expected: list[tuple[str, str, str]] = []  # a name, what it is, and in how many valid requests to hear it
        self.heard: dict[str, None] = {}  # names of metrics, and of scenarios behind a word
        self.hold: bool | None = None  # whether the listener wants the senders held, if it ever did
        self.ended = False  # it heard all responses after they were held for good
        self.refused: str | None = None

    def read(self) -> bool:
        """Read new records; return True if there was at least one complete request."""
        before = self.requests
        with contextlib.suppress(OSError), open(open_plain(self.path), "rb") as file:
            file.seek(self.offset)
            # Python allocates the size of each read, and the memory is the workload's.
            while new := file.read(min(READ_BYTES, TIMINGS_LIMIT - self.offset)):
                self.offset += len(new)
                *lines, self.rest = (self.rest + new).split(b"\n")
                for line in filter(None, lines):
                    self._take(line)
                if len(self.rest) > LINE_LIMIT:  # longer than any record
                    self.rest, self.unreadable = b"", self.unreadable + 1
        return self.requests > before

    def cut(self) -> None:
        """Truncate the file to what was read: a request that was interrupted by ending its process did not fail."""
        truncate(self.path, self.offset - len(self.rest))

    def _take(self, line: bytes) -> None:
        try:
            record = json.loads(line)
            if NOT_REQUESTS & record.keys():
                self._look(record)
                return
            latency_s, ok = float(record["latency_s"]), record["ok"] is True
            if not 0 <= latency_s < math.inf:
                raise ValueError(latency_s)
        except (ArithmeticError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
            self.unreadable += 1
            return
        if self.callback is not None and record.get("name") != self.callback:
            if self.awaited and len(self.others) < OTHER_NAMES:
                self.others[str(record.get("name"))[:100]] = None
            return
        self.awaited = False
        self.requests += 1
        if self.warmup.over(record.get("process")):
            self.counted += 1
            if ok:
                kind = record.get("scenario")
                if not self.weights or (isinstance(kind, str) and kind in self.weights):
                    self.valid.append(latency_s)
                    self.kinds += [kind] if self.weights else []
                self._hear(record.get("metrics"), kind)

    def _look(self, record: dict[str, Any]) -> None:
        """Take a record that is not a request: a start is the reason why nothing is timed, until something else is."""
        name = record.get("open")
        if "hold" in record:
            self.hold, self.ended = record["hold"] is True, record.get("ended") is True
            self.refused = self.refused or (str(record["refused"])[:300] if "refused" in record else None)
        elif "note" in record:
            self.note, self.topic = str(record["note"])[:300], record.get("misnamed") is True
        elif isinstance(why := record.get("reason"), str):
            self.note = f"{str(record.get('name'))[:100]!r} was {why[:200]}"
        elif isinstance(name, str) and self.note is None and self.callback in (None, name):
            self.note = f"{name[:100]!r} was started and has not ended"
        self.awaited = self.awaited and name != self.callback
        self._hear(record.get("metric"))

    def _hear(self, values: object, scenario: object = None) -> None:
        numbers = values.items() if isinstance(values, dict) else ()
        names = [name[:100] for name, value in numbers if type(value) in (int, float)]
        names += [f"scenario {scenario}"] if isinstance(scenario, str) else []
        self.heard.update(dict.fromkeys(name for name in names if len(self.heard) < MOST_HEARD))

    def unheard(self, passed_s: float, over: bool = False) -> tuple[str, bool] | None:
        """Return what is expected and was not heard, what was instead, and whether it is missing; None if all was heard.

        A metric is also missing `HEARD_BY_S` after the first valid request, `passed_s` ago, and by a slip of the keyboard
        when the sample is `over`.
        """
        n, texts, missing, known = len(self.valid), list[str](), False, {key for key, _, _ in self.expected}
        for key, what, least in self.expected if n else ():
            enough = n >= float(least)
            others = [one for one in self.heard if one not in known and (" " in one) == (" " in key)]
            # How often a scenario comes in a sample, its weight does not say: it may come late, unless another comes instead.
            if key in self.heard or (" " in key and not (enough and (others or over))):
                continue
            near = [one for one in others if mistyped(key, one)]
            instead = f"the node reported {', '.join(near or others) or 'no other'}"
            if least == "inf":
                instead = str(self.note) if what.split()[-1] in str(self.note) else "nothing was heard"
            texts.append(f"no {what}: {instead}")
            missing |= enough or passed_s >= HEARD_BY_S or (over and bool(near))
        return ("; ".join(texts), missing) if texts else None

    def misnamed(self) -> tuple[str, bool] | None:
        """Return why no request counts, and whether that is certain: others are timed and the spec's was not even started.

        That a topic is published by nearly the wanted name is not: the node of the wanted one may not be up.
        """
        if self.topic:
            return str(self.note), False
        if not self.awaited or not self.others:
            return None
        timed = ", ".join(map(repr, self.others))
        slip = any(mistyped(str(self.callback), name) for name in self.others)
        wrong = f"no request named {self.callback!r} was timed, only {timed}"
        return f"{wrong}: compare spec.probe with what the workload times", slip

    def summary(self) -> str:
        """Return the number of requests and the mean latency of the valid ones, as text."""
        mean = f", mean {statistics.fmean(self.valid):.6g} s" if self.valid else ""
        return f"{self.requests} requests{mean}"

    def due(self) -> bool:
        """Return whether to check the precision: after every 5% more requests, because that sorts all of them."""
        if len(self.valid) < self.next_check:
            return False
        self.next_check = math.ceil(len(self.valid) * 1.05) + 1
        return True

    def precise(self, precision: float, statistic: str) -> bool:
        """Return whether the half-width of the 95% interval is at most `precision` times the statistic."""
        found = self._interval(statistic, LEVEL)
        return found.half <= precision * found.value

    def above(self, latency_s: float, statistic: str) -> bool:
        """Return whether the statistic is above this latency: the lower end of its 99% interval is."""
        return self._interval(statistic, STRICT).low > latency_s

    def _interval(self, statistic: str, level: float) -> Interval:
        return interval(self.valid, statistic, level, self.kinds, self.weights)


def mistyped(one: str, other: str) -> bool:
    """Return whether two names differ only in case and separators, or in one letter left out, added, changed or swapped.

    Names that differ in a digit, such as `plan_1` and `plan_2`, are two names.
    """
    a, b = (re.sub(r"[^a-z0-9]", "", name.lower()) for name in (one, other))
    while a and b and a[0] == b[0]:
        a, b = a[1:], b[1:]
    while a and b and a[-1] == b[-1]:
        a, b = a[:-1], b[:-1]
    swapped = len(a) == 2 and a == b[::-1]
    return not re.search(r"\d", a + b) and (swapped or max(len(a), len(b)) <= 1)
