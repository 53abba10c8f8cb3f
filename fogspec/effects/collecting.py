"""From a sample's raw timings to its record. The file came from another machine: nothing in it is trusted."""

import gzip
import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeGuard

from fogspec.base import digest
from fogspec.effects.statistics import NEEDED, summary, weights
from fogspec.plan import Sample
from fogspec.results import Measured, Reason, State, Timings
from fogspec.seams import Progress
from fogspec.spec import Application

SIZE_LIMIT = 256 * 2**20
LINE_LIMIT = 64 * 2**10
NAMES_SAID = 5
# Nothing that a second try could change came of these, or nobody had the chance to try.
UNFINISHED = {"quota", "capacity", "interrupted", "budget"}


@dataclass(frozen=True, slots=True)
class Rules:
    """What of a spec decides how timings become a record."""

    warmup: int
    valid: float
    statistic: str
    callback: str | None = None
    metrics: dict[str, str] = field(default_factory=dict)
    scenarios: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def of(application: Application) -> "Rules":
        """The rules of a spec; `metrics` maps each metric to the keyword that the probe writes."""
        spec = application.spec
        return Rules(
            warmup=spec.benchmark.warmup, valid=spec.benchmark.valid, statistic=spec.constraints.statistic,
            callback=spec.probe.callback,
            metrics={name: metric.callback or name for name, metric in spec.metrics.items()},
            scenarios=spec.benchmark.scenarios,
        )  # fmt: skip


@dataclass(slots=True)
class Requests:
    """Requests after warm-up: latencies in seconds and metrics of those that succeeded, and what did not.

    `kinds` has the scenario of each latency; `metrics` are (value, scenario).

    `seen` counts warm-up and failures too. `others` are names that were timed beside the one asked for, in the order they came.
    """

    latencies_s: list[float] = field(default_factory=list)
    kinds: list[str] = field(default_factory=list)
    metrics: dict[str, list[tuple[float, str]]] = field(default_factory=dict)
    seen: int = 0
    failed: int = 0
    unreadable: int = 0
    unweighed: int = 0
    first_failure: str | None = None
    others: list[str] = field(default_factory=list)


def read(path: Path | None, rules: Rules) -> Requests:
    """The requests of a timings file; lines that are no records are counted, never guessed at."""
    requests = Requests()
    for line in _lines(path):
        record = _record(line)
        if record is None:
            requests.unreadable += 1
            continue
        name, latency_s, ok, metrics, reason, kind = record
        if rules.callback is not None and name != rules.callback:
            if name not in requests.others and len(requests.others) < NAMES_SAID:
                requests.others.append(name)
            continue
        requests.seen += 1
        if requests.seen <= rules.warmup:
            continue
        if not ok:
            requests.failed += 1
            requests.first_failure = requests.first_failure or reason
            continue
        if rules.scenarios and kind not in rules.scenarios:
            requests.unweighed += 1
            continue
        requests.latencies_s.append(latency_s)
        requests.kinds.append(kind)
        for metric, key in rules.metrics.items():
            value = metrics.get(key)
            if _number(value):
                requests.metrics.setdefault(metric, []).append((float(value), kind))
    return requests


