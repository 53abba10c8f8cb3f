"""Rules about what is measured, what is best, and what it may cost."""

from collections.abc import Iterator

from fogspec.base.units import format_duration, format_rate, rounded, shown_duration
from fogspec.base.yaml.positions import Path, dotted
from fogspec.language.fingerprints import waivable
from fogspec.language.probe import kind_of
from fogspec.language.robot_packages import reason_of
from fogspec.language.rules.finding import Finding
from fogspec.language.schema import Application, Node
from fogspec.language.suggest import closest

SECONDS_PER_DAY = 86400
PLACEHOLDERS = "FS523"
NO_SENDER = "FS546"
PLACEHOLDER_TOPICS = ("/request", "/response")
PLACEHOLDER_PACKAGE = "my_package"
PROBES = ("request and response", "service", "action", "callback")


def kind_of_probe(application: Application) -> Iterator[Finding]:
    """Require exactly one kind of probe; a bag must contain request and response."""
    probe, at = application.spec.probe, ("spec", "probe")
    kinds = [kind for kind in ("service", "action", "callback") if getattr(probe, kind) is not None]
    topics = probe.request is not None or probe.response is not None or (probe.bag is not None and not kinds)
    if topics and (probe.request is None or probe.response is None):
        missing, other = ("request", "response") if probe.request is None else ("response", "request")
        other = other if getattr(probe, other) is not None else "bag"
        yield Finding(
            "FS512",
            (*at, other),
            f"spec.probe.{other} needs spec.probe.{missing}",
            f"add '{missing}: /{missing}', with the topic's name",
            ((*at, missing),),
        )
    if topics and probe.request is not None and probe.request == probe.response:
        yield Finding(
            "FS513",
            (*at, "response"),
            "spec.probe.response must be another topic than the request",
            "name the topic that carries the answer",
            ((*at, "request"),),
        )
    if probe.match is not None and not topics:
        yield Finding(
            "FS514", (*at, "match"), "spec.probe.match is for topics, and this probe has none", "remove it", at_key=True
        )
    said = "request" if probe.request is not None else "response" if probe.response is not None else "bag"
    found = ([said] if topics else []) + kinds + (["bag"] if probe.bag is not None and not topics else [])
    if not found:
        yield Finding(
            "FS511",
            at,
            f"spec.probe must say one of {', '.join(PROBES)}",
            "add 'request: /topic' and 'response: /topic'",
        )
    for extra in found[1:]:
        message = f"spec.probe must have one kind of probe, and {extra} is a second one"
        other = "request and response" if found[0] == "request" else found[0]
        yield Finding("FS511", (*at, extra), message, f"remove this line, or {other}", ((*at, found[0]),), at_key=True)


def ways_to_watch(application: Application) -> Iterator[Finding]:
    """Reject what the chosen way of watching cannot observe."""
    probe, at = application.spec.probe, ("spec", "probe")
    kind, via, workload = kind_of(probe), probe.via, application.spec.benchmark.workload
    if via is not None and kind in ("callback", "bag"):
        yield Finding(
            "FS525",
            (*at, "via"),
            f"spec.probe.via is not for a {kind}, which is read as it is",
            "remove it",
            ((*at, kind),),
            at_key=True,
        )
    if via == "rclpy" and kind == "service":
        yield Finding(
            "FS525",
            (*at, "via"),
            "what a service is asked does not show outside its node",
            "write 'preload'",
            ((*at, "service"),),
        )
    if via == "preload" and probe.match in ("first_request", "last_response"):
        yield Finding(
            "FS525",
            (*at, "match"),
            f"spec.probe.match {probe.match} is for subscribers",
            "write 'stamp' or 'order'",
            ((*at, "via"),),
        )
    if (
        kind == "topics"
        and via != "preload"
        and probe.match == "order"
        and workload.node is None
        and workload.bag is None
    ):
        yield Finding(
            "FS525",
            (*at, "match"),
            "match: order needs to hold back what sends the requests until none is under way, and the spec does not have it",
            "add spec.benchmark.workload, which sends them, or write 'stamp', or add 'via: preload'",
            ((*at, "request"),),
        )
    if kind == "bag" and probe.match == "order":
        yield Finding(
            "FS525",
            (*at, "match"),
            "match: order cannot know how many requests were under way when the nodes began to record spec.probe.bag",
            "write 'stamp', or remove the bag: the requests are timed as they come",
            ((*at, "bag"),),
        )
    played = kind == "service" and workload.bag is not None
    if probe.success is not None and not played and (kind not in ("topics", "bag") or via == "preload"):
        message = (
            "spec.probe.success is judged by who hears the response: a subscriber, or the player of a service's bag"
        )
        fixes = {
            "topics": "remove 'via: preload'",
            "service": "add a bag to spec.benchmark.workload",
            "callback": "remove it, and call stop(..., ok=False) for an answer that is wrong",
        }
        yield Finding(
            "FS525",
            (*at, "success"),
            message,
            fixes.get(kind, "remove it: a goal that is not reached has failed"),
            ((*at, "via"), (*at, kind), ("spec", "benchmark", "workload", "bag")),
            at_key=True,
        )


