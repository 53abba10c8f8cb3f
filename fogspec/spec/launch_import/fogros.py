"""FogROS2's own classes: where its nodes run, its containers, its constraint, and the topics that its analyser times."""

import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from fogspec.spec.launch_import.constraints import UNREAD, is_constraint, may_be_constraint, take_constraint
from fogspec.spec.launch_import.found import LaunchImport, Made, Place, Unknown
from fogspec.spec.launch_import.nodes import split
from fogspec.spec.launch_import.program import Named
from fogspec.spec.launch_import.substitutions import Context

if TYPE_CHECKING:
    from fogspec.spec.launch_import.service import Service

MACHINES = {
    "AWSCloudInstance": ("aws", "region", "us-west-1", "ec2_instance_type", "t2.micro", "ami_image"),
    "GCPCloudInstance": ("gcp", "zone", "us-central1-a", "machine_type", "e2-medium", "ami_image"),
    "KubeInstance": ("kubernetes", "", "", "", "", "container_image"),
    "AzureCloudInstance": ("azure", "region", "", "vm_size", "", "image"),
}
# What of SkyLaunchDescription is either in the spec already or FogROS2's own business.
UNUSED = {"workdir", "mode", "num_replicas", "manifest"}
TIMED = re.compile(r"(request_topic_name|response_topic_name|heuristic_mode):=(\S+)")
PREPARES = re.compile(r"(sudo )?(apt|apt-get|pip3?|wget|curl|mv|cp|mkdir|git|docker pull)\b")
PROBE = {"request_topic_name": "request", "response_topic_name": "response", "heuristic_mode": "match"}


def is_cloud(made: Made) -> bool:
    """Whether FogROS2 starts this on a cloud machine."""
    return made.kind == "CloudNode" or made.word("to_cloud") is True


def cloud_node(context: Context, made: Made) -> None:
    """Take over where a CloudNode runs, and what else its machine is given."""
    context.found.said_cloud = True
    machine = made.word("machine")
    if isinstance(machine, Made):
        _machine(context, machine)
    elif isinstance(machine, Unknown):
        context.found.note(machine.place, f"the machine is not taken over: {machine.why}")
    topics = made.word("stream_topics")
    for one in topics if isinstance(topics, (list, tuple)) else []:
        pair = [context.perform(side, made.place) for side in one] if isinstance(one, (list, tuple)) else []
        if len(pair) != 2 or not all(isinstance(side, str) for side in pair):
            context.found.note(
                made.place, "a streamed topic is not taken over: it is not a pair of topic and transport"
            )
            continue
        _stream(context, str(pair[0]), str(pair[1]))


def _machine(context: Context, machine: Made) -> None:
    """Take over cloud and region, the containers that run there, and name the instance type."""
    found = context.found
    known = MACHINES.get(machine.kind)
    if known is None:
        found.note(machine.place, f"{machine.kind} is not taken over")
        return
    cloud, where, default, kind, default_kind, image = known
    place = context.perform(machine.word(where, default=default), machine.place) if where else ""
    if isinstance(place, Unknown):
        found.note(place.place, f"{where} is not taken over: {place.why}")
        place = ""
    if cloud == "gcp" and place:
        place = f"{place.rpartition('-')[0]}/{place}"
    infra = f"{cloud}/{place}" if place else cloud
    if infra not in found.infra:
        found.infra.append(infra)
    if kind:
        instance = machine.word(kind, default=default_kind)
        keep = f"; to keep it, write hardware.machines.allow: [{instance}]" if isinstance(instance, str) else ""
        found.note(machine.place, f"{kind}={instance} is not taken over: fogspec finds the type{keep}" if keep else
                   f"{kind} is not taken over: fogspec finds the type")  # fmt: skip
    own = machine.word(image)
    if image == "container_image" and isinstance(own, str):
        found.image = own
    elif own is not None:
        found.note(machine.place, f"{image} is not taken over: ros.image is a container image")
    for word in sorted(machine.words.keys() - {where, kind, image, "_dockers"}):
        found.note(machine.place, f"{word} of {machine.kind} is not taken over")
    for docker in machine.words.pop("_dockers", []):
        container(context, docker.word("cmd", 0), docker.place)


