"""The parser of timings files, from records of a probe to requests. The files come from other machines and are untrusted."""

import json
import math
import sys
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeGuard

from fogspec.agent.stopping import NOT_REQUESTS, WarmUp
from fogspec.base.files import open_untrusted
from fogspec.base.quantities import Bounds
from fogspec.base.units import UnitError, shown_duration
from fogspec.language.probe import name_of
from fogspec.language.schema import Application
from fogspec.results.account import Account, Balance
from fogspec.results.join import VERDICT, Request, Value, join
from fogspec.results.ranges import CLOCK_S, COUNT, METRIC, REQUEST_S, SIZE_LIMIT

LINE_LIMIT = 64 * 2**10
LINES_LIMIT = 1_000_000
OTHER_NAMES = 5
OTHER = NOT_REQUESTS - {"metric"}


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordRules:
    """The parts of a spec that decide how timings become a record; `metrics` maps each metric to the probe's keyword.

    Without a `workload`, all that runs is the application.
    """

    warmup: int
    valid: float
    statistic: str
    callback: str | None = None
    metrics: dict[str, str] = field(default_factory=dict)
    timeout_s: float | None = None
    scenarios: dict[str, float] = field(default_factory=dict)
    workload: bool = False

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
            workload=spec.benchmark.workload.bag is not None or spec.benchmark.workload.node is not None,
        )


class Span(NamedTuple):
    """When a request began, None where it is not known, and for how long it was open; `valid` ones are latencies.

    `waited` ones count in percentiles: they are valid, or late.
    """

    start_s: float | None
    open_s: float
    scenario: str = ""
    valid: bool = True
    waited: bool = True


@dataclass(slots=True, kw_only=True)
class Requests:
    """Requests after warm-up: latencies in seconds and metrics of the successful ones, and counts of the others.

    `scenarios` has the scenario of each latency; `metrics` are (value, scenario). `waits_s` are (latency, scenario) of these
    and of the late ones, which are among the failed ones and took at least so long: percentiles are of them.
    `service_times_s` are the times that the node worked, if the probe reports them. `lost` requests, which got no response, are
    among the failed ones; `unmatched` are responses without a request. `out_of_range` tells of the first figure that is out of
    its range (`fogspec.results.ranges`). `seen` counts warm-up and failures too, and `finished` has all of them. `other_names`
    are names that were timed besides the one in the spec, in the order they came. For `open_s` at least one request was open,
    failed or not.

    Of the starts that `fogspec_probe` writes: `balance` has the lost ones, which are among the failed, and those under way when
    the timings end, whose time so far is among the latencies; `strays` of the unmatched ends have no start, for the reason
    `first_stray`.
    `missed` are, by topic, the messages that the probe did not hear, and all that were sent meanwhile.
    `commands` have the latencies by the command of the spec that timed them; `cold` are requests within the warm-up of one of
    the `processes`. `spans` are those after it, in the order they came.
    """

    latencies_s: list[float] = field(default_factory=list)
    service_times_s: list[float] = field(default_factory=list)
    scenarios: list[str] = field(default_factory=list)
    waits_s: list[tuple[float, str]] = field(default_factory=list)
    metrics: dict[str, list[tuple[float, str]]] = field(default_factory=dict)
    open_s: float = 0.0
    seen: int = 0
    failed: int = 0
    unreadable: int = 0
    unweighted: int = 0
    lost: int = 0
    unmatched: int = 0
    balance: Balance = field(default_factory=Balance)
    strays: int = 0
    first_stray: str | None = None
    missed: dict[str, tuple[int, int]] = field(default_factory=dict)
    cold: int = 0
    processes: int = 0
    commands: dict[str, list[float]] = field(default_factory=dict)
    out_of_range: str | None = None
    warning: str | None = None
    first_failure: str | None = None
    other_names: list[str] = field(default_factory=list)
    finished: Sequence[Request] = ()
    spans: list[Span] = field(default_factory=list)

    def busy_s(self, mean_s: float) -> float:
        """Return the time in which at least one request was open, for each of one or more latencies of this (weighted) mean."""
        whole_s = math.fsum(self.latencies_s)
        return mean_s * self.open_s / whole_s if whole_s else 0.0


def read_requests(path: Path | None, rules: RecordRules) -> Requests:
    """Return the requests of a timings file; none if it is not a plain file."""
    if path is None:
        return Requests()
    try:
        with open_untrusted(path) as file:
            return parse_requests(file, rules)
    except OSError:
        return Requests()


