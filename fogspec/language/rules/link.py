"""Rules about the link between robot and cloud, and about keys, which are in no spec."""

from collections.abc import Iterator
from typing import Any

from fogspec.base.clouds import cloud_of
from fogspec.base.credentials import kind_of
from fogspec.base.yaml.positions import Path, dotted
from fogspec.language.graph_names import exposed, names_to_activate, resolve
from fogspec.language.rules.finding import Finding
from fogspec.language.rules.machines import lacks, ros_block
from fogspec.language.rules.nodes import all_named
from fogspec.language.schema import Application

LINK: Path = ("spec", "connectivity", "link")
MANAGER = "lifecycle_manager"  # in the name of its package or executable; it has the names of its nodes in `node_names`


def what_a_link_needs(application: Application) -> Iterator[Finding]:
    """Require a ROS 2 environment that the link works with, and machines that it reaches."""
    spec, ros = application.spec, ("spec", "ros")
    if spec.connectivity.link == "zenoh" and spec.ros is None:
        message = "spec.connectivity.link zenoh joins ROS 2 graphs, and spec.ros is missing"
        yield Finding("FS541", LINK, message, f"add '{ros_block(spec.infra)}', or write wireguard", (ros,))
    mapped = next((index for index, entry in enumerate(spec.infra) if cloud_of(entry).maps_ports), None)
    if spec.connectivity.link == "zenoh" and mapped is not None:
        where = spec.infra[mapped]
        message = f"spec.connectivity.link zenoh needs a port at a machine's own address; in {where} it is at another"
        fix = f"take {where} out of spec.infra, or write none and join them by a network of your own"
        yield Finding("FS541", ("spec", "infra", mapped), message, fix, (LINK,))
    if spec.connectivity.link != "wireguard" or spec.ros is None:
        return
    if spec.ros.distro == "humble":
        message = "spec.connectivity.link wireguard needs ROS_STATIC_PEERS, which humble does not have"
        jazzy = "" if any(lacks("jazzy", place) for place in spec.infra) else ", or distro: jazzy"
        yield Finding("FS541", LINK, message, f"write zenoh{jazzy}", ((*ros, "distro"),))
    if spec.ros.image is not None:
        message = "spec.connectivity.link wireguard makes a network interface, which SkyPilot's containers must not"
        yield Finding("FS541", LINK, message, "write zenoh, or remove ros.image", ((*ros, "image"),))


def missing_link(application: Application) -> Iterator[Finding]:
    """Warn that ROS 2 nodes on the robot and on a rented machine would not find each other."""
    spec = application.spec
    rented = next((entry for entry in spec.infra if cloud_of(entry).priced), None)
    if spec.robot and spec.ros is not None and rented and spec.connectivity.link == "none":
        message = f"spec.robot has nodes, spec.connectivity.link is none, and DDS discovery does not reach {rented}"
        fix = "write 'connectivity: {link: zenoh}' in spec, unless a network of your own joins them"
        yield Finding("FS561", ("spec", "robot"), message, fix, (LINK,), at_key=True, severity="warning")


def port_that_nobody_opens(application: Application) -> Iterator[Finding]:
    """Warn that SkyPilot does not open WireGuard's port."""
    spec = application.spec
    elsewhere = any(cloud_of(entry).on_skypilot for entry in spec.infra)
    if spec.connectivity.link == "wireguard" and elsewhere and not any(what_a_link_needs(application)):
        message = (
            "spec.connectivity.link wireguard needs a UDP port that you open by hand: SkyPilot opens TCP ports only"
        )
        fix = "write zenoh, or run the command that fogspec apply prints"
        yield Finding("FS544", LINK, message, fix, severity="warning")