def container(context: Context, command: Any, place: Place) -> None:
    """Take over a container's command line as a process of the cloud; FogROS2's latency analyser as the probe."""
    text = context.perform(command, place)
    if isinstance(text, Unknown):
        context.found.note(text.place, f"a container is not taken over: {text.why}")
        return
    timed = {PROBE[key]: value for key, value in TIMED.findall(text)}
    if "request" in timed and "response" in timed:
        context.found.probe |= timed
        return
    argv = split(text)
    plain = argv and not re.search(r"[$&|;<>`*~]", text)
    if argv:
        context.found.cloud.append({"cmd": argv if plain else ["bash", "-c", text]})
        context.found.said_cloud = True


def timed_node(found: LaunchImport, node: dict[str, Any]) -> bool:
    """Whether a node is FogROS2's latency analyser, which becomes the probe."""
    values = node.get("parameters", {})
    if node.get("package") != "fogros2" or "request_topic_name" not in values:
        return False
    found.probe |= {word: values[key] for key, word in PROBE.items() if key in values}
    return True


def _stream(context: Context, topic: str, transport: str) -> None:
    """Start the pair of republishers that FogROS2 starts for a streamed topic."""
    packed = f"{topic}/{transport}"
    cloud = {f"in/{transport}": packed, "out": f"{topic}/cloud"}
    robot = {"in": topic, f"out/{transport}": packed}
    common = {"package": "image_transport", "executable": "republish"}
    context.found.cloud.append(
        {**common, "name": "republish_node", "remappings": cloud, "arguments": [transport, "raw"]}
    )
    context.found.robot.append(
        {**common, "name": "republish_node2", "remappings": robot, "arguments": ["raw", transport]}
    )


def description(service: "Service", made: Made) -> None:
    """Take over the paper's SkyLaunchDescription: its nodes go to the cloud, its constraint into the spec."""
    found = service.found
    found.said_cloud = True
    given = dict(made.words)
    if made.args:
        given.setdefault("nodes", made.args[0])
    if len(made.args) > 1:
        given.setdefault("constraint", made.args[1])
    for name, value in given.items():
        place = made.places.get(name, made.place)
        if name in ("constraint", "constraints"):
            _constraints(service, value, place)
        elif name == "accelerators" or is_constraint(name):
            _constraint(service, name, value, place)
        elif isinstance(value, Unknown):
            found.note(value.place, f"{name} of SkyLaunchDescription is not taken over: {value.why}")
        elif name in TAKEN:
            TAKEN[name](service, value, place)
        elif name == "ami":
            found.note(place, "ami is not taken over: ros.image is a container image")
        elif name not in UNUSED and may_be_constraint(name):
            _constraint(service, name, value, place)
        elif name not in UNUSED:
            found.note(place, f"{name} of SkyLaunchDescription is not taken over")


def _constraints(service: "Service", value: Any, place: Place) -> None:
    service.found.constrained = True
    if not isinstance(value, dict):
        why = "the constraints cannot be read: latency and cost are left empty, write them into the spec"
        service.found.note(place, why)
        service.found.constraints |= {"latency": None, "cost": None}
        return
    for key, one in value.items():
        _constraint(service, key.last if isinstance(key, Named) else str(key), one, place)


def _constraint(service: "Service", name: str, value: Any, place: Place) -> None:
    """Take over one constraint, or leave its field empty and report it where it is written."""
    service.found.constrained = True
    report = take_constraint(service.found, name, UNREAD if isinstance(value, Unknown) else value)
    if report:
        service.found.note(place, report)


def _setup(service: "Service", value: Any, _: Place) -> None:
    service.found.setup += [str(one) for one in value or []]


def _containers(service: "Service", value: Any, place: Place) -> None:
    for one in value or []:
        container(service.context, one, place)


def _run(service: "Service", value: Any, place: Place) -> None:
    """Take over the lines that run on the machine: what installs something is setup, each other line is a process."""
    for one in value or []:
        text = service.context.perform(one, place)
        if isinstance(text, str) and PREPARES.match(text):
            service.found.setup.append(text)
        else:
            container(service.context, one, place)


def _nodes(service: "Service", value: Any, _: Place) -> None:
    before = len(service.found.robot)
    service.visit(value)
    service.found.cloud += service.found.robot[before:]
    del service.found.robot[before:]


TAKEN: dict[str, Callable[["Service", Any, Place], None]] = {
    "nodes": _nodes,
    "additional_setup_commands": _setup,
    "containers": _containers,
    "additional_run_commands": _run,
}
