"""The records that every probe writes, and conditions on the fields of a message.

Each record is one line of JSON, appended by one write to FOGSPEC_TIMINGS (standard output if it is not set):

- a request: name, start_s, latency_s (response time including waiting), service_s (departure - max(arrival, previous
  departure)), ok, reason, metrics, and stamp if it has one; `lost` marks a request without a response
- `unmatched`: a response without a request
- `metric`: values of a topic's fields, which the reader of the file assigns to a request; under `!` a client's verdict on
  a response
- `note`: a hint why nothing is timed; `warning`: why the latencies may be misleading
- `hold`: whether what sends the requests is to be held back; with `ended`, all responses came once it was held for good, and
  with `refused`, why nothing can be measured
"""

import json
import operator
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

CONDITION = re.compile(r"\s*(len\()?([A-Za-z_]\w*(?:\.\w+|\[\d+\])*)(?(1)\))\s*(==|!=|<=|>=|<|>)\s*(.+?)\s*")
RELATIONS: dict[str, Callable[[Any, Any], bool]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
}
Stamp = tuple[int, int]
VERDICT = "!"  # instead of a metric's name: why a response does not count, or null


@dataclass(frozen=True)
class Done:
    """A finished request, times in seconds; `latency_s` is None for one that gets no response, or of which `why` says more."""

    start_s: float
    latency_s: float | None
    service_s: float | None = None
    stamp: Stamp | None = None
    why: str | None = None


class Writer:
    """Append records with one name."""

    def __init__(self, name: str, path: str | None = None) -> None:
        self.name = name
        self.path = path or os.environ.get("FOGSPEC_TIMINGS")

    def request(self, done: Done, failure: str | None = None) -> None:
        """Write a finished or lost request; `failure` is the reason why its response does not count."""
        lost = done.latency_s is None
        reason = done.why or "no response" if lost else failure
        record: dict[str, Any] = {
            "name": self.name,
            "start_s": done.start_s,
            "latency_s": done.latency_s or 0.0,
            "ok": reason is None,
            "reason": reason,
            "metrics": {},
        }
        if lost:
            record["lost"] = True
        if done.service_s is not None:
            record["service_s"] = done.service_s
        if done.stamp is not None:
            record["stamp"] = done.stamp
        self.line(record)

    def unmatched(self, at_s: float) -> None:
        """Write a response without a request."""
        self.line({"name": self.name, "unmatched": True, "at_s": at_s})

    def metric(self, values: dict[str, float] | dict[str, str | None], at_s: float, stamp: Stamp | None) -> None:
        """Write values for the request with this stamp, or for the one in progress at this time."""
        self.line({"metric": values, "at_s": at_s, "stamp": stamp})

    def warning(self, text: str | None) -> None:
        """Write why the latencies may be misleading; do nothing for None."""
        if text is not None:
            self.line({"warning": text})

    def line(self, record: dict[str, Any]) -> None:
        """Write one record by one write. The file is reopened each time because it is moved when it is large."""
        file = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644) if self.path else os.dup(1)
        try:
            os.write(file, (json.dumps(record) + "\n").encode())
        finally:
            os.close(file)


@dataclass(frozen=True)
class Condition:
    """`path.found == true`, `len(poses) > 0`: a field of a message, a relation, and a JSON value or bare text."""

    text: str
    path: str
    length: bool
    relation: str
    value: Any

    @staticmethod
    def parse(text: str) -> "Condition":
        """Return the condition in a text; raise ValueError if it is not one."""
        found = CONDITION.fullmatch(text)
        if found is None:
            raise ValueError(f"{text!r} is not a condition: write a field, a relation and a value, such as status == 0")
        try:
            value = json.loads(found[4])
        except ValueError:
            value = found[4].strip("'")
        return Condition(text, found[2], found[1] is not None, found[3], value)

    def failure(self, message: Any) -> str | None:
        """Return why the message does not meet it, or None if it does; raise ValueError for an unknown field."""
        value = field_of(message, self.path)
        value = len(value) if self.length else value
        try:
            holds = RELATIONS[self.relation](value, self.value)
        except TypeError as problem:
            raise ValueError(f"{self.text!r} cannot be decided: {problem}") from problem
        return None if holds else f"{self.text} does not hold: it is {str(value)[:80]}"


def field_of(message: Any, path: str) -> Any:
    """Return the field at a path such as `poses[0].pose.position.x`; raise ValueError if it does not exist."""
    for step in re.findall(r"\w+", path):
        try:
            message = message[int(step)] if step.isdigit() else getattr(message, step)
        except (AttributeError, IndexError, TypeError) as problem:
            raise ValueError(f"{type(message).__name__} has no field {path}: {problem}") from problem
    return message
