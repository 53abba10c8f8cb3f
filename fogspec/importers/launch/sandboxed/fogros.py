"""FogROS2's own classes: where its nodes run, its containers, its constraint, and the topics that its analyser times."""

import re
from collections.abc import Callable
from functools import partial
from typing import Any

from fogspec.importers.launch.constraints import (
    PROBE,
    UNREAD,
    UNREADABLE,
    is_constraint,
    may_be_constraint,
    take_constraint,
)
from fogspec.importers.launch.sandboxed.actions import AFTER, LaunchDescription
from fogspec.importers.launch.sandboxed.context import FOUND, all_said, perform, said
from fogspec.importers.launch.sandboxed.guard import PLACES
from fogspec.importers.launch.sandboxed.made import NAMES, Made, applies, make, visit
from fogspec.importers.launch.sandboxed.nodes import Node
from fogspec.importers.launch.sandboxed.text import split
from fogspec.importers.launch.sandboxed.values import Place, Unknown, attempt, marked, note

# Of each class: its cloud, the argument with the place and its default, that with the type, and that with an image.
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
MADE: list[Made] = []  # descriptions that are made: FogROS2 launches them without their being returned


class Machine(Made):
    """A cloud machine of FogROS2's."""

    def add_docker_container(self, cmd: Any, *_: Any, **__: Any) -> None:
        """Keep a container's command."""
        self.__dict__.setdefault("containers", []).append((cmd, self.place))


for _name in MACHINES:
    make("fogros2", _name, base=Machine)


class CloudNode(Node):
    """A node that runs on a cloud machine."""

    def execute(self, context: Any) -> None:
        """Take over where it runs, and record it."""
        FOUND.said_cloud = True
        machine = self.given.get("machine")
        if isinstance(machine, Machine):
            _machine(machine)
        elif isinstance(machine, Unknown):
            note(machine._place, f"the machine is not taken over: {machine._why}")
        for one in self.word("stream_topics", []):
            pair = attempt(partial(all_said, one), "a streamed topic is", self.place)
            if pair is not None and len(pair) == 2:
                _stream(*pair)
            elif pair is not None:
                note(self.place, "a streamed topic is not taken over: it is not a pair of topic and transport")
        super().execute(context)


class SkyLaunchDescription(Made):
    """The paper's description: its nodes go to the cloud, its constraint into the spec."""

    FIELDS = ("nodes", "constraint")

    def __init__(self, *args: Any, **words: Any) -> None:
        super().__init__(*args, **words)
        MADE.append(self)

    def visit(self, context: Any) -> None:
        """Do nothing: it is played once, returned or not."""


NAMES["fogros2"] |= {"CloudNode": CloudNode, "SkyLaunchDescription": SkyLaunchDescription}
make("fogros2", "FogROSLaunchDescription", base=LaunchDescription)


def _machine(machine: Machine) -> None:
    """Take over cloud and region, the containers that run there, and name the instance type."""
    cloud, argument, default, kind, default_kind, image = MACHINES[type(machine).__name__]
    place = (
        attempt(lambda: said(machine.word(argument, default)), f"{argument} is", machine.place, "") if argument else ""
    )
    if cloud == "gcp" and place:
        place = f"{place.rpartition('-')[0]}/{place}"
    infra = f"{cloud}/{place}" if place else cloud
    if infra not in FOUND.infra:
        FOUND.infra.append(infra)
    if kind:
        instance = machine.word(kind, default_kind)
        is_known = isinstance(instance, str) and not marked(instance)
        keep = f"={instance} is not taken over: fogspec finds the type; to keep it, write hardware.allow: [{instance}]"
        note(machine.place, f"{kind}{keep}" if is_known else f"{kind} is not taken over: fogspec finds the type")
    own = machine.given.get(image)
    if image == "container_image" and isinstance(own, str) and not marked(own):
        FOUND.image = own
    elif own is not None:
        note(machine.place, f"{image} is not taken over: ros.image is a container image")
    for word in sorted(machine.given.keys() - {argument, kind, image}):
        note(machine.place, f"{word} of {type(machine).__name__} is not taken over")
    for cmd, where_made in machine.__dict__.pop("containers", []):
        _container(cmd, where_made)


