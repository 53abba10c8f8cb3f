"""Rules about nodes, their names, parameters and topics."""

import re
from collections.abc import Iterator
from posixpath import normpath
from typing import Any

from fogspec.agent.graph_variables import RMW, is_of_graph
from fogspec.base.yaml.positions import Path, dotted
from fogspec.language.launch_text import STARTS, has_substitution
from fogspec.language.lockfile import REGISTRY_LOGIN, registry_login
from fogspec.language.named_files import all_nodes
from fogspec.language.robot_packages import MOVING_TOPIC, moving_names, why_moving
from fogspec.language.rules.finding import Finding
from fogspec.language.rules.machines import ros_block
from fogspec.language.schema import Application, ComposableNode, Node, Spec

ROS_WORDS = ("package", "executable", "name", "namespace", "parameters", "parameter_files", "remappings",
             "composable_node_descriptions")  # fmt: skip
STARTS_ROS2 = re.compile(r"(?<![\w-])ros2 (?:action|bag|control|launch|lifecycle|param|run|service|topic)\b")
LINK: Path = ("spec", "connectivity", "link")
MIDDLEWARE = re.compile(r"rmw_(?!zenoh)[a-z0-9_]+")
GRAPH_NAME = re.compile(r"(~/|/)?([A-Za-z_{][A-Za-z0-9_{}]*)(/[A-Za-z_{][A-Za-z0-9_{}]*)*|/|~")


def kind_of_node(application: Application) -> Iterator[Finding]:
    """Require package and executable, or a plain process."""
    for path, node in all_nodes(application.spec):
        said: list[Path] = [(word,) for word in ROS_WORDS if getattr(node, word)]
        said += [("launch", word) for word in ("allow_substs", "autostart", "prefix") if getattr(node.launch, word)]
        if node.cmd is not None:
            for word in said:
                message = f"{dotted((*path, *word))} is for ROS 2 nodes, and this one is a plain process"
                yield Finding(
                    "FS502", (*path, *word), message, "remove it, or remove cmd", ((*path, "cmd"),), at_key=True
                )
        elif node.package is None or node.executable is None:
            missing = (
                "executable" if node.package else "package" if node.executable else "package and executable, or cmd"
            )
            yield Finding("FS501", path, f"{dotted(path)} must say {missing}", _missing_part(node))
    for path, one in all_named(application.spec):
        wanted = one.launch.autostart and one.cmd is None if isinstance(one, Node) else one.autostart
        if wanted and (one.name is None or has_substitution(f"{one.namespace} {one.name}")):
            message = f"{dotted(path)} must say its name, by which fogspec finds it to activate it (autostart)"
            yield Finding("FS501", path, message, "add 'name: …', without a substitution")


def _missing_part(node: Node) -> str:
    """Return what to add to a node that lacks its package, its executable, or both."""
    package, slash, executable = (node.package or "").partition("/")
    if slash and package and executable:
        return f"split it: package: {package}, executable: {executable}"
    if node.package:
        return f"add 'executable: {node.package}_node', or the name that `ros2 pkg executables {node.package}` lists"
    return "add 'package: …'" if node.executable else "add 'cmd: [python3, plan.py]', or a package and its executable"


def all_named(spec: Spec) -> Iterator[tuple[Path, Node | ComposableNode]]:
    """Return every node and every component of a container with its path."""
    for path, node in all_nodes(spec):
        yield path, node
        for i, one in enumerate(node.composable_node_descriptions):
            yield (*path, "composable_node_descriptions", i), one


def environment_of_nodes(application: Application) -> Iterator[Finding]:
    """Require a ROS 2 environment, of an image or not, for what takes part in a ROS 2 graph on the machine."""
    spec, probe = application.spec, application.spec.probe
    nodes = [(path, node) for path, node in all_nodes(spec) if path[1] != "robot"]
    needs = [(path, "is a ROS 2 node") for path, node in nodes if node.package and node.executable]
    started: list[tuple[Path, list[str] | None]] = [((*path, "cmd"), node.cmd) for path, node in nodes]
    started.append((("spec", "deployment", "ready"), spec.deployment.ready))
    needs += [(path, "starts ros2") for path, argv in started if argv and STARTS_ROS2.search(" ".join(argv))]
    named: list[tuple[Path, str | None]] = [
        (("spec", "metrics", key), one.topic) for key, one in spec.metrics.items() if not one.callback
    ]
    if probe.callback is None and (probe.request is None) == (probe.response is None):  # otherwise it is wrong itself
        named += [(("spec", "probe", kind), getattr(probe, kind)) for kind in ("request", "service", "action")]
    needs += [(path, "is observed in a ROS 2 graph") for path, name in named if name is not None]
    for path, what in needs[:1] if spec.ros is None else []:
        fix = f"add '{ros_block(spec.infra)}' to spec, with its workspace, apt or image for your packages"
        yield Finding("FS503", path, f"spec.ros is missing, and {dotted(path)} {what}", fix, (("spec", "ros"),))


