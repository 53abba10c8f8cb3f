"""Which topics, services and actions pass the link between robot and cloud: those that the spec names, no others."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from fogspec.language.schema import ComposableNode, Node, Spec


@dataclass(frozen=True, slots=True)
class AllowedNames:
    """Full ROS 2 names, sorted. `names` are remapping targets, of which a spec does not say what they are."""

    topics: tuple[str, ...]
    services: tuple[str, ...]
    actions: tuple[str, ...]
    names: tuple[str, ...]


def exposed(spec: Spec) -> AllowedNames:
    """Return the names in the spec's probe, metrics, connectivity and remappings of cloud nodes.

    A name that is relative to a node's own (`~`) or has a substitution in it is left out: rules reject those that
    are listed explicitly.
    """
    probe, more = spec.probe, spec.connectivity.exposed
    topics = [probe.request, probe.response, *(metric.topic for metric in spec.metrics.values()), *more("topic")]
    services, actions = [probe.service, *more("service")], [probe.action, *more("action")]
    known = AllowedNames(_full(topics), _full(services), _full(actions), ())
    said = {*known.topics, *known.services, *known.actions}
    names = {target for node in spec.cloud for target in _targets(node)}
    return AllowedNames(known.topics, known.services, known.actions, tuple(sorted(names - said)))


def _targets(node: Node) -> Iterator[str]:
    for new in node.remappings.values():
        name = resolve(new, node.namespace or "", node.name)
        if name is not None:
            yield name


def _full(names: Sequence[str | None]) -> tuple[str, ...]:
    return tuple(sorted({full for name in names if name and (full := resolve(name)) is not None}))


def names_to_activate(nodes: Iterable[Node]) -> list[str]:
    """Return the full names of the nodes and components that fogspec is to configure and activate."""
    parts: list[tuple[bool, Node | ComposableNode]] = []
    for node in nodes:
        parts.append((node.launch.autostart, node))
        parts += [(one.autostart, one) for one in node.composable_node_descriptions]
    return [str(resolve(one.name, one.namespace or "")) for wanted, one in parts if wanted and one.name]


def resolve(name: str, namespace: str = "", node: str | None = None) -> str | None:
    """Return the full ROS 2 name of a node's name for it; None if only running the node would determine it."""
    space = "/" + namespace.strip("/") if namespace.strip("/") else ""
    if name.startswith("~"):
        if node is None:
            return None
        name = f"{space}/{node}{'/' if name[1:2] not in ('', '/') else ''}{name[1:]}"
    elif not name.startswith("/"):
        name = f"{space}/{name}"
    return None if "{" in name or name == "/" else name