def workload(application: Application) -> Iterator[Finding]:
    """Require one sender, a bag or a node; a bag must hold what the probe names."""
    spec, at = application.spec, ("spec", "benchmark", "workload")
    work, kind = spec.benchmark.workload, kind_of(spec.probe)
    about = (("spec", "probe"),)
    if work.bag is not None and work.node is not None:
        message = "spec.benchmark.workload must have one sender of requests, and node is a second one"
        yield Finding("FS526", (*at, "node"), message, "remove bag or node", ((*at, "bag"),), at_key=True)
    if work.rate is not None and work.bag is None:
        message = f"{dotted((*at, 'rate'))} is the pace of a bag: a node of your own sends as it likes"
        yield Finding("FS526", (*at, "rate"), message, "remove it, or add a bag", ((*at, "bag"),), at_key=True)
    if work.bag is not None and kind in ("callback", "action"):
        message = f"{dotted((*at, 'bag'))} holds requests on a topic or of a service, and the probe names neither"
        yield Finding("FS526", (*at, "bag"), message, "send the requests with a node", about, at_key=True)


def sender(application: Application) -> Iterator[Finding]:
    """Warn if nothing is said to send the requests: the robot's nodes do not run while a machine is measured.

    Not one of `RULES`, because it makes sense of a spec only in which nothing is wrong.
    """
    spec, at = application.spec, ("spec", "benchmark", "workload")
    kind = kind_of(spec.probe)
    if kind not in ("topics", "service", "action") or not spec.benchmark.workload.is_default:
        return
    name = spec.probe.request if kind == "topics" else getattr(spec.probe, kind)
    alone = spec.robot[0] if len(spec.robot) == 1 else None
    client = alone if alone and alone.package and reason_of({"package": alone.package}) is None else None
    words = f"package: {client.package}, executable: {client.executable}" if client else "package: ..., executable: ..."
    node = f"'workload: {{node: {{{words}}}}}'"
    fix = f"add {node}" if kind == "action" else f"add {node}, or a recorded bag: 'workload: {{bag: data/run.mcap}}'"
    message = f"spec.benchmark.workload is missing: unless a cloud node does, nothing sends {name} while it is measured"
    yield Finding(NO_SENDER, at, message, fix, severity="warning")


def kind_of_metric(application: Application) -> Iterator[Finding]:
    """Require a metric to come from a topic's field or from the node's own code."""
    for name, metric in application.spec.metrics.items():
        path: Path = ("spec", "metrics", name)
        if metric.callback is not None and (metric.topic is not None or metric.field is not None):
            extra = "topic" if metric.topic is not None else "field"
            yield Finding(
                "FS515",
                (*path, extra),
                f"{dotted(path)} must have callback or topic and field, not both",
                f"remove callback or {extra}",
                ((*path, "callback"),),
                at_key=True,
            )
        elif metric.callback is None and (metric.topic is None or metric.field is None):
            missing = "field" if metric.topic else "topic" if metric.field else "topic and field, or callback"
            yield Finding("FS515", path, f"{dotted(path)} must say {missing}", f"add {missing}")
        elif metric.callback is not None and application.spec.probe.callback is None:
            yield Finding(
                "FS516",
                (*path, "callback"),
                f"{dotted((*path, 'callback'))} needs a callback probe",
                "add a callback to spec.probe",
                (("spec", "probe"),),
            )