def parse_requests(file: BinaryIO, rules: RecordRules, until_s: float | None = None) -> Requests:
    """Return the requests of an open timings file; lines that are not records are counted, never guessed at.

    `until_s` is when the file was read, by its own clock; without it, the moment of its last line.
    """
    requests, found, values, account = Requests(), list[Request](), list[Value](), Account()
    if until_s is not None:
        account.until_s = until_s
    wanted = {VERDICT, *rules.metrics.values()}
    for number, line in enumerate(_lines(file), 1):
        if line is None:
            requests.warning = f"only the first {LINES_LIMIT:,} lines of the timings were read"
            break
        try:
            entry = _entry(line, wanted)
        except UnitError as wrong:
            requests.out_of_range = requests.out_of_range or f"line {number} of its timings: {wrong}"
            continue
        if isinstance(entry, Value):
            values.append(entry)
        elif isinstance(entry, Request):
            _add(entry, rules, requests, found, account)
        elif entry is None:
            requests.unreadable += 1
        else:
            _look(entry, rules, requests, account)
    join(found, values)
    requests.finished = found
    warmup = WarmUp(rules.warmup)
    warm = [one for one in found if warmup.over(one.process)]
    for one in warm:
        _count(one, rules, requests, account.command(one))
    requests.cold = len(found) - len(warm)
    requests.processes = len(warmup.finished)
    for command in account.commands():
        requests.commands.setdefault(command, [])
    _settle(account, rules, requests)
    kindless = not rules.scenarios
    requests.spans += [
        Span(account.until_s - age_s, age_s, valid=kindless, waited=kindless) for age_s in requests.balance.under_way_s
    ]
    if all(one.start_s is not None for one in requests.spans):
        requests.spans.sort(key=lambda one: one.start_s or 0.0)
    requests.open_s = _open_s([(one.start_s, one.open_s) for one in requests.spans])
    return requests


def _open_s(spans: Sequence[tuple[float | None, float]]) -> float:
    """Return for how long at least one of these (start, duration) was open; those of unknown start one after the other."""
    until_s, found = -math.inf, [duration_s for start_s, duration_s in spans if start_s is None]
    for start_s, duration_s in sorted((start_s, duration_s) for start_s, duration_s in spans if start_s is not None):
        if start_s >= until_s:
            found.append(duration_s)
        elif start_s + duration_s > until_s:
            found.append(start_s + duration_s - until_s)
        until_s = max(until_s, start_s + duration_s)
    return math.fsum(found)


def _look(entry: dict[str, object], rules: RecordRules, requests: Requests, account: Account) -> None:
    """Take an entry that is not a request: a start, an end without one, or a warning."""
    requests.warning = _text(entry.get("warning")) or requests.warning
    number, name = entry.get("number"), entry.get("name", entry.get("open"))
    if "unmatched" in entry:
        requests.unmatched += 1
        if "process" in entry and rules.callback == name:
            requests.strays += 1
            requests.first_stray = requests.first_stray or _text(entry.get("reason"))
    elif "missed" in entry:
        topic, missed, sent = _text(entry.get("topic")), entry["missed"], entry.get("sent")
        if (
            topic
            and _is_count(missed)
            and _is_count(sent)
            and (topic in requests.missed or len(requests.missed) < OTHER_NAMES)
        ):
            requests.missed[topic] = missed, sent
    elif "open" in entry and rules.callback == name and _is_count(number):
        start_s = _in_range("start_s", entry.get("start_s"), CLOCK_S)
        if start_s is not None:
            account.start(_text(entry.get("process")) or "", number, start_s, _text(entry.get("command")) or "")


def _settle(account: Account, rules: RecordRules, requests: Requests) -> None:
    """Count what was started and has not ended: a request that never ends has failed, one under way takes at least so long.

    Beside none that counts it is not known how long one may take.
    """
    if not requests.latencies_s and not requests.failed:
        return
    balance = account.balance(requests.finished, rules.warmup, rules.timeout_s)
    requests.balance = balance
    requests.failed += balance.lost
    requests.lost += balance.lost
    if balance.lost:
        requests.first_failure = requests.first_failure or "it was started and never ended"
    if not rules.scenarios:  # its kind is known when it ends
        requests.latencies_s += balance.under_way_s
        requests.scenarios += [""] * len(balance.under_way_s)
        requests.waits_s += [(age_s, "") for age_s in balance.under_way_s]


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a JSON value is a number; Python reads NaN and infinities as such too."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _is_count(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= COUNT.most


def _in_range(name: str, value: object, bounds: Bounds) -> float | None:
    """Return the number, None if it is none; raise UnitError if it is out of range."""
    if not is_number(value):
        return None
    try:
        return float(bounds.check(value))
    except UnitError as wrong:
        raise UnitError(f"{name} {wrong}") from None


