"""launch_ros' actions: nodes, containers of components and processes, as the spec writes them."""

import os
import shlex
from functools import partial
from typing import Any

from fogspec.importers.launch.found import ros_words, tidy
from fogspec.importers.launch.sandboxed.actions import action, flag
from fogspec.importers.launch.sandboxed.context import CONTEXT, FOUND, all_said, environment, perform, said
from fogspec.importers.launch.sandboxed.made import NAMES, Action, Made, applies, make, unread, where
from fogspec.importers.launch.sandboxed.parameters import divided, file_of, sequence, taken
from fogspec.importers.launch.sandboxed.values import Place, Unknown, about, attempt, note

NODE = {
    "package", "executable", "name", "namespace", "parameters", "remappings", "arguments", "ros_arguments", "additional_env",
    "prefix", "respawn", "respawn_delay", "composable_node_descriptions", "node_name", "node_executable", "node_namespace",
    "autostart",
}  # fmt: skip
LOADS: list[tuple[str, list[dict[str, Any]], Place]] = []  # components for a container that is started elsewhere
MANAGED: list[tuple[str, Place]] = []  # the names of nodes that launch does not activate by itself, though they need it


def full_name(raw: dict[str, Any]) -> str:
    """Return a node's full name."""
    return f"{(raw.get('namespace') or '').rstrip('/')}/{raw.get('name') or ''}"


def start(raw: dict[str, Any], cloud: bool = False) -> None:
    """Record what starts."""
    (FOUND.cloud if cloud else FOUND.robot).append(tidy(raw))


def is_cloud(made: Made) -> bool:
    """Whether FogROS2 starts this on a cloud machine."""
    return made.given.get("to_cloud") is True or type(made).__name__ == "CloudNode"


def text_of(made: Made, *names: str) -> str | None:
    """Return an argument's text; note and return None if only a launch determines it."""
    for name in names:
        if (value := made.given.get(name)) is not None:
            found: str | None = attempt(partial(said, value), f"{name} is", where(value) or made.place)
            return found
    return None


def joined(pushed: str | None, own: str | None) -> str | None:
    """Return a namespace below the pushed one, absolute."""
    if pushed is None and own is None:
        return None
    both = pushed if own is None else own if not pushed or own.startswith("/") else f"{pushed.rstrip('/')}/{own}"
    return "/" + str(both).strip("/")


def _namespace(made: Made) -> str | None:
    full = joined(CONTEXT.launch_configurations.get("ros_namespace"), text_of(made, "namespace", "node_namespace"))
    return None if full == "/" else full


def _remappings(items: Any, place: Place) -> dict[str, str]:
    found: dict[str, str] = {}
    for pair in CONTEXT.launch_configurations.get("ros_remaps", []):
        found.setdefault(*pair)  # the first rule for a name is the one that has an effect
    if isinstance(items, Unknown):
        note(items._place, f"remappings are not taken over: {items._why}")
        return found
    for one in items or []:
        if not isinstance(one, (list, tuple)) or len(one) != 2:
            note(where(one) or place, "a remapping is not taken over: it is not a pair of names")
            continue
        pair = attempt(partial(all_said, one), "a remapping is", place)
        if pair:
            found.setdefault(*pair)
    return found


def words_of(items: Any, what: str, place: Place) -> list[str]:
    """Return a list of arguments, whole or not at all: one alone would change what the others mean."""
    if items is None:
        return []
    some = items if isinstance(items, (list, tuple)) else [items]
    found: list[str] = attempt(lambda: [said(one) for one in some], f"{what} are", place, [])
    return found


def _started(made: Made) -> dict[str, Any]:
    """Return how a process is started: its environment, and the spec's words for launch, such as prefix and respawn."""
    env, own = environment(made.place), made.word("additional_env", {})
    if isinstance(own, Unknown):
        note(own._place, f"the environment is not taken over: {own._why}")
        own = {}
    for key, value in own.items():
        pair = attempt(partial(all_said, (key, value)), f"the environment variable {key} is", made.place)
        env |= {pair[0]: pair[1]} if pair else {}
    prefix = text_of(made, "prefix")
    words: dict[str, Any] = {"prefix": prefix} if prefix else {}
    delay = attempt(lambda: _number(made.word("respawn_delay", 0.0)), "respawn_delay is", made.place, 0.0)
    if attempt(lambda: flag(made, "respawn", False), "respawn is", made.place, False):
        words["respawn"] = True
        words |= {"respawn_delay": f"{delay:g}s"} if delay > 0 else {}
    return {"env": env, "launch": words}


