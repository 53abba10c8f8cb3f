"""From a sample's raw timings to its record. The file came from another machine: nothing in it is trusted."""

import errno
import gzip
import io
import json
import math
import os
import stat
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, TypeGuard, get_args

from fogspec.backends.protocol import Progress
from fogspec.base import digest
from fogspec.base.units import format_duration
from fogspec.plan.schema import Sample
from fogspec.results.hangs import detect_hang
from fogspec.results.join import Request, Value, join
from fogspec.results.schema import LatencySummary, Measured, Reason, State, StoppedBy, Timings
from fogspec.results.statistics import NEEDED, summary, weights
from fogspec.spec.probe import name_of
from fogspec.spec.schema import Application

SIZE_LIMIT = 256 * 2**20
LINE_LIMIT = 64 * 2**10
DETAIL_LIMIT = 1000
NAMES_SAID = 5
OTHER = {"unmatched", "note", "warning"}
WAITED = 1.5


@dataclass(frozen=True, slots=True)
class Rules:
    """What of a spec decides how timings become a record."""

    warmup: int
    valid: float
    statistic: str
    callback: str | None = None
    metrics: dict[str, str] = field(default_factory=dict)
    timeout_s: float | None = None
    scenarios: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def of(application: Application) -> "Rules":
        """The rules of a spec; `metrics` maps each metric to the keyword that the probe writes."""
        spec = application.spec
        return Rules(
            warmup=spec.benchmark.warmup, valid=spec.benchmark.min_success_rate, statistic=spec.constraints.statistic,
            callback=name_of(spec.probe), timeout_s=spec.probe.timeout,
            metrics={name: metric.callback or name for name, metric in spec.metrics.items()},
            scenarios=spec.benchmark.scenarios,
        )  # fmt: skip


@dataclass(slots=True)
class Requests:
    """Requests after warm-up: latencies in seconds and metrics of those that succeeded, and what did not.

    `kinds` has the scenario of each latency; `metrics` are (value, scenario). `services_s` are the times that the node
    worked, where the probe tells them. `lost` requests, which got no response, are among those that failed; `unmatched` are
    responses that belong to no request. `seen` counts warm-up and failures too, and `finished` has them all. `others` are
    names that were timed beside the one asked for, in the order they came.
    """

    latencies_s: list[float] = field(default_factory=list)
    services_s: list[float] = field(default_factory=list)
    kinds: list[str] = field(default_factory=list)
    metrics: dict[str, list[tuple[float, str]]] = field(default_factory=dict)
    seen: int = 0
    failed: int = 0
    unreadable: int = 0
    unweighed: int = 0
    lost: int = 0
    unmatched: int = 0
    warning: str | None = None
    first_failure: str | None = None
    others: list[str] = field(default_factory=list)
    finished: Sequence[Request] = ()


def read(source: Path | bytes | None, rules: Rules) -> Requests:
    """The requests of a timings file, or of its content; lines that are no records are counted, never guessed at."""
    requests, found, values = Requests(), list[Request](), list[Value]()
    for line in _lines(source):
        entry = _entry(line)
        if isinstance(entry, Value):
            values.append(entry)
        elif isinstance(entry, Request):
            _ours(entry, rules, requests, found)
        elif entry is None:
            requests.unreadable += 1
        else:
            requests.unmatched += "unmatched" in entry
            requests.warning = _text(entry.get("warning")) or requests.warning
    join(found, values)
    requests.finished = found
    for one in found[rules.warmup :]:
        _count(one, rules, requests)
    return requests


def _ours(one: Request, rules: Rules, requests: Requests, found: list[Request]) -> None:
    if rules.callback is None or one.name == rules.callback:
        requests.seen += 1
        found.append(one)
    elif one.name not in requests.others and len(requests.others) < NAMES_SAID:
        requests.others.append(one.name)