def words_of_a_link(application: Application) -> Iterator[Finding]:
    """Reject settings of a link that does not exist."""
    joined = application.spec.connectivity
    said = [word for word in ("expose", "port") if getattr(joined, word)]
    if joined.link == "none" and not joined.sros2:
        for word in said:
            at = ("spec", "connectivity", word)
            yield Finding(
                "FS542", at, f"{dotted(at)} says nothing without a link", "add link: zenoh", (LINK,), at_key=True
            )
    nodes = (*application.spec.cloud, *application.spec.robot)
    if joined.sros2 and not any(node.name for node in nodes):
        message = "spec.connectivity.sros2 needs nodes with names, by which SROS2 knows them"
        yield Finding("FS542", ("spec", "connectivity", "sros2"), message, "give the nodes names", at_key=True)


def names_that_pass(application: Application) -> Iterator[Finding]:
    """Require absolute names for what passes the link: a router does not know which node a name is relative to."""
    joined, probe = application.spec.connectivity, application.spec.probe
    if joined.link == "none" and not joined.sros2:
        return
    named: list[tuple[Path, str | None]] = [(("spec", "connectivity", "expose", name), name) for name in joined.expose]
    named += [(("spec", "probe", kind), getattr(probe, kind)) for kind in ("request", "response", "service", "action")]
    for path, name in named:
        if name is not None and resolve(name) is None:
            yield Finding("FS543", path, f"{dotted(path)} must be a whole name to pass the link", "write it like /plan")
    passing = exposed(application.spec)
    if joined.link != "none" and not (passing.topics or passing.services or passing.actions or passing.names):
        message = "spec.connectivity.link would let nothing pass: no topic, service or action is named"
        yield Finding("FS543", LINK, message, "add what is to pass: 'expose: {/tf: topic}'")


def who_activates(application: Application) -> Iterator[Finding]:
    """Warn of managers that do not reach the nodes which they activate, and of nodes that are activated twice."""
    spec, named = application.spec, list(all_named(application.spec))
    own = names_to_activate((*spec.cloud, *spec.robot))
    side = {resolve(one.name, one.namespace or ""): path[1] for path, one in named if one.name}
    passing = set(exposed(spec).services)
    for path, manager in named:
        at = (*path, "parameters", "node_names")
        listed = manager.parameters.get("node_names")
        is_manager = MANAGER in f"{manager.package} {getattr(manager, 'executable', '')}"
        for name in listed if is_manager and isinstance(listed, list) else ():
            full = resolve(str(name), manager.namespace or "")
            services = [f"{full}/change_state", f"{full}/get_state"]
            away = side.get(full, path[1]) != path[1] and spec.connectivity.link == "zenoh"
            message, fix = (
                None,
                f"take {name} out of the list, and have fogspec activate it: launch: {{autostart: true}}",
            )
            if full in own:
                message = (
                    f"{dotted(at)} has {name}, which fogspec activates, too: a manager fails where it is active before"
                )
                fix = f"take {name} out of the list, or autostart off the node"
            elif away and not passing.issuperset(services):
                message = f"{dotted(at)} has {name} on the other side, and {', '.join(services)} and /bond do not pass the link"
            if message:
                yield Finding("FS563", at, message, fix, severity="warning")


def no_private_keys(application: Application) -> Iterator[Finding]:
    """Reject private keys and credentials anywhere in a spec."""
    for path, key, text in _texts((), application.model_dump(mode="json")):
        if (kind := kind_of(text, key)) is not None:
            fix = "make a new one, and name it in spec.secrets or leave it where it was made"
            yield Finding("FS509", path, f"{dotted(path)} looks like a private key or a credential: {kind}", fix)


def _texts(path: Path, value: Any, key: str = "") -> Iterator[tuple[Path, str, str]]:
    if isinstance(value, dict):
        for name, one in value.items():
            yield path, "", str(name)
            yield from _texts((*path, name), one, str(name))
    elif isinstance(value, list):
        for number, one in enumerate(value):
            before = value[number - 1] if number else None
            is_option = isinstance(before, str) and before.startswith("-") and "=" not in before
            yield from _texts((*path, number), one, str(before) if is_option else key)
    elif isinstance(value, str):
        yield path, key, value


RULES = (
    what_a_link_needs,
    missing_link,
    port_that_nobody_opens,
    words_of_a_link,
    names_that_pass,
    who_activates,
    no_private_keys,
)
