"""The spec that a watched robot suggests: its probe, its nodes, its limits, and what passes the link.

Everything comes from observations, except for the link, which is not there yet: `ROUND_TRIP_S` and the rates below stand in
for it, and the notes say so.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, get_args

from fogspec.base.units import format_cost, format_duration, rounded, shown_duration
from fogspec.importers.graph.observed import Node, Observed, Process
from fogspec.importers.graph.offers import Calls, Untimed, timed_calls, untimed
from fogspec.importers.graph.offload import Member, cores, left, members, merged, stays
from fogspec.importers.graph.pairs import Pair, find_pairs
from fogspec.language.schema import Ros

ROUND_TRIP_S = 0.04
TO_CLOUD_BITS_PER_S = 20e6
FROM_CLOUD_BITS_PER_S = 50e6
USD_PER_BYTE = 0.09 / 2**30  # AWS's list price for the first 10 TB per month to the internet
MOST_LINES = 20
LONGEST_VALUE = 4000  # characters of a parameter: a robot's description is not written into a spec
OWN_PARAMETERS = ("qos_overrides.", "start_type_description_service")
RENAMES = ("__node", "__name", "__ns")
SYSTEM = "/opt/ros/"
DISTROS = get_args(Ros.model_fields["distro"].annotation)


@dataclass(kw_only=True)
class Proposal:
    """Values for `spec`, lines for the head of the file, and what the user should know besides.

    `programs` are in workspaces, `record` are topics of a workload, `cores` and `memory_gib` are what the cloud nodes used.
    """

    spec: dict[str, Any]
    lines: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    record: list[str] = field(default_factory=list)
    programs: list[str] = field(default_factory=list)
    latency_s: float | None = None
    cores: float | None = None
    memory_gib: float | None = None


def propose(seen: Observed) -> Proposal:
    """Return a first spec: the node that works most is the one to offload, with those that work on its requests too."""
    pairs, called = find_pairs(seen), timed_calls(seen)
    timed: list[Pair | Calls] = [*(one for one in pairs if one.match is not None), *called]
    at_home = {name for name in seen.nodes if stays(seen, name)}
    chosen = max((one for one in timed if one.node not in at_home), key=_load, default=None)
    unknown = untimed(seen)
    proposal = Proposal(spec={})
    found: list[Pair | Calls | Untimed] = [*pairs, *called, *unknown]
    proposal.lines.append(
        f"{_count(len(seen.nodes), 'node')} and {_count(len(seen.topics), 'topic')}, watched for {seen.seconds:.0f} s."
    )
    proposal.lines += _bounded([one.evidence() for one in found])
    proposal.warnings += _doubts(seen, pairs)
    unknown = [one for one in unknown if one.what.node not in at_home]
    asked = chosen or (unknown[0].what if unknown else None)
    node = asked.node if asked else None
    if node is None:
        proposal.warnings.append(
            "no request and response were found of a node that can leave the robot: name them under probe and cloud"
        )
    whole, together = seen, [] if asked is None else [Member(asked.node, f"answers {_name(asked)}")]
    if chosen is not None:
        whole, together, chosen = _together(seen, chosen, together[0], pairs)
    _nodes(proposal, seen, together)
    proposal.lines += _bounded([*left(seen, [one.name for one in together], pairs)])
    if isinstance(chosen, Pair):
        order = {} if chosen.match == "stamp" else {"match": chosen.match}
        proposal.spec["probe"] = {"request": chosen.request, "response": chosen.response, **order}
        proposal.record = [chosen.request]
    elif chosen is not None:
        proposal.spec["probe"] = {chosen.kind: chosen.name}
    elif unknown:
        proposal.spec["probe"] = {unknown[0].what.kind: unknown[0].what.name}
        proposal.warnings.append(f"{unknown[0].what.name}: {unknown[0].why}")
    if chosen is not None:
        proposal.latency_s = chosen.p50_s
        proposal.spec["probe"]["timeout"] = format_duration(_rounded_up(max(10 * chosen.p95_s, 1.0)))
    if node is not None:
        _link(proposal, whole, node, chosen)
    return proposal


def _load(one: Pair | Calls) -> float:
    """Return what a node works per second, at most all of it."""
    return min(1.0, one.p50_s * one.rate)


def _name(one: Pair | Calls) -> str:
    return one.request if isinstance(one, Pair) else one.name


def _together(
    seen: Observed, chosen: Pair | Calls, first: Member, pairs: list[Pair]
) -> tuple[Observed, list[Member], Pair | Calls]:
    """Return what is seen of the nodes to offload as one, these nodes, and the request and response that they have as one.

    If those cannot be found, the node that works most goes alone.
    """
    together = members(seen, first, pairs)
    if len(together) == 1:
        return seen, together, chosen
    whole = merged(seen, [one.name for one in together])
    if isinstance(chosen, Calls):
        return whole, together, chosen
    inside = [pair for pair in pairs if pair.node in {one.name for one in together}]
    last = {pair.response for pair in inside} - {pair.request for pair in inside}
    outer = [one for one in find_pairs(whole) if one.node == first.name and one.response in last and one.match]
    best = max(outer, key=lambda one: (one.p50_s, one.request), default=None)
    if best is None or best.p50_s < chosen.p50_s:
        return seen, [first], chosen
    return whole, together, best


def _bounded(lines: list[str]) -> list[str]:
    more = [f"... and {len(lines) - MOST_LINES} more"] if len(lines) > MOST_LINES else []
    return [*lines[:MOST_LINES], *more]


def _doubts(seen: Observed, pairs: list[Pair]) -> Iterator[str]:
    for pair in pairs:
        if pair.match is None:
            yield (
                f"{pair.request} -> {pair.response}: requests are lost and no stamp tells which response is whose: "
                "keep the header stamp in the node, or time it with fogspec_probe"
            )
        elif pair.how.endswith("alone"):
            yield f"{pair.request} -> {pair.response}: only the counts agree: check it before you rely on it"
    if gone := [name for name, node in seen.nodes.items() if node.gone]:
        yield f"{_some(gone)} ended while the robot was watched"
    if late := [name for name, node in seen.nodes.items() if node.late and not node.gone]:
        yield f"{_some(late)} appeared while the robot was watched: for its CPU use and rates, watch again"
    if dropped := [name for name, topic in seen.topics.items() if topic.dropped]:
        yield f"{_some(dropped)}: too much data to watch without load on the robot, so left after a few seconds"
    if unknown := [name for name, topic in seen.topics.items() if topic.problem]:
        yield f"{_some(unknown)}: not watched: {seen.topics[unknown[0]].problem}"


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def _some(names: list[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _nodes(proposal: Proposal, seen: Observed, chosen: list[Member]) -> None:
    """Divide the nodes: those chosen to the cloud, the others stay; those without a known program are named."""
    away = {one.name for one in chosen}
    visible = {name: node for name, node in seen.nodes.items() if not node.gone or name in away}
    unknown = [name for name, node in visible.items() if node.process is None or not node.process.argv]
    together = [name for name, node in visible.items() if node.process is not None and node.process.shared]
    entries = {name: _node(name, node, proposal) for name, node in visible.items()}
    cloud = [entries.pop(one.name) for one in chosen if one.name in entries]
    known = [entry for name, entry in entries.items() if name not in unknown and name not in together]
    proposal.spec |= {"cloud": cloud or [{"package": "my_package", "executable": "my_node"}]}
    if known:
        proposal.spec["robot"] = known
    offloaded = [visible[one.name] for one in chosen if one.name in visible]
    proposal.spec["ros"] = _ros(seen, offloaded)
    argvs = [one.process.argv for one in offloaded if one.process is not None]
    proposal.programs = [word for argv in argvs for word in argv[:2] if "/install/" in word]
    _used(proposal, seen, chosen)
    if unknown:
        proposal.warnings.append(
            f"{_some(unknown)}: how it was started is not visible from here: write it into the spec"
        )
    if together:
        what = f"{_some(together)} share a process: a node container is written as a whole"
        proposal.warnings.append(f"{what}, and what starts them is left for you")


def _ros(seen: Observed, nodes: list[Node]) -> dict[str, Any]:
    """Return where the packages of nodes come from: the distribution's packages, and a workspace for all others."""
    apt, others = set(), not nodes
    for process in (node.process or Process() for node in nodes):
        path = next((word for word in process.argv if word.endswith(f"/{process.executable}")), "")
        if process.package and path.startswith(SYSTEM):
            installed = path.removeprefix(SYSTEM).partition("/")[0]
            apt.add(f"ros-{installed}-{process.package.replace('_', '-')}")
        else:
            others = True
    distro = seen.distro if seen.distro in DISTROS else "jazzy"
    return {"distro": distro, **({"workspace": "ros2_ws"} if others else {}), **({"apt": sorted(apt)} if apt else {})}