def scenarios(application: Application) -> Iterator[Finding]:
    """Require a callback probe for scenarios, which the workload's own code names."""
    spec, at = application.spec, ("spec", "benchmark", "scenarios")
    if spec.benchmark.scenarios and spec.probe.callback is None:
        yield Finding(
            "FS524",
            at,
            "spec.benchmark.scenarios needs a callback probe",
            "add a callback to spec.probe",
            (("spec", "probe"),),
        )


def metrics_that_exist(application: Application) -> Iterator[Finding]:
    """Require metrics named by objective and limits to exist."""
    spec, known = application.spec, list(application.spec.metrics)
    named: list[tuple[Path, str, bool]] = [
        (("spec", "constraints", "metrics", name), name, True) for name in spec.constraints.metrics
    ]
    if spec.objective.metric is not None:
        named.append((("spec", "objective", "metric"), spec.objective.metric, False))
    for path, name, at_key in named:
        if name not in known:
            near = closest(name, known)
            fix = (
                f"write '{near}'"
                if near
                else f"add {name} to spec.metrics"
                + ("" if name != "latency" else ", or remove the line: latency is what counts unless a metric is named")
            )
            yield Finding("FS517", path, f"spec.metrics has no {name}", fix, (("spec", "metrics"),), at_key=at_key)
    if spec.objective.scale.metric is not None and spec.objective.metric is None:
        path = ("spec", "objective", "scale", "metric")
        yield Finding(
            "FS517",
            path,
            f"{dotted(path)} needs spec.objective.metric",
            "remove it, or name the metric",
            (("spec", "objective", "metric"),),
            at_key=True,
        )


def sessions(application: Application) -> Iterator[Finding]:
    """Require both or none of how long and how often a machine is used, and sessions that do not overlap."""
    load, at = application.spec.objective.load, ("spec", "objective", "load")
    if load is None:
        return
    if (load.session is None) != (load.sessions is None):
        given, missing = ("session", "sessions: 1/week") if load.session else ("sessions", "session: 20min")
        message = f"spec.objective.load.{given} needs {missing.partition(':')[0]}"
        yield Finding("FS518", (*at, given), message, f"add '{missing}', or remove {given}: always up", at_key=True)
    startup_s = application.spec.hardware.startup
    if load.session is not None and load.sessions is not None and load.up(startup_s) > 1:
        each = f"{shown_duration(load.session)} and {shown_duration(startup_s)} of start-up"
        most = rounded(SECONDS_PER_DAY / (load.session + startup_s), 3)
        yield Finding(
            "FS530",
            (*at, "sessions"),
            f"spec.objective.load has sessions that overlap: {format_rate(load.sessions)}, each of {each}",
            f"write fewer than {most:g}/day, or leave session and sessions out: always up",
            ((*at, "session"), ("spec", "hardware", "startup")),
        )


def latency_limit(application: Application) -> Iterator[Finding]:
    """Require time for the request besides the network's, and samples that outlast one request."""
    spec, latency = application.spec, application.spec.constraints.latency
    at: Path = ("spec", "constraints", "latency")
    network: Path = ("spec", "constraints", "network_allowance")
    if latency is None:
        return
    if latency <= spec.constraints.network_allowance:
        path, fix = (
            (network, "allow the network less")
            if spec.constraints.network_allowance
            else (at, "write a latency above zero")
        )
        yield Finding("FS519", path, f"{dotted(path)} leaves no time for the request", fix, (at, network))
    elif latency >= spec.benchmark.stop.duration:
        after: Path = ("spec", "benchmark", "stop", "duration")
        longest = shown_duration(spec.benchmark.stop.duration)
        message = f"spec.constraints.latency must be below the {longest} that a sample measures"
        fix = f"set spec.benchmark.stop.duration to {format_duration(2 * latency)} or more"
        yield Finding("FS520", at, message, fix, (after,))