def _number(value: Any) -> float:
    try:
        return float(said(value))
    except ValueError:
        return 0.0


class Node(Action):
    """A node; what it was given can be read."""

    def __getattr__(self, name: str) -> Any:
        if name in NODE or name in ("plugin", "extra_arguments"):
            return self.__dict__.setdefault("given", {}).get(name)
        return super().__getattr__(name)

    def execute(self, context: Any) -> None:
        """Record the node."""
        raw = node(self)
        if raw is not None:
            start(raw, is_cloud(self))


def node(made: Made) -> dict[str, Any] | None:
    """Return a node as the spec has it; None if its package or executable is not known."""
    package, executable = text_of(made, "package"), text_of(made, "executable", "node_executable")
    if executable is None or (package is None and made.package is not None):
        note(made.place, "a node without a known package and executable is left out")
        return None
    raw: dict[str, Any] = {"package": package, "executable": executable, "name": text_of(made, "name", "node_name")}
    with about(raw["name"] or executable):
        _fill(raw, made)
    return raw if package is not None else _without_package(raw)


def _fill(raw: dict[str, Any], made: Made) -> None:
    raw |= {"namespace": _namespace(made), "place": made.place}
    raw |= divided(sequence(made.parameters, made.place), full_name(raw), made.place)
    raw["remappings"] = _remappings(made.remappings, made.place)
    raw["arguments"] = words_of(made.arguments, "arguments", made.place)
    if ros := words_of(made.ros_arguments, "ros_arguments", made.place):
        raw["arguments"] += ["--ros-args", *ros, "--"]
    started = _started(made)
    if raw.pop("allow_substs"):
        started["launch"]["allow_substs"] = True
    if _autostart(made, raw):
        started["launch"]["autostart"] = True
    raw |= started
    if (some := made.composable_node_descriptions) is not None:
        raw["composable_node_descriptions"] = components(some, made.place)
    unread(made)


def _autostart(made: Made, raw: dict[str, Any]) -> bool:
    """Return whether launch activates a node; keep the name of one that is managed and that it does not activate."""
    if not attempt(lambda: flag(made, "autostart", False), "autostart is", made.place, False):
        if isinstance(made, (LifecycleNode, ComposableLifecycleNode)) and raw["name"]:
            MANAGED.append((raw["name"], made.place))
        return False
    if raw["name"] and "$(" not in raw["name"] and raw["package"]:
        return True
    note(
        made.place, "autostart is not taken over: a spec has it for nodes of a package, with a name that is known here"
    )
    return False


def activated() -> None:
    """Note the managed nodes that nothing activates."""
    managers = [one.get("parameters", {}).get("node_names", ()) for one in [*FOUND.cloud, *FOUND.robot]]
    for name, place in MANAGED:
        if not any(name in some for some in managers):
            fix = "write launch: {autostart: true}, or autostart: true for a component"
            note(place, f"{name} is a managed node, which nothing in the spec activates: {fix}")


def _without_package(raw: dict[str, Any]) -> dict[str, Any]:
    """Return a node whose executable is a path as a plain process with the same arguments."""
    argv = [*shlex.split(raw["launch"].pop("prefix", "")), raw["executable"], *raw["arguments"], *ros_words(raw)]
    return {"cmd": argv, **{key: raw.get(key) for key in ("launch", "env", "place")}}


NAMES["launch_ros"] |= {"Node": Node, "RosNode": Node}
for _name in ("ComposableNodeContainer", "ComposableNodeContainerExtended"):
    make("launch_ros", _name, base=Node)
LifecycleNode = make("launch_ros", "LifecycleNode", base=Node)
ComposableNode = make("launch_ros", "ComposableNode", base=Node)
ComposableLifecycleNode = make("launch_ros", "ComposableLifecycleNode", base=ComposableNode)


