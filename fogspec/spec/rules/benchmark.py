"""Rules about what is measured, what is best, and what it may cost."""

from collections.abc import Iterator

from fogspec.base.units import SECONDS_PER_MONTH, format_duration, format_rate, rounded, shown_duration
from fogspec.base.yaml.positions import Path, dotted
from fogspec.spec.fingerprints import waivable
from fogspec.spec.probe import kind_of
from fogspec.spec.robot_packages import reason_of
from fogspec.spec.rules.finding import Finding
from fogspec.spec.schema import Application, Node, local_shape
from fogspec.spec.suggest import closest

SECONDS_PER_DAY = 86400
PLACEHOLDERS = "FS523"
NO_SENDER = "FS546"
PLACEHOLDER_TOPICS = ("/request", "/response")
NESTED_S = 360.0  # for all parts of a machine, as `fogspec.plan.commitment` counts them
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
    kind, via = kind_of(probe), probe.via
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
    played = kind == "service" and application.spec.benchmark.workload.bag is not None
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


def billing(application: Application) -> Iterator[Finding]:
    """Require a request rate for provisioned billing, and none for per-use billing."""
    objective, at = application.spec.objective, ("spec", "objective")
    both = ((*at, "rate"), (*at, "billing"))
    if objective.billing == "provisioned" and objective.rate is None:
        yield Finding(
            "FS518",
            (*at, "billing"),
            "spec.objective.billing provisioned needs a rate of requests",
            "add 'rate: 10/s'",
            both,
        )
    if objective.billing == "busy" and objective.rate is not None:
        yield Finding(
            "FS518",
            (*at, "rate"),
            "spec.objective.rate counts only for billing: provisioned",
            "remove it, or add 'billing: provisioned'",
            both,
            at_key=True,
        )
    if objective.billing == "busy" and objective.usage is not None:
        yield Finding(
            "FS518",
            (*at, "usage"),
            "spec.objective.usage counts only for billing: provisioned",
            "remove it, or add 'billing: provisioned' and 'rate: 10/s'",
            ((*at, "usage"), (*at, "billing")),
            at_key=True,
        )
    if objective.usage is not None and objective.usage.up > 1:
        usage = objective.usage
        each = f"{shown_duration(usage.session)} and {shown_duration(usage.startup)} of start-up"
        most = rounded(SECONDS_PER_DAY / (usage.session + usage.startup), 3)
        yield Finding(
            "FS530",
            (*at, "usage", "sessions"),
            f"spec.objective.usage has sessions that overlap: {format_rate(usage.sessions)}, each of {each}",
            f"write fewer than {most:g}/day, or leave usage out: always up",
            ((*at, "usage", "session"), (*at, "usage", "startup")),
        )