def judge(requests: Requests, progress: Progress, rules: Rules) -> tuple[State, Reason | None, str | None]:
    """State, reason and detail of a sample that has ended.

    A reason that runner or agent gave stands. Too many failed requests make the sample failed: fast nonsense
    must not win. Then it is the number of valid requests that counts.
    """
    n, failed = len(requests.latencies_s), requests.failed
    if not requests.seen and requests.others and progress.reason in (None, "no_response"):
        named = f"no request named {rules.callback!r} was timed, only {', '.join(map(repr, requests.others))}"
        return "failed", "no_response", f"{named}: compare spec.probe.callback with the workload's calls of start"
    if progress.reason is not None:
        return "failed", progress.reason, progress.detail
    if failed and n < rules.valid * (n + failed):
        why = f": {requests.first_failure}" if requests.first_failure else ""
        return "failed", "check", f"{failed} of {n + failed} requests failed their check{why}"
    if not n and requests.unweighed:
        named = ", ".join(rules.scenarios)
        return "failed", "no_response", f"no request says that it is of a scenario in spec.benchmark.scenarios: {named}"
    if not n:
        return "timeout", None, progress.detail or "no request was answered after warm-up in the time allowed"
    if missing := [name for name in rules.scenarios if name not in requests.kinds]:
        return "insufficient", None, f"no valid request of scenario {', '.join(missing)}"
    if n < NEEDED[rules.statistic]:
        return "insufficient", None, f"{n} requests; {rules.statistic} needs {NEEDED[rules.statistic]}"
    unreadable = f"unreadable lines in the timings: {requests.unreadable}" if requests.unreadable else None
    return "ok", None, progress.detail or unreadable


def measured(sample: Sample, progress: Progress, rules: Rules, duration_s: float, spent_usd: float) -> Measured:
    """The record of a sample that has ended; `timings` is left to whoever keeps the raw file."""
    if progress.recorded is not None:
        fresh = {
            "id": sample.id,
            "machine": sample.machine,
            "duration": duration_s,
            "spent": spent_usd,
            "timings": None,
        }
        return progress.recorded.model_copy(update=fresh)
    requests = read(progress.timings, rules)
    state, reason, detail = judge(requests, progress, rules)
    return Measured.model_construct(
        id=sample.id, machine=sample.machine, measured_on=progress.measured_on, state=state, reason=reason,
        detail=detail, requests=len(requests.latencies_s), failed_requests=requests.failed,
        latency=summary(requests.latencies_s, weights(requests.kinds, rules.scenarios)),
        waited=progress.waited_s if state in ("timeout", "insufficient") else None,
        metrics={name: _average(values, rules.scenarios) for name, values in requests.metrics.items()},
        duration=duration_s, spent=spent_usd,
    )  # fmt: skip


def finished(record: Measured) -> bool:
    """Whether a sample need not be measured again: measured, or failed for a reason of its own."""
    return record.state != "failed" or record.reason not in UNFINISHED


def packed(path: Path) -> bytes:
    """The raw timings compressed, the same bytes for the same content."""
    with open(path, "rb") as file:
        return gzip.compress(file.read(SIZE_LIMIT), compresslevel=6, mtime=0)


def reference(relative: str, content: bytes) -> Timings:
    """How a record names its raw timings."""
    return Timings(path=relative, digest=digest.of_bytes(content))


def _lines(path: Path | None) -> Iterator[bytes]:
    if path is None or not path.is_file():
        return
    read_bytes = 0
    with open(path, "rb") as file:
        # A last line without its end was cut off in the middle of writing: it says nothing.
        while (line := file.readline(LINE_LIMIT)) and read_bytes < SIZE_LIMIT:
            read_bytes += len(line)
            if line.endswith(b"\n"):
                if line.strip():
                    yield line
            elif len(line) == LINE_LIMIT:
                yield b""


def _record(line: bytes) -> tuple[str, float, bool, dict[str, object], str | None, str] | None:
    try:
        entry = json.loads(line)
        latency_s, ok = entry["latency_s"], entry["ok"]
        metrics, reason = entry.get("metrics") or {}, entry.get("reason")
        sound = _number(latency_s) and latency_s >= 0 and isinstance(ok, bool) and isinstance(metrics, dict)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None
    if not sound:
        return None
    text = "".join(c for c in reason if c.isprintable())[:200] if isinstance(reason, str) else None
    return str(entry.get("name", "")), float(latency_s), ok, metrics, text, str(entry.get("scenario") or "")


def _number(value: object) -> TypeGuard[float]:
    # JSON's integers have no largest one, floats have.
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _average(values: Sequence[tuple[float, str]], scenarios: Mapping[str, float]) -> float:
    shares = weights([kind for _, kind in values], scenarios)
    return math.fsum(value * share for (value, _), share in zip(values, shares, strict=True))