def components(items: Any, place: Place) -> list[dict[str, Any]]:
    """Return the components of a container."""
    found = []
    for one in items if isinstance(items, (list, tuple)) else [items]:
        if not isinstance(one, ComposableNode):
            why = one._why if isinstance(one, Unknown) else "only a launch determines it"
            note(where(one) or place, f"a component is not taken over: {why}")
            continue
        if not applies(one):
            continue
        package, plugin = text_of(one, "package"), text_of(one, "plugin", "node_plugin")
        if package is None or plugin is None:
            note(one.place, "a component without a known package and plugin is left out")
            continue
        raw: dict[str, Any] = {
            "package": package,
            "plugin": plugin,
            "name": text_of(one, "name", "node_name"),
            "extra_arguments": {},
        }
        with about(raw["name"] or plugin):
            raw["namespace"] = _namespace(one)
            for values in sequence(one.extra_arguments, one.place, pushed=False):
                raw["extra_arguments"] |= values if isinstance(values, dict) else {}
            raw["autostart"] = _autostart(one, raw)
            raw |= divided(sequence(one.parameters, one.place), full_name(raw), one.place)
            found.append(tidy({**raw, "remappings": _remappings(one.remappings, one.place)}))
            unread(one)
    return found


@action("ExecuteProcess")
def ExecuteProcess(self: Made, context: Any) -> None:
    """Record a process."""
    cmd = self.given.get("cmd")
    argv = words_of(cmd if isinstance(cmd, (list, tuple)) else [cmd], "cmd", self.place) if cmd is not None else []
    if not argv:
        note(self.place, "a process whose command is not known is left out")
        return
    with about(os.path.basename(argv[0])):
        raw = _started(self)
        shell = attempt(lambda: flag(self, "shell", False), "shell is", self.place, False)
        self.given.get("name")  # of a process, which launch prints
        unread(self)
    argv = [*shlex.split(raw["launch"].pop("prefix", "")), *argv]
    start({**raw, "cmd": ["sh", "-c", " ".join(argv)] if shell else argv, "place": self.place}, is_cloud(self))


make("launch", "ExecuteLocal", base=ExecuteProcess)


@action("LoadComposableNodes", "composable_node_descriptions", "target_container", library="launch_ros")
def _load(self: Made, context: Any) -> None:
    some, target = components(self.composable_node_descriptions, self.place), self.target_container
    if isinstance(target, Node):
        name: str | None = full_name({"namespace": _namespace(target), "name": text_of(target, "name", "node_name")})
    else:
        name = attempt(lambda: said(target), "components are", self.place)
    if name is not None:
        LOADS.append((name if name.startswith("/") else f"/{name}", some, self.place))


def load() -> None:
    """Load components into the containers that were started."""
    containers: dict[str, dict[str, Any]] = {}
    for one in [*FOUND.cloud, *FOUND.robot]:
        if one.get("name"):
            containers.setdefault(full_name(one), one)
    for name, some, place in LOADS:
        container = containers.get(name)
        if container is None or "package" not in container:
            note(place, f"components are not taken over: this launch file does not start their container {name}")
        elif some:
            container.setdefault("composable_node_descriptions", []).extend(some)


def _push_namespace(self: Made, context: Any) -> None:
    before = context.launch_configurations.get("ros_namespace")
    context.launch_configurations["ros_namespace"] = joined(before, said(self.namespace))


for _name in ("PushRosNamespace", "PushROSNamespace"):
    action(_name, "namespace", library="launch_ros")(_push_namespace)


@action("SetRemap", "src", "dst", library="launch_ros")
def _set_remap(self: Made, context: Any) -> None:
    context.launch_configurations.setdefault("ros_remaps", []).append((said(self.src), said(self.dst)))


def _push(context: Any, value: Any) -> None:
    context.launch_configurations.setdefault("global_params", []).append(value)


@action("SetParameter", "name", "value", library="launch_ros")
def _set_parameter(self: Made, context: Any) -> None:
    if values := taken({self.name: self.value}, self.place):
        _push(context, values)


@action("SetUseSimTime", "value", library="launch_ros")
def _set_sim_time(self: Made, context: Any) -> None:
    note(self.place, "SetUseSimTime is not taken over: it sets the clock of launch's own node, not that of the nodes")


@action("SetParametersFromFile", "filename", library="launch_ros")
def _set_parameters(self: Made, context: Any) -> None:
    _push(context, file_of(perform(self.filename)))
