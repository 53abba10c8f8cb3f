"""Which nodes to offload together: those that work on the way from a request to its response, by evidence that is shown."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from fogspec.importers.graph.observed import Observed, Process, Topic
from fogspec.importers.graph.pairs import Pair
from fogspec.language.robot_packages import reason_of

LEAST_CORES = 0.1  # a node that uses less gains nothing by a larger machine


@dataclass(frozen=True)
class Member:
    """A node to offload, and why."""

    name: str
    why: str


def stays(seen: Observed, name: str) -> str | None:
    """Return why a node belongs on the robot, by the list of packages and what it publishes; None if nothing says so."""
    process = seen.nodes[name].process or Process()
    published = {topic: topic for topic, one in seen.topics.items() if name in one.publishers}
    known = {"package": process.package} if process.package else {"cmd": process.argv} if process.argv else {}
    return reason_of({**known, "remappings": published})


def cores(seen: Observed, name: str) -> float | None:
    """Return how many cores a node's process used on average; None if it is not known, or not the node's alone."""
    node = seen.nodes.get(name)
    if node is None or node.process is None or node.process.shared or node.gone or node.late or seen.seconds <= 0:
        return None
    return node.process.cpu_s / seen.seconds


def members(seen: Observed, first: Member, pairs: Sequence[Pair]) -> list[Member]:
    """Return the nodes to offload: the first, and those that hand on its requests and responses, if they work too."""
    found = {first.name: first}
    while added := next((one for one in _beside(seen, found, pairs) if _fits(seen, one.name)), None):
        found[added.name] = added
    return [*found.values()]


def _beside(seen: Observed, found: dict[str, Member], pairs: Sequence[Pair]) -> Iterator[Member]:
    """Yield the nodes that a request passes before or after those found, or that these call."""
    inside = [pair for pair in pairs if pair.node in found]
    requests, responses = {pair.request for pair in inside}, {pair.response for pair in inside}
    for pair in pairs:
        if pair.node not in found and (pair.response in requests or pair.request in responses):
            yield Member(pair.node, f"on the way, {pair.request} -> {pair.response}")
    for kind, offers in (("service", seen.services), ("action", seen.actions)):
        for name, offer in sorted(offers.items()):
            callers = [caller for caller in offer.callers if caller in found]
            if callers and offer.servers and offer.servers[0] not in found:
                yield Member(offer.servers[0], f"on the way, {kind} {name} for {callers[0]}")


def _fits(seen: Observed, name: str) -> bool:
    used = cores(seen, name)
    return used is not None and used >= LEAST_CORES and stays(seen, name) is None


def merged(seen: Observed, names: Sequence[str]) -> Observed:
    """Return what would have been seen if the nodes were one with the first one's name, without what they say to each other."""
    one = names[0]

    def called(nodes: Sequence[str]) -> list[str]:
        return sorted({one if name in names else name for name in nodes})

    topics: dict[str, Topic] = {}
    for topic, entry in seen.topics.items():
        publishers, subscribers = called(entry.publishers), called(entry.subscribers)
        if not publishers == subscribers == [one]:
            topics[topic] = entry.model_copy(update={"publishers": publishers, "subscribers": subscribers})
    nodes = {name: node for name, node in seen.nodes.items() if name == one or name not in names}
    return seen.model_copy(update={"topics": topics, "nodes": nodes})


def left(seen: Observed, chosen: Sequence[str], pairs: Sequence[Pair]) -> Iterator[str]:
    """Yield a line for each node that stays although it works, or hands on requests, with the reason."""
    on_the_way = {pair.node for pair in pairs}
    for name, node in sorted(seen.nodes.items()):
        if name in chosen or node.gone or node.process is None:
            continue
        used, why = cores(seen, name), stays(seen, name)
        works = used is not None and used >= LEAST_CORES
        if not (why or works or name in on_the_way):
            continue
        if why is None:
            why = _why_left(node.process, works, name in on_the_way)
        yield f"robot: {name}{'' if used is None else f', {used:.2f} cores'}: {why}"


def _why_left(process: Process, works: bool, on_the_way: bool) -> str:
    if process.shared:
        return "it shares its process with other nodes"
    if not works:
        return "works too little to gain by a larger machine"
    return "works on other requests" if on_the_way else "not on the way from a request to its response"