def stop(application: Application) -> Iterator[Finding]:
    """Require a sample to measure more requests than its warm-up discards."""
    steps, warmup = application.spec.benchmark.stop.requests, application.spec.benchmark.warmup
    if steps is not None and warmup >= steps:
        path: Path = ("spec", "benchmark", "warmup")
        about: Path = ("spec", "benchmark", "stop", "requests")
        message = f"spec.benchmark.warmup must be less than the {steps} requests of a sample"
        yield Finding("FS521", path, message, "lower warmup, or raise stop.requests", (about,))


def budget(application: Application) -> Iterator[Finding]:
    """Require a budget if measuring costs money."""
    benchmark = application.spec.benchmark
    local = all(
        place == "local" or place.startswith("local/") for place in benchmark.machines or application.spec.infra
    )
    path: Path = ("spec", "benchmark", "budget")
    if benchmark.budget is None and not local:
        yield Finding(
            "FS522",
            path,
            "spec.benchmark.budget is missing, and measuring costs money",
            "add 'budget: $2.50'",
            (("spec", "benchmark", "machines"),),
        )
    elif benchmark.budget == 0 and not local:
        yield Finding(
            "FS522",
            path,
            "spec.benchmark.budget must be more than $0",
            "write what it may cost, such as $2.50",
            (("spec", "benchmark", "machines"),),
        )


def waivers(application: Application) -> Iterator[Finding]:
    """Reject waivers of what defines the figures, and those that name no change."""
    for number, one in enumerate(application.spec.benchmark.waivers):
        at: Path = ("spec", "benchmark", "waivers", number)
        if one.old == one.new:
            yield Finding(
                "FS550", at, f"{dotted(at)}: old and new are the same", "write what fogspec status prints, or remove it"
            )
        if not waivable(one.change):
            message = f"{dotted((*at, 'change'))}: {one.change} says what is measured, and no waiver can name it"
            yield Finding("FS550", (*at, "change"), message, "remove it, and measure again with fogspec bench")


def servers(application: Application) -> Iterator[Finding]:
    """Require a sampler that measures the choice again."""
    benchmark = application.spec.benchmark
    if benchmark.servers == 1 or application.spec.sampler == "adaptive":
        return
    other = "machines" if benchmark.machines else "sampler"
    what = "a list of machines" if benchmark.machines else "the grid"
    yield Finding(
        "FS538",
        ("spec", "benchmark", "servers"),
        f"spec.benchmark.servers is for sampler: adaptive; of {what} no machine is measured again",
        "remove servers, or machines" if benchmark.machines else "write 'sampler: adaptive', or remove servers",
        (("spec", "benchmark", other),),
        at_key=True,
    )


def placeholders(application: Application) -> Iterator[Finding]:
    """Warn about the names that `init` wrote as placeholders, which compile and bench refuse."""
    spec = application.spec
    if (spec.probe.request, spec.probe.response) == PLACEHOLDER_TOPICS:
        message = "spec.probe still has the topics that init made up"
        yield Finding(
            PLACEHOLDERS,
            ("spec", "probe", "request"),
            message,
            "name the topics of your own nodes",
            (("spec", "probe", "response"),),
            severity="warning",
        )
    nodes: list[tuple[Path, Node | None]] = [(("spec", "cloud", i), node) for i, node in enumerate(spec.cloud)]
    nodes.append((("spec", "benchmark", "workload", "node"), spec.benchmark.workload.node))
    for at, node in nodes:
        if node is not None and node.package == PLACEHOLDER_PACKAGE:
            path = (*at, "package")
            message = f"{dotted(path)} is still the one that init made up"
            yield Finding(PLACEHOLDERS, path, message, "name a package of your own", severity="warning")


RULES = (
    kind_of_probe,
    ways_to_watch,
    workload,
    kind_of_metric,
    scenarios,
    metrics_that_exist,
    sessions,
    latency_limit,
    stop,
    budget,
    servers,
    waivers,
    placeholders,
)
