"""What runs as metrics, in OpenMetrics text of which Prometheus' older text format is a part.

Only gauges, counters and summaries are used, so that node_exporter's textfile collector reads the same file.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import get_args

from fogspec.base.text import line
from fogspec.deploy.drift import Drift
from fogspec.deploy.health import Health, HealthReport, Sync

CONTENT_TYPE = "application/openmetrics-text; version=1.0.0; charset=utf-8"
QUANTILES = {"0.5": "p50", "0.95": "p95", "0.99": "p99"}
Sample = tuple[str, Mapping[str, str], float]  # suffix of the name, labels, value


@dataclass(frozen=True, slots=True)
class Metrics:
    """The applications whose metrics are written; each report is None where nothing runs."""

    reports: Mapping[str, HealthReport | None]
    restarts: Mapping[str, int]
    round_unix_s: float | None = None

    def text(self) -> str:
        """Return the whole exposition, which ends in `# EOF`."""
        lines = [text for family in self._families() for text in family]
        return "\n".join([*lines, "# EOF", ""])

    def _families(self) -> Iterator[list[str]]:
        running = {name: one for name, one in self.reports.items() if one is not None}
        yield _family(
            "fogspec_deployment", "gauge", "1 for each application, 0 where nothing runs",
            [("", {"application": name, **_about(one)}, float(one is not None)) for name, one in self.reports.items()],
        )  # fmt: skip
        yield _family(
            "fogspec_serving", "gauge", "Whether the nodes answer",
            _each(running, lambda one: float(one.serving is not None and one.live is not None and one.live.state == "ready")),
        )  # fmt: skip
        topics: tuple[tuple[str, tuple[str, ...], str, Callable[[HealthReport], str]], ...] = (
            ("health", get_args(Health), "Health of the deployment", lambda one: one.health),
            ("sync", get_args(Sync), "Whether what runs is what the manifest says", lambda one: one.sync),
            ("drift", get_args(Drift), "Observed latency against the prediction", _drift),
        )
        for topic, states, text, value in topics:
            samples: list[Sample] = [
                ("", {"application": name, "state": state}, float(value(one) == state))
                for name, one in running.items()
                for state in states
            ]
            yield _family(f"fogspec_{topic}", "gauge", f"{text}, 1 for the state it is in", samples)
        yield _family(
            "fogspec_request_latency_seconds", "summary", "Latency of the latest requests, at most 1,000",
            [
                ("", {"application": name, "quantile": quantile}, value)
                for name, one in running.items()
                for quantile, field in QUANTILES.items()
                if one.observed and one.observed.latency and (value := getattr(one.observed.latency, field)) is not None
            ],
        )  # fmt: skip
        yield _family(
            "fogspec_request_latency_mean_seconds", "gauge", "Mean latency of the latest requests",
            _each(running, lambda one: one.observed.latency.mean if one.observed and one.observed.latency else None),
        )  # fmt: skip
        yield _family(
            "fogspec_predicted_latency_seconds", "gauge", "Latency that the models predicted, with its interval",
            [sample for name, one in running.items() for sample in _predicted(name, one)],
        )  # fmt: skip
        yield _family(
            "fogspec_latency_limit_seconds", "gauge", "Limit of the latency in the manifest",
            _each(running, lambda one: one.manifest.expected.latency.limit if one.manifest else None),
        )  # fmt: skip
        yield _family(
            "fogspec_observed_requests", "gauge", "Requests among the latest, by outcome",
            [
                ("", {"application": name, "outcome": outcome}, float(value))
                for name, one in running.items()
                if one.observed
                for outcome, value in (("valid", one.observed.requests), ("failed", one.observed.failed))
            ],
        )  # fmt: skip
        yield _family(
            "fogspec_request_cost_usd", "gauge", "Cost of one request at the observed latency",
            _each(running, lambda one: one.observed.cost_usd_per_request if one.observed else None),
        )  # fmt: skip
        yield _family(
            "fogspec_price_usd_per_hour", "gauge", "Price of all machines of the application",
            _each(running, lambda one: sum(machine.machine.price for machine in one.machines)),
        )  # fmt: skip
        yield _family(
            "fogspec_spent_usd", "counter", "Cost of its machines since it was last down",
            _each(running, lambda one: one.spent_usd, "_total"),
        )  # fmt: skip
        yield _family(
            "fogspec_machines", "gauge", "Machines that may cost money",
            _each(running, lambda one: float(len(one.machines))),
        )  # fmt: skip
        yield _family(
            "fogspec_up_seconds", "gauge", "Time since its machine was started", _each(running, lambda one: one.up_s)
        )
        yield _family(
            "fogspec_node_restarts", "counter", "How often its machine started a node again",
            [
                ("_total", {"application": name, "node": node}, float(times))
                for name, one in running.items()
                if one.live
                for node, times in one.live.restarts.items()
            ],
        )  # fmt: skip
        yield _family(
            "fogspec_machine_restarts", "counter", "How often fogspec watch started a machine in place of another",
            [("_total", {"application": name}, float(times)) for name, times in self.restarts.items()],
        )  # fmt: skip
        if self.round_unix_s is not None:
            yield _family(
                "fogspec_watch_round_timestamp_seconds", "gauge", "When fogspec watch last looked at all of them",
                [("", {}, self.round_unix_s)],
            )  # fmt: skip


def _drift(one: HealthReport) -> str:
    return one.observed.drift if one.observed else "unknown"


def _about(one: HealthReport | None) -> dict[str, str]:
    if one is None:
        return {}
    subject = one.serving or one.machines[-1]
    machine = subject.machine
    return {"infra": machine.infra, "instance": machine.instance, "machine": subject.name, "manifest": subject.manifest}


def _predicted(name: str, one: HealthReport) -> Iterator[Sample]:
    if one.manifest is None:
        return
    latency = one.manifest.expected.latency
    about = {"application": name, "statistic": latency.statistic}
    yield "", {**about, "bound": "predicted"}, latency.predicted
    for bound, value in zip(("lower", "upper"), latency.interval or (), strict=False):
        yield "", {**about, "bound": bound}, value


def _each(
    running: Mapping[str, HealthReport], value: Callable[[HealthReport], float | None], suffix: str = ""
) -> list[Sample]:
    found = ((name, value(one)) for name, one in running.items())
    return [(suffix, {"application": name}, float(one)) for name, one in found if one is not None]


def _family(name: str, kind: str, text: str, samples: Iterable[Sample]) -> list[str]:
    lines = [
        f"{name}{suffix}{_labels(labels)} {_number(value)}" for suffix, labels, value in samples if math.isfinite(value)
    ]
    return [f"# TYPE {name} {kind}", f"# HELP {name} {text}.", *lines] if lines else []


def _labels(labels: Mapping[str, str]) -> str:
    pairs = [f'{key}="{escaped(value)}"' for key, value in labels.items()]
    return f"{{{','.join(pairs)}}}" if pairs else ""


def escaped(value: str) -> str:
    """Return a label's value as the format writes it: one line, what cannot be seen as its escape, then backslash and quote."""
    return line(value).replace("\\", "\\\\").replace('"', '\\"')


def _number(value: float) -> str:
    return repr(float(value))
