"""The record of a sample that has ended: its classification, statistics and packed timings."""

import gzip
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

from pydantic import ValidationError

from fogspec.backends.protocol import SampleStatus
from fogspec.base.files import open_untrusted
from fogspec.base.redaction import known
from fogspec.base.units import shown, shown_duration
from fogspec.plan.schema import Sample
from fogspec.results import ranges
from fogspec.results.hangs import detect_hang
from fogspec.results.ranges import SIZE_LIMIT
from fogspec.results.requests import RecordRules, Requests, read_requests
from fogspec.results.resources import between_s
from fogspec.results.schema import LatencySummary, Measured, Reason, State, StoppedBy
from fogspec.results.statistics import NEEDED, errors_of, latency_of, metric_of, paid_s, summary, unsteady, weights

DETAIL_LIMIT = 1000
WAITED = 1.5
UNMATCHED = 0.2  # responses to a request, beyond which it is not known which of them answer
MOST_CPUS = 1.1  # of its own that a sample may seem to use


def make_record(
    sample: Sample, status: SampleStatus, rules: RecordRules, duration_s: float, spent_usd: float
) -> Measured:
    """Return the record of a sample that has ended, without a reference to its raw timings.

    Everything in it that its machine sent is in the ranges of the schema; a figure that is not fails the sample. Whatever a
    machine sends, its sample gets a record: what it cost is paid.
    """
    paid = {
        "id": sample.id,
        "machine": sample.machine,
        "duration": min(duration_s, ranges.TIME_S.most),
        "spent": spent_usd,
    }
    if status.recorded is not None:
        return status.recorded.model_copy(update={**paid, "timings": None})
    requests = read_requests(status.timings, rules)
    counts = {"requests": len(requests.latencies_s), "failed_requests": requests.failed}
    measured_on = printable(status.measured_on)
    try:
        return Measured(**paid, **counts, measured_on=measured_on, **_figures(requests, status, rules))
    except (ArithmeticError, ValidationError) as wrong:
        failed: Any = {"state": "failed", "reason": "out_of_range", "detail": printable(_fault(wrong))}
        return Measured(**paid, **counts, measured_on=measured_on, **failed)


def _fault(wrong: ArithmeticError | ValidationError) -> str:
    """Return which figure cannot be taken, and why."""
    if isinstance(wrong, ArithmeticError):
        return f"its figures cannot be computed with: {wrong}"
    first = wrong.errors()[0]
    why = first.get("ctx", {}).get("error") or first["msg"]
    return f"its {' '.join(str(part) for part in first['loc'])} {why}"


def _figures(requests: Requests, status: SampleStatus, rules: RecordRules) -> dict[str, Any]:
    """Return the fields of a record that follow from what the machine sent."""
    state, reason, detail = classify(requests, status, rules)
    latency = latency_of(requests, rules.scenarios)
    metrics = {name: metric_of(values, rules.scenarios) for name, values in requests.metrics.items()}
    return {
        "state": state,
        "reason": reason,
        "detail": None if detail is None else printable(detail),
        "stopped_by": status.stopped_by if status.stopped_by in get_args(StoppedBy) else None,
        "setup": status.setup_s,
        "measuring": status.measured_s,
        "latency": latency,
        "errors": None if latency is None else errors_of(requests, rules.scenarios),
        "busy": None if latency is None else paid_s(requests, latency.mean, status.resources, rules),
        "service": _service(requests, rules),
        "lost": requests.lost or None,
        "unmatched": requests.unmatched or None,
        "latency_lower_bound": status.waited_s if state in ("timeout", "insufficient") else None,
        "metrics": {name: mean for name, (mean, _) in metrics.items()},
        "metric_errors": {name: error for name, (_, error) in metrics.items() if error <= ranges.ERROR.most},
        "server": status.server,
        "resources": status.resources,
    }