def _add(one: Request, rules: RecordRules, requests: Requests, found: list[Request], account: Account) -> None:
    """Keep a request of the spec's probe, and the name of any other."""
    if rules.callback is None or one.name == rules.callback:
        requests.seen += 1
        found.append(one)
        if rules.callback is not None:
            account.end(one)
    elif one.name not in requests.other_names and len(requests.other_names) < OTHER_NAMES:
        requests.other_names.append(one.name)


def _count(one: Request, rules: RecordRules, requests: Requests, command: str) -> None:
    late, weighs = one.ok and rules.timeout_s is not None and one.latency_s > rules.timeout_s, _has_weight(one, rules)
    valid, wait_s = one.ok and weighs and not late, _wait_s(one, rules)
    waited = valid or ((late or one.lost) and weighs and wait_s > 0)
    if weighs or not one.ok:
        requests.spans.append(Span(one.start_s, wait_s, one.scenario, valid, waited))
    if waited:
        requests.waits_s.append((wait_s, one.scenario))
    if late or not one.ok:
        requests.failed += 1
        requests.lost += one.lost
        reason = f"took longer than {shown_duration(rules.timeout_s or 0.0)}" if late else one.reason
        requests.first_failure = requests.first_failure or reason
    elif not valid:
        requests.unweighted += 1
    else:
        requests.latencies_s.append(one.latency_s)
        requests.scenarios.append(one.scenario)
        if command:
            requests.commands.setdefault(command, []).append(one.latency_s)
        if one.service_s is not None:
            requests.service_times_s.append(one.service_s)
        for metric, key in rules.metrics.items():
            try:
                value = _in_range(f"metric {metric}", one.metrics.get(key), METRIC)
            except UnitError as wrong:
                requests.out_of_range = requests.out_of_range or str(wrong)
                continue
            if value is not None:
                requests.metrics.setdefault(metric, []).append((value, one.scenario))


def _wait_s(one: Request, rules: RecordRules) -> float:
    """Return for how long a request was open, at least: one without a response, for the time in which it is waited for."""
    return max(one.latency_s, rules.timeout_s or 0.0) if one.lost else one.latency_s


def _has_weight(one: Request, rules: RecordRules) -> bool:
    return not rules.scenarios or one.scenario in rules.scenarios


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

    Of the metrics, only the `wanted` ones are kept. Raise UnitError for a time that is out of range.
    """
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(entry, dict):
        return None
    if "metric" in entry:
        at_s = _in_range("at_s", entry.get("at_s"), CLOCK_S)
        if at_s is None or not isinstance(entry["metric"], dict):
            return None
        return Value(_only(wanted, entry["metric"]), at_s, _stamp(entry.get("stamp")))
    if OTHER & entry.keys():
        return entry
    latency_s, ok = _in_range("latency_s", entry.get("latency_s"), REQUEST_S), entry.get("ok")
    metrics = entry.get("metrics") or {}
    if latency_s is None or not isinstance(ok, bool) or not isinstance(metrics, dict):
        return None
    return Request(
        name=_text(entry.get("name")) or "",
        latency_s=latency_s,
        ok=ok,
        metrics=_only(wanted, metrics),
        reason=_text(entry.get("reason")),
        scenario=_text(entry.get("scenario")) or "",
        start_s=_in_range("start_s", entry.get("start_s"), CLOCK_S),
        service_s=_in_range("service_s", entry.get("service_s"), REQUEST_S),
        lost=entry.get("lost") is True,
        stamp=_stamp(entry.get("stamp")),
        process=_text(entry.get("process")) or "",
        number=number if _is_count(number := entry.get("number")) else None,
        above=above if _is_count(above := entry.get("above")) else None,
    )


def _only(wanted: Set[str], metrics: dict[str, object]) -> dict[str, object]:
    """Return the wanted metrics; a value that is neither a number nor a text is none."""
    return {name: value for name, value in metrics.items() if name in wanted and isinstance(value, (int, float, str))}


def _text(value: object) -> str | None:
    """Return a text for people, None if it is not a string; equal ones of a million records are one object."""
    if not isinstance(value, str):
        return None
    text = value[:200]
    return sys.intern(text if text.isprintable() else "".join(c for c in text if c.isprintable()))


def _stamp(value: object) -> tuple[int, int] | None:
    if isinstance(value, list) and len(value) == 2 and all(isinstance(part, int) for part in value):
        return value[0], value[1]
    return None
