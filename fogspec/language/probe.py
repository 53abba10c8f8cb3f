"""Probes: the agent's programs that time the requests of a spec's `probe`.

Each is a module of `fogspec.agent`, which is the package `fogspec_agent` on the measured machine. All write the same records
(`fogspec.agent.records`), so that one reader reads them all (`fogspec.results.requests`). None changes the graph that it
observes, except for subscriptions.
"""

from dataclasses import dataclass
from typing import Literal

from fogspec.base import units
from fogspec.language.schema import Probe, Spec, Workload

Kind = Literal["topics", "service", "action", "callback", "bag"]
PACKAGE = "fogspec_agent"


@dataclass(frozen=True, slots=True)
class ProbeParts:
    """The programs of a probe.

    `beside`: commands of processes that listen. `inside`: arguments in front of a measured node's command. `afterwards`: the
    command that writes the records once everything else has ended; None if they are written during the measurement.
    """

    beside: tuple[tuple[str, ...], ...] = ()
    inside: tuple[str, ...] = ()
    afterwards: tuple[str, ...] | None = None


def kind_of(probe: Probe) -> Kind:
    """Return the kind of a valid probe."""
    if probe.bag is not None:
        return "bag"
    if probe.service is not None:
        return "service"
    if probe.action is not None:
        return "action"
    return "callback" if probe.callback is not None else "topics"


def via(probe: Probe) -> Literal["rclpy", "preload"] | None:
    """Return how topics, services and actions are observed; calls of a service are visible only inside its node."""
    kind = kind_of(probe)
    if kind in ("callback", "bag"):
        return None
    return probe.via or ("preload" if kind == "service" else "rclpy")


def name_of(probe: Probe) -> str:
    """Return the name of the probe's records; a node's own calls of start and stop may write others to the same file."""
    name = probe.callback or probe.service or probe.action or str(probe.response)
    return name if probe.callback else absolute(name)


def probe_parts(spec: Spec) -> ProbeParts:
    """Return the programs of the spec's probe and metrics."""
    probe, kind = spec.probe, kind_of(spec.probe)
    metrics = tuple(
        word
        for name, metric in sorted(spec.metrics.items())
        if metric.topic is not None
        for word in ("--metric", f"{name}={absolute(metric.topic)}:{metric.field}")
    )
    if kind == "bag":
        return ProbeParts(afterwards=module("bag", "--bag", str(probe.bag), *_topics(probe), *_limits(probe), *metrics))
    watched = _topics(probe) if kind == "topics" else _named(probe, kind)
    if via(probe) == "preload":
        listener = module("topics", *metrics)
        return ProbeParts(beside=(listener,) if metrics else (), inside=(*module("preload", *watched), "--"))
    held = ("--hold",) if holds(spec) else ()
    words = (*watched, *held, *(_limits(probe) if kind == "topics" else ()), *metrics)
    return ProbeParts(beside=(module("topics", *words),) if words else ())


def holds(spec: Spec) -> bool:
    """Return whether what sends the requests is held back until nothing is under way: matched by order, they have no stamp.

    A bag without a rate is played one request after the other.
    """
    workload, probe = spec.benchmark.workload, spec.probe
    return via(probe) == "rclpy" and probe.match == "order" and (workload.node is not None or workload.rate is not None)


def optional(inside: tuple[str, ...], argv: list[str]) -> list[str]:
    """Return a node's command behind `inside`, so that the node also starts if it cannot be timed."""
    return [*inside[:-1], "--optional", *inside[-1:], *argv] if inside else argv


def player(spec: Spec) -> list[list[str]]:
    """Return the process that sends the requests of a recorded bag, if there is one."""
    workload, probe = spec.benchmark.workload, spec.probe
    if workload.bag is None:
        return []
    target = _topics(probe)[:4]
    if probe.service is not None:
        target = ("--service", absolute(probe.service), *(("--success", probe.success) if probe.success else ()))
    return [list(module("player", "--bag", workload.bag, *target, *_pace(workload, probe)))]


def absolute(name: str) -> str:
    """Return the absolute form of a name in the graph."""
    return name if name.startswith(("/", "~")) else f"/{name}"


def module(name: str, *words: str) -> tuple[str, ...]:
    """Return the command of one of the agent's programs."""
    return ("python3", "-m", f"{PACKAGE}.{name}", *words)


def _topics(probe: Probe) -> tuple[str, ...]:
    request, response = absolute(str(probe.request)), absolute(str(probe.response))
    return ("--request", request, "--response", response, "--match", probe.match or "stamp")


def _named(probe: Probe, kind: Kind) -> tuple[str, ...]:
    name = {"service": probe.service, "action": probe.action}.get(kind)
    return () if name is None else (f"--{kind}", absolute(name))


def _limits(probe: Probe) -> tuple[str, ...]:
    success = () if probe.success is None else ("--success", probe.success)
    return (*success, *(() if probe.timeout is None else ("--timeout", units.format_number(probe.timeout))))


def _pace(workload: Workload, probe: Probe) -> tuple[str, ...]:
    rate = () if workload.rate is None else ("--rate", units.format_number(workload.rate))
    return (*rate, *(() if probe.timeout is None else ("--timeout", units.format_number(probe.timeout))))
