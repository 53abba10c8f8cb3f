"""The parser of timings files, from records of a probe to requests. The files come from other machines and are untrusted."""

import json
import sys
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, TypeGuard

from fogspec.base.files import open_untrusted
from fogspec.base.units import format_duration
from fogspec.results.join import VERDICT, Request, Value, join
from fogspec.spec.probe import name_of
from fogspec.spec.schema import Application

SIZE_LIMIT = 256 * 2**20
LINE_LIMIT = 64 * 2**10
LINES_LIMIT = 1_000_000
OTHER_NAMES = 5
OTHER = {"unmatched", "note", "warning"}


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordRules:
    """The parts of a spec that decide how timings become a record; `metrics` maps each metric to the probe's keyword."""

    warmup: int
    valid: float
    statistic: str
    callback: str | None = None
    metrics: dict[str, str] = field(default_factory=dict)
    timeout_s: float | None = None
    scenarios: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def of(application: Application) -> "RecordRules":
        """Return the rules of a spec."""
        spec = application.spec
        return RecordRules(
            warmup=spec.benchmark.warmup,
            valid=spec.benchmark.min_success_rate,
            statistic=spec.constraints.statistic,
            callback=name_of(spec.probe),
            timeout_s=spec.probe.timeout,
            metrics={name: metric.callback or name for name, metric in spec.metrics.items()},
            scenarios=spec.benchmark.scenarios,
        )


@dataclass(slots=True, kw_only=True)
class Requests:
    """Requests after warm-up: latencies in seconds and metrics of the successful ones, and counts of the others.

    `scenarios` has the scenario of each latency; `metrics` are (value, scenario). `service_times_s` are the times that the
    node worked, if the probe reports them. `lost` requests, which got no response, are among the failed ones; `unmatched`
    are responses without a request. `seen` counts warm-up and failures too, and `finished` has all of them. `other_names` are
    names that were timed besides the one in the spec, in the order they came.
    """

    latencies_s: list[float] = field(default_factory=list)
    service_times_s: list[float] = field(default_factory=list)
    scenarios: list[str] = field(default_factory=list)
    metrics: dict[str, list[tuple[float, str]]] = field(default_factory=dict)
    seen: int = 0
    failed: int = 0
    unreadable: int = 0
    unweighted: int = 0
    lost: int = 0
    unmatched: int = 0
    warning: str | None = None
    first_failure: str | None = None
    other_names: list[str] = field(default_factory=list)
    finished: Sequence[Request] = ()


def read_requests(path: Path | None, rules: RecordRules) -> Requests:
    """Return the requests of a timings file; none if it is not a plain file."""
    if path is None or path.is_symlink() or not path.is_file():
        return Requests()
    with open_untrusted(path) as file:
        return parse_requests(file, rules)


def parse_requests(file: BinaryIO, rules: RecordRules) -> Requests:
    """Return the requests of an open timings file; lines that are not records are counted, never guessed at."""
    requests, found, values = Requests(), list[Request](), list[Value]()
    wanted = {VERDICT, *rules.metrics.values()}
    for line in _lines(file):
        if line is None:
            requests.warning = f"only the first {LINES_LIMIT:,} lines of the timings were read"
            break
        entry = _entry(line, wanted)
        if isinstance(entry, Value):
            values.append(entry)
        elif isinstance(entry, Request):
            _add(entry, rules, requests, found)
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


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a JSON value is a number that fits a float."""
    # JSON's integers have no largest one, floats have.
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _add(one: Request, rules: RecordRules, requests: Requests, found: list[Request]) -> None:
    """Keep a request of the spec's probe, and the name of any other."""
    if rules.callback is None or one.name == rules.callback:
        requests.seen += 1
        found.append(one)
    elif one.name not in requests.other_names and len(requests.other_names) < OTHER_NAMES:
        requests.other_names.append(one.name)


def _count(one: Request, rules: RecordRules, requests: Requests) -> None:
    late = one.ok and rules.timeout_s is not None and one.latency_s > rules.timeout_s
    if late or not one.ok:
        requests.failed += 1
        requests.lost += one.lost
        reason = f"took longer than {format_duration(rules.timeout_s or 0.0)}" if late else one.reason
        requests.first_failure = requests.first_failure or reason
    elif rules.scenarios and one.scenario not in rules.scenarios:
        requests.unweighted += 1
    else:
        requests.latencies_s.append(one.latency_s)
        requests.scenarios.append(one.scenario)
        if one.service_s is not None:
            requests.service_times_s.append(one.service_s)
        for metric, key in rules.metrics.items():
            value = one.metrics.get(key)
            if is_number(value):
                requests.metrics.setdefault(metric, []).append((float(value), one.scenario))


def _lines(file: BinaryIO) -> Iterator[bytes | None]:
    """Yield the lines that are not blank, an empty one in place of each that is too long, and None at the limits."""
    read_bytes = lines = 0
    # A last line without its end was cut off in the middle of a write.
    while line := file.readline(LINE_LIMIT):
        read_bytes, lines = read_bytes + len(line), lines + 1
        if read_bytes > SIZE_LIMIT or lines > LINES_LIMIT:
            yield None
            return
        if line.endswith(b"\n"):
            if line.strip():
                yield line
        elif len(line) == LINE_LIMIT:
            yield b""


def _entry(line: bytes, wanted: Set[str]) -> Request | Value | dict[str, object] | None:
    """Return a request, values of metrics, or another entry of a probe; None if the line is not a record.

    Of the metrics, only the `wanted` ones are kept.
    """
    try:
        entry = json.loads(line)
        if "metric" in entry:
            sound = isinstance(entry["metric"], dict) and is_number(entry["at_s"])
            return (
                Value(_only(wanted, entry["metric"]), float(entry["at_s"]), _stamp(entry.get("stamp")))
                if sound
                else None
            )
        if OTHER & entry.keys():
            return dict(entry)
        latency_s, ok = entry["latency_s"], entry["ok"]
        metrics, start_s, service_s = entry.get("metrics") or {}, entry.get("start_s"), entry.get("service_s")
        sound = is_number(latency_s) and latency_s >= 0 and isinstance(ok, bool) and isinstance(metrics, dict)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None
    if not sound:
        return None
    return Request(
        name=str(entry.get("name", "")),
        latency_s=float(latency_s),
        ok=ok,
        metrics=_only(wanted, metrics),
        reason=_text(entry.get("reason")),
        scenario=str(entry.get("scenario") or ""),
        start_s=float(start_s) if is_number(start_s) else None,
        service_s=float(service_s) if is_number(service_s) and service_s >= 0 else None,
        lost=entry.get("lost") is True,
        stamp=_stamp(entry.get("stamp")),
    )


def _only(wanted: Set[str], metrics: dict[str, object]) -> dict[str, object]:
    """Return the wanted metrics; a value that is neither a number nor a text is none."""
    return {name: value for name, value in metrics.items() if name in wanted and isinstance(value, (int, float, str))}


def _text(value: object) -> str | None:
    return "".join(c for c in value if c.isprintable())[:200] if isinstance(value, str) else None


def _stamp(value: object) -> tuple[int, int] | None:
    if isinstance(value, list) and len(value) == 2 and all(isinstance(part, int) for part in value):
        return value[0], value[1]
    return None