def classify(requests: Requests, status: SampleStatus, rules: RecordRules) -> tuple[State, Reason | None, str | None]:
    """Return state, reason and detail of a sample that has ended.

    A reason of the backend or the agent stands. Too many failed requests make the sample failed: fast nonsense
    must not win. After that the number of valid requests decides.
    """
    n, failed = len(requests.latencies_s), requests.failed
    if not requests.seen and requests.other_names and status.reason in (None, "no_response"):
        timed = ", ".join(map(repr, requests.other_names))
        named = f"no request named {rules.callback!r} was timed, only {timed}"
        return "failed", "not_reported", f"{named}: compare spec.probe with what the workload times"
    if status.reason is not None:
        return "failed", status.reason, status.detail
    if (beyond := requests.out_of_range or _escaped(status)) is not None:
        return "failed", "out_of_range", beyond
    unheard = _unheard(requests, rules)
    if not unheard and failed and n < rules.valid * (n + failed):
        return "failed", "check", _failures(requests, rules)
    if (wrong := unheard or _unclear(requests, rules)) is not None:
        return "failed", "not_reported", wrong
    if not n and requests.unweighted:
        named = ", ".join(rules.scenarios)
        return "failed", "no_response", f"no request says that it is of a scenario in spec.benchmark.scenarios: {named}"
    if not n:
        return "timeout", None, status.detail or _nothing(requests, rules)
    if missing := [name for name in rules.scenarios if name not in requests.scenarios]:
        return "insufficient", None, f"no valid request of scenario {', '.join(missing)}"
    hangs, tolerable = detect_hang(requests.finished, status.waited_s, rules.timeout_s, rules.valid)
    if not tolerable:
        return "failed", "no_response", hangs
    if n < NEEDED[rules.statistic]:
        return "insufficient", None, f"{n} requests; {rules.statistic} needs {NEEDED[rules.statistic]}"
    if not max(requests.latencies_s) >= ranges.LATENCY_S.least:
        return "failed", "out_of_range", f"no request took a nanosecond: {n} latencies of 0 s are none"
    about = [
        status.detail,
        hangs,
        *_caveats(requests),
        *unsteady(requests.latencies_s),
        _between(requests, status, rules),
        _moved(status),
    ]
    return "ok", None, "; ".join(filter(None, about)) or None


def _failures(requests: Requests, rules: RecordRules) -> str:
    """Return how many requests failed, and why the first did."""
    of, why = len(requests.latencies_s) + requests.failed, requests.first_failure
    checked = requests.failed - requests.balance.lost
    parts = []
    if requests.balance.lost:
        parts.append(f"{requests.balance.lost} of {of} requests were started and never ended")
    if checked:
        parts.append(f"{checked} of {of} requests failed their check" + (f": {why}" if why else ""))
    if requests.balance.lost and requests.strays:
        parts.append(_strays(requests, rules))
    return "; ".join(parts)


def _unheard(requests: Requests, rules: RecordRules) -> str | None:
    """Return what the probe missed of a topic, if that is more than may fail: the node had it."""
    for topic, (missed, sent) in requests.missed.items():
        if missed > (1 - rules.valid) * sent:
            heard = f"the probe heard {max(sent - missed, 0)} of {sent} messages on {topic}, and the middleware lost the others"
            return f"{heard} on their way to it: spec.probe.via: preload times them inside of the node"
    return None


def _strays(requests: Requests, rules: RecordRules) -> str:
    name = rules.callback
    keep = f"keep what start({name!r}) returns, and call its stop() in the process that started it"
    return f"{requests.strays} ends of {name!r} have no start: {requests.first_stray}: {keep}"


def _unclear(requests: Requests, rules: RecordRules) -> str | None:
    """Return why it is not known which request took how long, if that is so for more of them than may fail."""
    n, name = len(requests.latencies_s) + requests.failed, rules.callback
    most = (1 - rules.valid) * (n + requests.strays)
    if (foreign := requests.unmatched - requests.strays) > UNMATCHED * max(n, 1):
        which = f"{foreign} responses belong to no request, beside {n} requests: the probe missed those, or they are answered"
        return f"{which} twice or by another node: name topics on which each request and its one response are heard"
    if requests.strays > most:
        return _strays(requests, rules)
    if requests.balance.guessed > most:
        which = f"{requests.balance.guessed} of {n} requests {name!r} ended while another was open in the same place"
        use = f"end it when its work fails, too (with fogspec_probe.request({name!r}))"
        return f"{which}, and which of them ended is not known: {use}, or keep what start() returns and call its stop()"
    return None