def _count(one: Request, rules: Rules, requests: Requests) -> None:
    late = one.ok and rules.timeout_s is not None and one.latency_s > rules.timeout_s
    if late or not one.ok:
        requests.failed += 1
        requests.lost += one.lost
        reason = f"took longer than {format_duration(rules.timeout_s or 0.0)}" if late else one.reason
        requests.first_failure = requests.first_failure or reason
    elif rules.scenarios and one.scenario not in rules.scenarios:
        requests.unweighed += 1
    else:
        requests.latencies_s.append(one.latency_s)
        requests.kinds.append(one.scenario)
        if one.service_s is not None:
            requests.services_s.append(one.service_s)
        for metric, key in rules.metrics.items():
            value = one.metrics.get(key)
            if _number(value):
                requests.metrics.setdefault(metric, []).append((float(value), one.scenario))


def classify(requests: Requests, progress: Progress, rules: Rules) -> tuple[State, Reason | None, str | None]:
    """State, reason and detail of a sample that has ended.

    A reason that runner or agent gave stands. Too many failed requests make the sample failed: fast nonsense
    must not win. Then it is the number of valid requests that counts.
    """
    n, failed = len(requests.latencies_s), requests.failed
    if not requests.seen and requests.others and progress.reason in (None, "no_response"):
        named = f"no request named {rules.callback!r} was timed, only {', '.join(map(repr, requests.others))}"
        return "failed", "no_response", f"{named}: compare spec.probe with what the workload times"
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
    hangs, tolerable = detect_hang(requests.finished, progress.waited_s, rules.timeout_s, rules.valid)
    if not tolerable:
        return "failed", "no_response", hangs
    if n < NEEDED[rules.statistic]:
        return "insufficient", None, f"{n} requests; {rules.statistic} needs {NEEDED[rules.statistic]}"
    return "ok", None, "; ".join(filter(None, [progress.detail, hangs, *_remarks(requests)])) or None


def _remarks(requests: Requests) -> Iterator[str | None]:
    """What a reader of good figures should know about them."""
    yield f"unreadable lines in the timings: {requests.unreadable}" if requests.unreadable else None
    yield requests.warning
    yield f"responses that belong to no request: {requests.unmatched}" if requests.unmatched else None
    n = len(requests.services_s)
    if n and n == len(requests.latencies_s):
        latency_s, service_s = math.fsum(requests.latencies_s) / n, math.fsum(requests.services_s) / n
        if latency_s > WAITED * service_s:
            took, worked = format_duration(latency_s), format_duration(service_s)
            yield f"requests waited for one another: of {took} on average the node worked {worked}"


def make_record(sample: Sample, progress: Progress, rules: Rules, duration_s: float, spent_usd: float) -> Measured:
    """The record of a sample that has ended; `timings` is left to whoever keeps the raw file."""
    if progress.recorded is not None:
        fresh = {"id": sample.id, "machine": sample.machine, "duration": duration_s, "spent": spent_usd}
        return progress.recorded.model_copy(update={**fresh, "timings": None})
    requests = read(progress.timings, rules)
    state, reason, detail = classify(requests, progress, rules)
    stopped_by: Any = progress.stopped_by if progress.stopped_by in get_args(StoppedBy) else None
    return Measured.model_construct(
        id=sample.id, machine=sample.machine, measured_on=plain(progress.measured_on), state=state, reason=reason,
        detail=None if detail is None else plain(detail), stopped_by=stopped_by,
        setup=progress.setup_s, measuring=progress.measured_s,
        requests=len(requests.latencies_s), failed_requests=requests.failed,
        latency=summary(requests.latencies_s, weights(requests.kinds, rules.scenarios)),
        service=_service(requests, rules), lost=requests.lost or None, unmatched=requests.unmatched or None,
        latency_lower_bound=progress.waited_s if state in ("timeout", "insufficient") else None,
        metrics={name: _average(values, rules.scenarios) for name, values in requests.metrics.items()},
        duration=duration_s, spent=spent_usd,
    )  # fmt: skip


def plain(text: str) -> str:
    """What a machine said, without what would speak to a terminal, and not too much of it."""
    return "".join(c if c.isprintable() else " " for c in text[:DETAIL_LIMIT]).strip()


