"""What runs as metrics, in the text that node_exporter's textfile collector reads."""

import math
from collections.abc import Iterator, Mapping
from typing import get_args

from fogspec.base.text import line
from fogspec.deploy.drift import Drift
from fogspec.deploy.health import Health, HealthReport, Sync

Sample = tuple[str, dict[str, str], float | None]  # name, labels, value; None is left out


def metrics_text(reports: Mapping[str, HealthReport | None], restarts: Mapping[str, int], round_unix_s: float) -> str:
    """Return the metrics of applications, one a line; a report is None where nothing runs."""
    found: list[Sample] = [("watch_round_timestamp_seconds", {}, round_unix_s)]
    found += [("machine_restarts_total", {"application": name}, float(times)) for name, times in restarts.items()]
    for name, report in reports.items():
        samples = [("deployment", {}, 0.0)] if report is None else [*_deployment(report), *_requests(report)]
        found += [(what, {"application": name, **labels}, value) for what, labels, value in samples]
    known = ((name, labels, value) for name, labels, value in found if value is not None and math.isfinite(value))
    return "".join(sorted(f"fogspec_{name}{{{_labels(labels)}}} {value!r}\n" for name, labels, value in known))


def _deployment(one: HealthReport) -> Iterator[Sample]:
    subject = one.serving or one.machines[-1]
    about = {"infra": subject.machine.infra, "instance": subject.machine.instance}
    yield "deployment", {**about, "machine": subject.name, "manifest": subject.manifest}, 1.0
    yield "serving", {}, float(one.serving is not None and one.live is not None and one.live.state == "ready")
    drift = one.observed.drift if one.observed else "unknown"
    for topic, states, state in (("health", Health, one.health), ("sync", Sync, one.sync), ("drift", Drift, drift)):
        yield from ((topic, {"state": each}, float(each == state)) for each in get_args(states))
    yield "price_usd_per_hour", {}, float(sum(machine.machine.price for machine in one.machines))
    yield "spent_usd_total", {}, float(one.spent_usd)
    yield "machines", {}, float(len(one.machines))
    yield "up_seconds", {}, one.up_s
    for node, times in (one.live.restarts if one.live else {}).items():
        yield "node_restarts_total", {"node": node}, float(times)


def _requests(one: HealthReport) -> Iterator[Sample]:
    if one.manifest is not None:
        latency = one.manifest.expected.latency
        yield "latency_limit_seconds", {}, latency.limit_on_machine
        bounds = zip(("predicted", "lower", "upper"), (latency.predicted, *(latency.interval or ())), strict=False)
        for bound, value in bounds:
            yield "predicted_latency_seconds", {"statistic": latency.statistic, "bound": bound}, value
    if one.observed is not None:
        yield "observed_requests", {"outcome": "valid"}, float(one.observed.requests)
        yield "observed_requests", {"outcome": "failed"}, float(one.observed.failed)
        yield "request_cost_usd", {}, one.observed.cost_usd_per_request
        if (seen := one.observed.latency) is not None:
            for quantile, value in (("0.5", seen.p50), ("0.95", seen.p95), ("0.99", seen.p99)):
                yield "request_latency_seconds", {"quantile": quantile}, value
            yield "request_latency_mean_seconds", {}, seen.mean


def _labels(labels: Mapping[str, str]) -> str:
    return ",".join(f'{key}="{escaped(value)}"' for key, value in labels.items())


def escaped(value: str) -> str:
    """Return a label's value as the format writes it: one line, what cannot be seen as its escape, then backslash and quote."""
    return line(value).replace("\\", "\\\\").replace('"', '\\"')