def _container(command: Any, place: Place) -> None:
    """Take over a container's command line as a process of the cloud; FogROS2's latency analyser as the probe."""
    text = attempt(lambda: said(command), "a container is", place)
    if text is None:
        return
    timed = {PROBE[key]: value for key, value in TIMED.findall(text)}
    if "request" in timed and "response" in timed:
        FOUND.probe |= timed
    elif argv := split(text):
        is_plain = not re.search(r"[$&|;<>`*~]", text)
        FOUND.cloud.append({"cmd": argv if is_plain else ["bash", "-c", text], "place": place})
        FOUND.said_cloud = True


def _stream(topic: str, transport: str) -> None:
    """Start the pair of republishers that FogROS2 starts for a streamed topic."""
    packed = f"{topic}/{transport}"
    common = {"package": "image_transport", "executable": "republish"}
    cloud = {f"in/{transport}": packed, "out": f"{topic}/cloud"}
    robot = {"in": topic, f"out/{transport}": packed}
    FOUND.cloud.append({**common, "name": "republish_node", "remappings": cloud, "arguments": [transport, "raw"]})
    FOUND.robot.append({**common, "name": "republish_node2", "remappings": robot, "arguments": ["raw", transport]})


def _described() -> None:
    """Take over the descriptions that were made."""
    while MADE:
        made = MADE.pop(0)
        if applies(made):
            FOUND.said_cloud = True
            places = PLACES.get(made.place[:2], {})
            for name, value in made.given.items():
                _take(name, value, places.get(name, made.place))


def _take(name: str, value: Any, place: Place) -> None:
    if name in ("constraint", "constraints"):
        _constraints(value, place)
    elif name == "accelerators" or is_constraint(name):
        _constraint(name, value, place)
    elif isinstance(value, Unknown):
        note(value._place, f"{name} of SkyLaunchDescription is not taken over: {value._why}")
    elif name in TAKEN:
        TAKEN[name](value, place)
    elif name == "ami":
        note(place, "ami is not taken over: ros.image is a container image")
    elif name not in UNUSED and may_be_constraint(name):
        _constraint(name, value, place)
    elif name not in UNUSED:
        note(place, f"{name} of SkyLaunchDescription is not taken over")


def _constraints(value: Any, place: Place) -> None:
    FOUND.constrained = True
    if not isinstance(value, dict):
        note(place, UNREADABLE)
        FOUND.constraints |= {"latency": None, "cost": None}
        return
    for key, one in value.items():
        _constraint(str(key), one, place)


def _constraint(name: str, value: Any, place: Place) -> None:
    """Take over one constraint, or leave its field empty and report it where it is written."""
    FOUND.constrained = True
    report = take_constraint(FOUND, name, UNREAD if isinstance(value, Unknown) or marked(value) else value)
    if report:
        note(place, report)


def _nodes(value: Any, place: Place) -> None:
    before = len(FOUND.robot)
    visit(value)
    FOUND.cloud += FOUND.robot[before:]
    del FOUND.robot[before:]


def _setup(value: Any, place: Place) -> None:
    some = (attempt(partial(said, one), "a command is", place) for one in value or [])
    FOUND.setup += [text for text in some if text]


def _containers(value: Any, place: Place) -> None:
    for one in value or []:
        _container(one, place)


def _run(value: Any, place: Place) -> None:
    """Take over the lines that run on the machine: what installs something is setup, each other line is a process."""
    for one in value or []:
        if PREPARES.match(perform(one)) if not marked(perform(one)) else False:
            _setup([one], place)
        else:
            _container(one, place)


TAKEN: dict[str, Callable[[Any, Place], None]] = {
    "nodes": _nodes, "additional_setup_commands": _setup, "containers": _containers, "additional_run_commands": _run,
}  # fmt: skip
AFTER.append(_described)