def _nothing(requests: Requests, rules: RecordRules) -> str:
    if requests.cold and requests.processes > 1:
        return f"each of {requests.processes} processes timed no more than its warm-up: spec.benchmark.warmup is {rules.warmup}"
    return "no request was answered after warm-up in the time allowed"


def _escaped(status: SampleStatus) -> str | None:
    """Return how processes left the CPUs that the sample is of, if they did."""
    use = status.resources
    if use is None or use.window < 1 or use.cpu_mean <= MOST_CPUS * use.vcpus:
        return None
    used = f"its processes used {shown(use.cpu_mean)} vCPUs on average, of {shown(use.vcpus)} that they were given"
    return f"{used}: one sets its own affinity (taskset, sched_setaffinity), or left its cgroup"


def _between(requests: Requests, status: SampleStatus, rules: RecordRules) -> str | None:
    """Return what no latency has of the work that was done."""
    if not (cpu_s := between_s(status.resources, requests.open_s, len(requests.latencies_s))):
        return None
    paid = "" if rules.workload else ", and it is paid"
    return f"{shown_duration(cpu_s)} of CPU time a request, at least, was used while none was open: no latency has it{paid}"


def _moved(status: SampleStatus) -> str | None:
    """Return what qualifies figures of a machine that had two CPUs one after the other."""
    server = status.server
    if server is None or server.changed_to is None:
        return None
    return f"its CPU changed while it was measured, from {server.cpu} to {server.changed_to}"


def _caveats(requests: Requests) -> Iterator[str | None]:
    """Yield what qualifies the figures of a valid sample."""
    if requests.unreadable:
        yield f"unreadable lines in the timings: {requests.unreadable}"
    yield requests.warning
    if requests.unmatched:
        yield f"responses that belong to no request: {requests.unmatched}"
    if requests.balance.lost:
        yield f"requests that were started and never ended: {requests.balance.lost}"
    if under_way := len(requests.balance.under_way_s):
        yield f"requests that were under way for longer than any other, and count with that: {under_way}"
    if len(requests.commands) > 1:
        commands = sorted(requests.commands.items())
        means = (
            f"{one}: {shown_duration(math.fsum(took) / len(took)) if took else 'none'} in {len(took)} requests"
            for one, took in commands
        )
        yield f"{len(commands)} commands time one name, on average {'; '.join(means)}"
    n = len(requests.service_times_s)
    if n and n == len(requests.latencies_s):
        latency_s, service_s = math.fsum(requests.latencies_s) / n, math.fsum(requests.service_times_s) / n
        if latency_s > WAITED * service_s:
            took, worked = shown_duration(latency_s), shown_duration(service_s)
            yield f"requests waited for one another: of {took} on average the node worked {worked}"


def printable(text: str) -> str:
    """Return a machine's text without control characters, cut to `DETAIL_LIMIT`."""
    return "".join(c if c.isprintable() else " " for c in text[:DETAIL_LIMIT]).strip()


def within_attempt(status: SampleStatus, directory: Path) -> SampleStatus:
    """Return the status without timings that lie outside its attempt's directory, links followed."""
    path = status.timings
    if path is None or path.resolve().is_relative_to(directory.resolve()):
        return status
    return replace(status, timings=None, detail="its timings are not where they belong, and were not read")


def compress(path: Path) -> bytes:
    """Return the raw timings compressed, the same bytes for the same content, without the values of secrets."""
    with open_untrusted(path) as file:
        content = file.read(SIZE_LIMIT)
    if secrets := known():
        content = b"".join(map(secrets.redact_record, content.splitlines(keepends=True)))
    return gzip.compress(content, compresslevel=6, mtime=0)


def _service(requests: Requests, rules: RecordRules) -> LatencySummary | None:
    """Return the summary of service times; None unless every request has one."""
    if len(requests.service_times_s) != len(requests.latencies_s):
        return None
    return summary(requests.service_times_s, weights(requests.scenarios, rules.scenarios))