def within_attempt(progress: Progress, folder: Path) -> Progress:
    """The progress without timings that lie outside its attempt's folder, wherever a link in their path may lead."""
    path = progress.timings
    if path is None or path.resolve().is_relative_to(folder.resolve()):
        return progress
    return replace(progress, timings=None, detail="its timings are not where they belong, and were not read")


def compress(path: Path, redact: Callable[[str], str] = lambda text: text) -> bytes:
    """The raw timings compressed, the same bytes for the same content; secrets' values are taken out."""
    with opened(path) as file:
        content = file.read(SIZE_LIMIT)
    text = content.decode("utf-8", "surrogateescape")
    return gzip.compress(redact(text).encode("utf-8", "surrogateescape"), compresslevel=6, mtime=0)


def opened(path: Path) -> BinaryIO:
    """A file that came from a sample, to read; OSError for anything but a plain file: links lead elsewhere, pipes block."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "not a plain file", str(path))
    return os.fdopen(descriptor, "rb")


def timings_reference(relative: str, content: bytes) -> Timings:
    """How a record names its raw timings."""
    return Timings(path=relative, digest=digest.of_bytes(content))


def _lines(source: Path | bytes | None) -> Iterator[bytes]:
    if source is None or (isinstance(source, Path) and (source.is_symlink() or not source.is_file())):
        return
    read_bytes = 0
    with opened(source) if isinstance(source, Path) else io.BytesIO(source) as file:
        # A last line without its end was cut off in the middle of writing: it says nothing.
        while (line := file.readline(LINE_LIMIT)) and read_bytes < SIZE_LIMIT:
            read_bytes += len(line)
            if line.endswith(b"\n"):
                if line.strip():
                    yield line
            elif len(line) == LINE_LIMIT:
                yield b""


def _service(requests: Requests, rules: Rules) -> LatencySummary | None:
    """None where not every request tells how long the node worked."""
    if len(requests.services_s) != len(requests.latencies_s):
        return None
    return summary(requests.services_s, weights(requests.kinds, rules.scenarios))


def _entry(line: bytes) -> Request | Value | dict[str, object] | None:
    """A request, values of metrics, or what else a probe said; None for what is no record."""
    try:
        entry = json.loads(line)
        if "metric" in entry:
            sound = isinstance(entry["metric"], dict) and _number(entry["at_s"])
            return Value(entry["metric"], float(entry["at_s"]), _stamp(entry.get("stamp"))) if sound else None
        if OTHER & entry.keys():
            return dict(entry)
        latency_s, ok = entry["latency_s"], entry["ok"]
        metrics, start_s, service_s = entry.get("metrics") or {}, entry.get("start_s"), entry.get("service_s")
        sound = _number(latency_s) and latency_s >= 0 and isinstance(ok, bool) and isinstance(metrics, dict)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None
    if not sound:
        return None
    return Request(
        name=str(entry.get("name", "")), latency_s=float(latency_s), ok=ok, metrics=metrics,
        reason=_text(entry.get("reason")), scenario=str(entry.get("scenario") or ""),
        start_s=float(start_s) if _number(start_s) else None,
        service_s=float(service_s) if _number(service_s) and service_s >= 0 else None,
        lost=entry.get("lost") is True, stamp=_stamp(entry.get("stamp")),
    )  # fmt: skip


def _text(value: object) -> str | None:
    return "".join(c for c in value if c.isprintable())[:200] if isinstance(value, str) else None


def _stamp(value: object) -> tuple[int, int] | None:
    if isinstance(value, list) and len(value) == 2 and all(isinstance(part, int) for part in value):
        return value[0], value[1]
    return None


def _number(value: object) -> TypeGuard[float]:
    # JSON's integers have no largest one, floats have.
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _average(values: Sequence[tuple[float, str]], scenarios: Mapping[str, float]) -> float:
    shares = weights([kind for _, kind in values], scenarios)
    return math.fsum(value * share for (value, _), share in zip(values, shares, strict=True))