def extra_costs(application: Application) -> Iterator[Finding]:
    """Reject half of a cost: data without a price, a price without data, interruptions without spot machines."""
    spec, at = application.spec, ("spec", "objective")
    transfer = spec.objective.transfer
    if bool(transfer.per_request) != bool(transfer.price):
        given, missing, fix = (
            ("per_request", "price", "add 'price: $0.09/GiB'")
            if transfer.per_request
            else ("price", "per_request", "add 'per_request: 2MB'")
        )
        yield Finding(
            "FS527",
            (*at, "transfer", given),
            f"spec.objective.transfer costs nothing without {missing}",
            fix,
            ((*at, "transfer"),),
            at_key=True,
        )
    if not spec.objective.interruption.is_default and not spec.hardware.spot:
        yield Finding(
            "FS527",
            (*at, "interruption"),
            "spec.objective.interruption counts only for spot machines",
            "remove it, or allow them: hardware: {spot: true}",
            (("spec", "hardware", "spot"),),
            at_key=True,
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


def volume(application: Application) -> Iterator[Finding]:
    """Require a sampler that can stop, an objective in which money counts, and requests that can be served."""
    spec, at = application.spec, ("spec", "benchmark", "volume")
    found, rate = spec.benchmark.volume, spec.objective.rate
    if found is None:
        return
    yield from _for_adaptive(application, "volume", "all of its samples are measured, whatever they save")
    if spec.objective.alpha == 1:
        yield Finding(
            "FS528",
            at,
            "spec.benchmark.volume needs an objective in which cost counts, and alpha is 1",
            "lower alpha, or remove volume",
            (("spec", "objective", "alpha"),),
            at_key=True,
        )
    usage = spec.objective.usage
    served_s = SECONDS_PER_MONTH * (usage.used if usage else 1.0)
    if rate is not None and found.requests_per_month > rate * served_s:
        most = f"{rate * served_s:,.0f}"
        yield Finding(
            "FS528",
            (*at, "requests_per_month"),
            f"spec.benchmark.volume has more requests than spec.objective.rate: {format_rate(rate)} is {most} a month",
            f"write at most {most.replace(',', '')}, or raise the rate",
            (("spec", "objective", "rate"),),
        )


def wall_time(application: Application) -> Iterator[Finding]:
    """Require a sampler that measures in batches, and time for one of them."""
    benchmark, path = application.spec.benchmark, ("spec", "benchmark", "wall_time")
    if benchmark.wall_time is None:
        return
    yield from _for_adaptive(application, "wall_time", "all of its samples are measured at once")
    one_s = benchmark.setup_timeout + benchmark.stop.duration + (NESTED_S if benchmark.shapes == "nested" else 0.0)
    if benchmark.wall_time < one_s:
        yield Finding(
            "FS529",
            path,
            f"spec.benchmark.wall_time is shorter than one sample, which may take {shown_duration(one_s)}",
            "raise it, or lower setup_timeout or stop.duration",
            (("spec", "benchmark", "setup_timeout"), ("spec", "benchmark", "stop", "duration")),
        )


def shapes(application: Application) -> Iterator[Finding]:
    """Reject nested shapes of the grid, which is the paper's, and of machines that have no part to be confined to."""
    benchmark, path = application.spec.benchmark, ("spec", "benchmark", "shapes")
    if benchmark.shapes == "own":
        return
    if not benchmark.machines and not benchmark.is_adaptive:
        yield Finding(
            "FS537",
            path,
            "spec.benchmark.shapes nested is not for sampler: grid, which measures the paper's machines as they are",
            "write 'sampler: adaptive', or 'shapes: own'",
            (("spec", "benchmark", "sampler"),),
        )
    gpus = [one for one in application.spec.hardware.gpus if one != "none"]
    if not benchmark.machines and len(gpus) == len(application.spec.hardware.gpus):
        yield Finding(
            "FS537",
            path,
            f"spec.benchmark.shapes nested needs machines without accelerators: a {gpus[0]} cannot be halved",
            "write 'shapes: own', or add none to spec.hardware.gpus",
            (("spec", "hardware", "gpus"),),
        )
    sizes = [local_shape(name) for name in benchmark.machines]
    if sizes and all(size is not None and size[0] % 2 for size in sizes):
        yield Finding(
            "FS537",
            path,
            "spec.benchmark.shapes nested needs vCPUs that can be halved, and each listed machine has an odd number",
            "list a larger one, such as local/2cpu-4gib",
            (("spec", "benchmark", "machines"),),
        )


def servers(application: Application) -> Iterator[Finding]:
    """Require a sampler that measures the choice again."""
    if application.spec.benchmark.servers > 1:
        yield from _for_adaptive(application, "servers", "no machine is measured again")


def _for_adaptive(application: Application, name: str, why: str) -> Iterator[Finding]:
    benchmark = application.spec.benchmark
    if benchmark.is_adaptive:
        return
    other = "machines" if benchmark.machines else "sampler"
    what = "a list of machines" if benchmark.machines else "the grid"
    yield Finding(
        {"wall_time": "FS529", "servers": "FS538"}.get(name, "FS528"),
        ("spec", "benchmark", name),
        f"spec.benchmark.{name} is for sampler: adaptive; of {what} {why}",
        f"remove {name}, or {other}" if benchmark.machines else f"write 'sampler: adaptive', or remove {name}",
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
    billing,
    extra_costs,
    latency_limit,
    stop,
    budget,
    volume,
    wall_time,
    shapes,
    servers,
    waivers,
    placeholders,
)