def what_moves_the_robot(application: Application) -> Iterator[Finding]:
    """Warn of cloud nodes that move or stop the robot: it must stop without a link, too."""
    parts = [(path, one.model_dump(exclude_defaults=True)) for path, one in all_named(application.spec)]
    moving = moving_names(one for _, one in parts)
    found = [(path, why_moving(one, moving)) for path, one in parts if path[1] == "cloud"]
    if MOVING_TOPIC.fullmatch(application.spec.probe.response or ""):
        found.append((("spec", "probe", "response"), "moves the robot from a cloud node"))
    for path, why in found:
        if why is not None:
            fix = "move the component to a container in spec.robot" if path[3:] else "move the node to spec.robot"
            message = f"{dotted(path)} {why}: the robot must be able to stop without a link"
            yield Finding("FS560", path, message, fix, severity="warning")


def respawn_of_robot(application: Application) -> Iterator[Finding]:
    """Reject `respawn: on_failure` on the robot, where launch starts nodes again."""
    for i, node in enumerate(application.spec.robot):
        if node.launch.respawn == "on_failure":
            path: Path = ("spec", "robot", i, "launch", "respawn")
            message = (
                f"{dotted(path)} is on_failure, which launch does not have: the robot's nodes are started by launch"
            )
            yield Finding("FS549", path, message, "write 'true', or remove it")


def unique_names(application: Application) -> Iterator[Finding]:
    """Reject two nodes with the same full name."""
    seen: dict[str, Path] = {}
    for path, node in all_nodes(application.spec):
        if node.name is None:
            continue
        full = f"{(node.namespace or '').rstrip('/')}/{node.name}"
        if full in seen:
            message = f"{dotted((*path, 'name'))} is the name of {dotted(seen[full])} too"
            yield Finding(
                "FS504", (*path, "name"), message, "give each node a name or namespace of its own", (seen[full],)
            )
        seen.setdefault(full, path)


def graph_names(application: Application) -> Iterator[Finding]:
    """Require names of topics, services and namespaces that ROS 2 accepts."""
    spec = application.spec
    named: list[tuple[Path, str | None]] = [
        (("spec", "probe", kind), getattr(spec.probe, kind)) for kind in ("request", "response", "service", "action")
    ]
    named += [(("spec", "metrics", key, "topic"), metric.topic) for key, metric in spec.metrics.items()]
    named += [(("spec", "connectivity", "expose", name), name) for name in spec.connectivity.expose]
    for path, node in all_named(spec):
        named.append(((*path, "namespace"), node.namespace))
        for old, new in node.remappings.items():
            named += [((*path, "remappings", old), old.partition(":=")[0]), ((*path, "remappings", old), new)]
    for path, name in named:
        if name is not None and not GRAPH_NAME.fullmatch(name):
            message = f"{dotted(path)} must be a name that ROS 2 accepts, and '{name}' is not"
            yield Finding("FS505", path, message, "use letters, digits, '_' and '/'; a digit cannot follow a '/'")


def parameter_values(application: Application) -> Iterator[Finding]:
    """Require ROS 2 parameter values: booleans, numbers, strings, lists of one of these; maps nest."""
    for path, node in all_named(application.spec):
        yield from _parameters((*path, "parameters"), node.parameters)
        if isinstance(node, ComposableNode):
            yield from _parameters((*path, "extra_arguments"), node.extra_arguments)


def _parameters(path: Path, values: dict[str, Any]) -> Iterator[Finding]:
    for key, value in values.items():
        at = (*path, key)
        if isinstance(value, dict):
            yield from _parameters(at, value)
        elif value is None:
            yield Finding(
                "FS506", at, f"{dotted(at)} must have a value: ROS 2 has no null", "give it a value, or remove it"
            )
        elif isinstance(value, list):
            kinds = {type(item) for item in value}
            if not value:
                message = f"{dotted(at)} is an empty list, which ROS 2 cannot read: it has no kind"
                yield Finding("FS506", at, message, "remove it: only a default in the node itself can be empty")
            if kinds - {bool, int, float, str} or len(kinds) > 1:
                fix = "write 1.0 for 1" if kinds == {int, float} else "write values of one kind"
                yield Finding("FS506", at, f"{dotted(at)} must hold values of one kind: ROS 2 refuses mixed lists", fix)


