"""What XML and YAML launch files have in common: entities with attributes, which make the same actions as Python's classes."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from fogspec.spec.launch_import.found import Made, Place, Unknown
from fogspec.spec.launch_import.nodes import split
from fogspec.spec.launch_import.program import Named
from fogspec.spec.launch_import.text import NotText, parse_text

OF_ROS1 = {"machine", "rosparam", "test"}
ROS1_ATTRIBUTES = {"type", "ns", "clear_params", "required", "machine"}
TYPES = {"str": "str", "string": "str", "int": "int", "float": "float", "double": "float", "bool": "bool"}


@dataclass(slots=True)
class Entity:
    """An element of XML, or an entry of YAML: its attributes, and what is in it, in order."""

    tag: str
    attributes: dict[str, Any]
    place: Place
    inside: list["Entity"] = field(default_factory=list)

    def below(self, tag: str) -> list["Entity"]:
        """Return what is in it with this tag."""
        return [one for one in self.inside if one.tag == tag]

    def text(self, name: str) -> Any:
        """Return an attribute's texts and substitutions; None if it is not there."""
        value = self.attributes.get(name)
        return None if value is None else parsed(value, self.place)


def parsed(value: Any, place: Place) -> Any:
    """Return the texts and substitutions of an attribute."""
    if not isinstance(value, str):
        return value
    parts = _parts(value, place)
    if not isinstance(parts, list):
        return parts
    return "".join(parts) if all(isinstance(one, str) for one in parts) else Made("Text", parts, {}, place)


def _parts(value: str, place: Place) -> list[Any] | Unknown:
    try:
        return parse_text(value, place)
    except NotText as wrong:
        return Unknown(place, f"'{value[:60]}' cannot be read: {wrong}")


def is_ros1(entity: Entity) -> bool:
    """Whether a launch file is one of ROS 1: its nodes have a type, its substitutions say arg or find."""

    def old(one: Entity) -> bool:
        if one.tag in OF_ROS1 or (one.tag == "node" and "type" in one.attributes and "exec" not in one.attributes):
            return True
        return any(
            isinstance(value, str) and ("$(find " in value or "$(arg " in value) for value in one.attributes.values()
        )

    seen = [entity]
    while seen:
        one = seen.pop()
        if old(one):
            return True
        seen += one.inside
    return False


def actions(entities: list[Entity]) -> list[Any]:
    """Return the actions of entities."""
    return [action(one) for one in entities]


def action(entity: Entity) -> Any:
    """Return an entity's action, with its condition."""
    do = TAGS.get(entity.tag)
    if do is None:
        return Made(f"<{entity.tag}>", [], {}, entity.place)
    made = do(entity)
    for name, kind in (("if", "IfCondition"), ("unless", "UnlessCondition")):
        if name in entity.attributes:
            made.words["condition"] = Made(kind, [entity.text(name)], {}, entity.place)
    return made


def _simple(kind: str, **names: str) -> Callable[[Entity], Made]:
    def do(entity: Entity) -> Made:
        words = {word: entity.text(name) for word, name in names.items() if name in entity.attributes}
        return Made(kind, [], words, entity.place)

    return do


def _group(entity: Entity) -> Made:
    words: dict[str, Any] = {name: entity.text(name) for name in ("scoped", "forwarding") if name in entity.attributes}
    words["launch_configurations"] = {
        str(one.attributes.get("name")): one.text("value") for one in entity.below("keep")
    }
    words["actions"] = actions([one for one in entity.inside if one.tag != "keep"])
    return Made("GroupAction", [], words, entity.place)


def _include(entity: Entity) -> Made:
    given = [(one.text("name"), one.text("value")) for one in [*entity.below("arg"), *entity.below("let")]]
    return Made("IncludeLaunchDescription", [entity.text("file")], {"launch_arguments": given}, entity.place)


def _node(entity: Entity, kind: str = "Node") -> Made:
    names = {
        "package": "pkg", "executable": "exec", "name": "name", "namespace": "namespace", "prefix": "launch-prefix",
        "respawn": "respawn", "respawn_delay": "respawn_delay", "cwd": "cwd", "on_exit": "on_exit", "shell": "shell",
    }  # fmt: skip
    words = {word: entity.text(name) for word, name in names.items() if name in entity.attributes}
    for word, name in (("arguments", "args"), ("ros_arguments", "ros_args")):
        if name in entity.attributes:
            words[word] = command_line(entity.attributes[name], entity.place)
    if "namespace" not in words and "ns" in entity.attributes:
        words["namespace"] = entity.text("ns")
    words["remappings"] = [(one.text("from"), one.text("to")) for one in entity.below("remap")]
    words["parameters"] = [one for below in entity.below("param") for one in _parameter(below)]
    words["additional_env"] = {str(one.attributes.get("name")): one.text("value") for one in entity.below("env")}
    if kind != "Node":
        words["composable_node_descriptions"] = [_component(one) for one in entity.below("composable_node")]
    return Made(kind, [], words, entity.place)


def _component(entity: Entity) -> Made:
    names = {"package": "pkg", "plugin": "plugin", "name": "name", "namespace": "namespace"}
    words: dict[str, Any] = {word: entity.text(name) for word, name in names.items() if name in entity.attributes}
    words["remappings"] = [(one.text("from"), one.text("to")) for one in entity.below("remap")]
    words["parameters"] = [one for below in entity.below("param") for one in _parameter(below)]
    words["extra_arguments"] = [one for below in entity.below("extra_arg") for one in _parameter(below)]
    for name, kind in (("if", "IfCondition"), ("unless", "UnlessCondition")):
        if name in entity.attributes:
            words["condition"] = Made(kind, [entity.text(name)], {}, entity.place)
    return Made("ComposableNode", [], words, entity.place)