def _used(proposal: Proposal, seen: Observed, chosen: list[Member]) -> None:
    """Say why each node is to be offloaded, and what it used; add up what is known of all."""
    for one in chosen:
        used, memory_gib = cores(seen, one.name), None
        process = seen.nodes[one.name].process if one.name in seen.nodes else None
        if used is not None and process is not None:
            memory_gib = process.memory_bytes / 2**30 if process.memory_bytes else None
            proposal.cores = (proposal.cores or 0.0) + used
            proposal.memory_gib = (proposal.memory_gib or 0.0) + memory_gib if memory_gib else proposal.memory_gib
        what = ("" if used is None else f", {used:.2f} cores") + (f", {memory_gib:.2f} GiB" if memory_gib else "")
        proposal.lines.append(f"cloud: {one.name}{what}: {one.why}")


def _node(name: str, node: Node, proposal: Proposal) -> dict[str, Any]:
    """Return a node as a spec has it."""
    namespace, _, own = name.rpartition("/")
    process = node.process or Process()
    if process.package:
        entry: dict[str, Any] = {"package": process.package, "executable": process.executable}
    elif process.argv and not process.shared:
        entry = {"cmd": process.argv}
    else:
        entry = {"package": "my_package", "executable": own}
    if "cmd" in entry:
        return entry  # what follows --ros-args is in it
    entry |= {"name": own} if own != process.executable else {}
    entry |= {"namespace": namespace} if namespace else {}
    if values := _parameters(name, node, proposal):
        entry["parameters"] = values
    if process.package and not process.shared:
        if names := {old: new for old, new in process.remappings.items() if old not in RENAMES and old and new}:
            entry["remappings"] = names
        if process.arguments:
            entry["arguments"] = process.arguments
    return entry