def paths(application: Application) -> Iterator[Finding]:
    """Require files inside the spec's directory, named relative to it: that directory is sent to the machine."""
    spec = application.spec
    named: list[tuple[Path, str | None]] = [
        (("spec", "ros", "workspace"), spec.ros.workspace if spec.ros else None),
        (("spec", "probe", "bag"), spec.probe.bag),
        (("spec", "benchmark", "workload", "bag"), spec.benchmark.workload.bag),
        *((("spec", "files", i), file) for i, file in enumerate(spec.files or [])),
    ]
    for path, node in all_named(spec):
        files = enumerate(node.parameter_files)
        named += [((*path, "parameter_files", i), file) for i, file in files if not file.startswith(STARTS)]
    for path, file in named:
        if file is not None and (not file or file[0] in "/~" or ":" in file[:3] or "\\" in file):
            name = (file or "").replace("\\", "/").rstrip("/").rpartition("/")[2] or "data/run.bag"
            fix = f"copy it next to the spec and write '{name}'"
            yield Finding("FS507", path, f"{dotted(path)} must be a path relative to the spec", fix)
    for path, node in all_nodes(spec):
        named += [((*path, "cmd", i), word) for i, word in enumerate(node.cmd or [])]
    for path, file in named:
        if file is not None and path[1] != "robot" and normpath(file).split("/")[0] == "..":
            message = f"{dotted(path)} must be in the spec's folder: nothing else is sent to a machine"
            yield Finding("FS507", path, message, f"move it there: '{normpath(file).lstrip('./')}'")


def secrets(application: Application) -> Iterator[Finding]:
    """Reject values of secrets in the spec."""
    for path, node in all_nodes(application.spec):
        for name in node.env:
            if name in application.spec.secrets:
                message = f"{dotted((*path, 'env', name))} writes down the value of a secret"
                yield Finding(
                    "FS508",
                    (*path, "env", name),
                    message,
                    "remove it: the value comes from your environment",
                    (("spec", "secrets"),),
                    at_key=True,
                )


def variables_of_the_graph(application: Application) -> Iterator[Finding]:
    """Require what is of a whole ROS 2 graph in spec.ros.env alone, and there nothing else, and nothing that a link decides."""
    spec, link, at = application.spec, application.spec.connectivity.link, ("spec", "ros", "env")
    decided = f"remove it: the link {link} decides" if link != "none" else None
    for path, node in all_nodes(spec) if spec.ros else []:
        for name in filter(is_of_graph, node.env):
            here = (*path, "env", name)
            message = f"{dotted(here)} is of the whole ROS 2 graph, and set for one process of it"
            own = "remove it: the robot's are those of its shell" if path[1] == "robot" else "move it to spec.ros.env"
            yield Finding("FS562", here, message, decided or own, at_key=True)
    for name, value in spec.ros.env.items() if spec.ros else []:
        if not is_of_graph(name):
            message = f"{dotted((*at, name))} is not of the whole ROS 2 graph"
            yield Finding("FS562", (*at, name), message, "move it to env of the nodes", at_key=True)
        elif decided:
            message = f"{dotted((*at, name))} is set by hand, and spec.connectivity.link is {link}"
            yield Finding("FS562", (*at, name), message, decided, (LINK,), at_key=True)
        elif name == RMW and not MIDDLEWARE.fullmatch(value):
            fix = (
                "write 'connectivity: {link: zenoh}' in spec"
                if "zenoh" in value
                else "write it like rmw_cyclonedds_cpp"
            )
            message = f"{dotted((*at, name))} must be a middleware that needs no router, and '{value}' is not"
            yield Finding("FS562", (*at, name), message, fix)


def login_to_a_registry(application: Application) -> Iterator[Finding]:
    """Require all of a login: SkyPilot refuses a part of it, after the machine was requested."""
    spec, path = application.spec, ("spec", "secrets")
    given = registry_login(spec)
    if not given:
        return
    at = (*path, spec.secrets.index(given[0]))
    if missing := [name for name in REGISTRY_LOGIN if name not in given]:
        message = f"spec.secrets has {given[0]}, and a login to a registry is {len(REGISTRY_LOGIN)} variables"
        yield Finding("FS557", at, message, f"add {', '.join(missing)}")
    elif spec.ros is None or spec.ros.image is None:
        message = f"spec.secrets has {given[0]}, a login to an image's registry, and spec.ros.image is missing"
        yield Finding("FS557", at, message, "name the image in spec.ros.image, or remove the login", severity="warning")


RULES = (
    kind_of_node,
    environment_of_nodes,
    what_moves_the_robot,
    respawn_of_robot,
    unique_names,
    graph_names,
    parameter_values,
    paths,
    secrets,
    variables_of_the_graph,
    login_to_a_registry,
)