def _load(entity: Entity) -> Made:
    target = entity.text("target")
    some = [_component(one) for one in entity.below("composable_node")]
    return Made(
        "LoadComposableNodes", [], {"target_container": target, "composable_node_descriptions": some}, entity.place
    )


def _executable(entity: Entity) -> Made:
    made = _node(entity)
    words = {
        key: value
        for key, value in made.words.items()
        if key in ("prefix", "respawn", "respawn_delay", "cwd", "on_exit", "shell")
    }
    words |= {
        "cmd": command_line(entity.attributes.get("cmd", ""), entity.place),
        "additional_env": made.words["additional_env"],
    }
    return Made("ExecuteProcess", [], words, entity.place)


def _parameter(entity: Entity) -> list[Any]:
    """Return what launch_ros makes of a <param>: a file, or a dictionary with one name."""
    if "from" in entity.attributes:
        allowed = entity.attributes.get("allow_substs")
        allowed = parsed(allowed, entity.place) if isinstance(allowed, str) else allowed
        return [Made("ParameterFile", [entity.text("from"), allowed], {}, entity.place)]
    return [{str(entity.attributes.get("name", "")): _value(entity)}]


def _value(entity: Entity) -> Any:
    nested = entity.below("param")
    if nested:
        found: dict[str, Any] = {}
        for one in nested:
            found[str(one.attributes.get("name", ""))] = _value(one)
        return found
    value: Any = entity.attributes.get("value")
    if value is None:
        return Unknown(entity.place, "it has neither a value nor parameters in it")
    kind = entity.attributes.get("type")
    glue = entity.attributes.get("value-sep")
    if isinstance(value, str) and isinstance(glue, str):
        value = [_scalar(one) for one in value.split(glue)]
        if kind is None:
            return value
    if kind is None:
        given = parsed(value, entity.place)
        return Made("ParameterValue", [given], {}, entity.place) if isinstance(value, str) else given
    name = str(kind)
    listed = name.startswith("list_of_")
    known = TYPES.get(name.removeprefix("list_of_").removesuffix("s") if listed else name)
    if known is None:
        return Unknown(entity.place, f"its type {name} is not known")
    return Made(
        "ParameterValue",
        [parsed(value, entity.place), Named(f"list.{known}" if listed else f"builtins.{known}")],
        {},
        entity.place,
    )


def _scalar(text: str) -> Any:
    from fogspec.base.yaml.reader11 import NotYaml, read11_text

    try:
        value = read11_text(text.strip())
    except NotYaml:
        return text
    return value if isinstance(value, (bool, int, float, str)) else text


def command_line(value: Any, place: Place) -> Any:
    """Return the words of a command line: what a substitution gives stays one word with what touches it."""
    parts = _parts(value, place) if isinstance(value, str) else Unknown(place, "a command line must be a text")
    if not isinstance(parts, list):
        return parts
    found: list[list[Any]] = []
    current: list[Any] = []

    def end() -> None:
        nonlocal current
        if current:
            found.append(current)
        current = []

    for one in parts:
        if not isinstance(one, str):
            current.append(one)
            continue
        tokens = split(one)
        if not tokens:
            end()
            continue
        if one[0].isspace():
            end()
        for i, token in enumerate(tokens):
            if i:
                end()
            current.append(token)
        if one[-1].isspace():
            end()
    end()
    return found


def _timer(entity: Entity) -> Made:
    return Made("TimerAction", [entity.text("period"), actions(entity.inside)], {}, entity.place)


def _let(entity: Entity) -> Made:
    return Made("SetLaunchConfiguration", [entity.text("name"), entity.text("value")], {}, entity.place)


def _arg(entity: Entity) -> Made:
    if "value" in entity.attributes:
        return _let(entity)
    return Made("DeclareLaunchArgument", [entity.text("name")], {"default_value": entity.text("default")}, entity.place)


def _set_parameter(entity: Entity) -> Made:
    # A text, even one without substitutions, is read as YAML.
    return Made(
        "SetParameter", [entity.text("name"), Made("Text", [entity.text("value")], {}, entity.place)], {}, entity.place
    )


TAGS: dict[str, Callable[[Entity], Made]] = {
    "arg": _arg,
    "let": _let,
    "node": _node,
    "lifecycle_node": _node,
    "node_container": lambda entity: _node(entity, "ComposableNodeContainer"),
    "load_composable_node": _load,
    "executable": _executable,
    "include": _include,
    "group": _group,
    "timer": _timer,
    "ros_timer": _timer,
    "set_env": _simple("SetEnvironmentVariable", name="name", value="value"),
    "unset_env": _simple("UnsetEnvironmentVariable", name="name"),
    "append_env": _simple("AppendEnvironmentVariable", name="name", value="value", prepend="prepend"),
    "push-ros-namespace": _simple("PushROSNamespace", namespace="namespace"),
    "push_ros_namespace": _simple("PushROSNamespace", namespace="namespace"),
    "set_remap": _simple("SetRemap", src="from", dst="to"),
    "set_parameter": _set_parameter,
    "set_use_sim_time": _simple("SetUseSimTime", value="value"),
    "set_parameters_from_file": _simple("SetParametersFromFile", filename="filename"),
    "log": _simple("LogInfo"),
    "log_info": _simple("LogInfo"),
    "set_ros_log_dir": _simple("SetROSLogDir"),
    "shutdown": _simple("Shutdown"),
    "reset": _simple("ResetLaunchConfigurations"),
}  # fmt: skip