def _parameters(name: str, node: Node, proposal: Proposal) -> dict[str, Any]:
    kept = {}
    for key, value in node.parameters.items():
        if key.startswith(OWN_PARAMETERS) or (key, value) == ("use_sim_time", False) or value in (None, [], ""):
            continue
        values = value if isinstance(value, list) else [value]
        if any(isinstance(one, float) and not math.isfinite(one) for one in values) or len(str(value)) > LONGEST_VALUE:
            proposal.warnings.append(f"{name}: parameter {key} is too long or not finite, and left for you")
            continue
        kept[key] = value
    return kept


def _link(proposal: Proposal, seen: Observed, node: str, chosen: Pair | Calls | None) -> None:
    """Propose limits for machine and network, from what passes between the node and the others."""
    to_cloud, from_cloud = _passing(seen, node)
    seconds = max(seen.seconds, 1e-9)
    up, down = sum(to_cloud.values()) / seconds, sum(from_cloud.values()) / seconds
    for way, rates, total in (("to the cloud", to_cloud, up), ("back", from_cloud, down)):
        if rates:
            largest = max(rates, key=lambda topic: rates[topic])
            proposal.lines.append(
                f"link: {_bytes(total)}/s {way}, most of it {largest}, {_bytes(rates[largest] / seconds)}/s"
            )
    if 8 * up > TO_CLOUD_BITS_PER_S:
        proposal.warnings.append(
            f"{8e-6 * up:.0f} Mbit/s would go to the cloud: compress it, or keep what makes it on the same side"
        )
    sizes = (chosen.request_bytes, chosen.response_bytes) if isinstance(chosen, Pair) else (0.0, 0.0)
    network_s = _rounded_up(ROUND_TRIP_S + 8 * sizes[0] / TO_CLOUD_BITS_PER_S + 8 * sizes[1] / FROM_CLOUD_BITS_PER_S)
    limits = {"network_allowance": format_duration(network_s)}
    proposal.lines.append(
        f"network_allowance: {shown_duration(ROUND_TRIP_S)} round trip, and {_bytes(sizes[0])} at "
        f"{TO_CLOUD_BITS_PER_S * 1e-6:g} Mbit/s to the cloud, {_bytes(sizes[1])} at "
        f"{FROM_CLOUD_BITS_PER_S * 1e-6:g} Mbit/s back: guesses, until you measure your link"
    )
    if chosen is not None:
        limits = {"latency": format_duration(_rounded_up(chosen.p95_s + network_s)), **limits}
        proposal.lines.append("latency: the robot's own p95 now, and the network's part")
        if chosen.rate > 0 and down > 0:
            proposal.spec["transfer"] = format_cost(rounded(down / chosen.rate * USD_PER_BYTE, 3))
    proposal.spec["limits"] = limits


def _passing(seen: Observed, node: str) -> tuple[dict[str, float], dict[str, float]]:
    """Return bytes by topic that other nodes send to this one, and this one to others."""
    to_cloud: dict[str, float] = {}
    from_cloud: dict[str, float] = {}
    for name, topic in seen.topics.items():
        if node in topic.subscribers and set(topic.publishers) - {node} and topic.bytes:
            to_cloud[name] = topic.bytes * topic.sent_per_heard
        if node in topic.publishers and set(topic.subscribers) - {node} and topic.bytes:
            from_cloud[name] = topic.bytes * topic.sent_per_heard
    return to_cloud, from_cloud


def _bytes(count: float) -> str:
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count:.3g} B"


def _rounded_up(seconds: float) -> float:
    """Return the duration with two significant digits, not below the given one."""
    scale = 10.0 ** (math.floor(math.log10(seconds)) - 1)
    return round(math.ceil(round(seconds / scale, 6)) * scale, 9)
