"""XML and YAML launch files: entities with attributes, which make the same objects as Python's classes."""

import xml.parsers.expat
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import yaml

from fogspec.importers.launch.sandboxed.made import NAMES, Action, Given
from fogspec.importers.launch.sandboxed.parameters import read
from fogspec.importers.launch.sandboxed.text import command_line, parsed
from fogspec.importers.launch.sandboxed.values import Fatal, Place, Refused, Unknown, whole

OF_ROS1 = {"machine", "rosparam", "test"}
TYPES: dict[str, type] = {"str": str, "string": str, "int": int, "float": float, "double": float, "bool": bool}
DEEPEST = 50
STARTED = ("respawn", "respawn_delay", "cwd", "on_exit", "shell", "autostart")


@dataclass(slots=True)
class Entity:
    """An element of XML, or an entry of YAML: its attributes, and what is in it, in order."""

    tag: str
    attributes: Given
    place: Place
    inside: list["Entity"] = field(default_factory=list)
    tags: set[str] = field(default_factory=set)  # of what in it was read
    is_action: bool = False

    def below(self, tag: str) -> list["Entity"]:
        """Return what is in it with this tag."""
        self.tags.add(tag)
        return [one for one in self.inside if one.tag == tag]

    def left(self) -> Iterator[tuple[Place, str]]:
        """Yield what of it and in it was not read."""
        yield from ((self.place, f"{name} of <{self.tag}>") for name, _ in self.attributes.left())
        for one in self.inside:
            if one.tag in self.tags:
                yield from one.left()
            elif not one.is_action:
                yield one.place, f"<{one.tag}> in <{self.tag}>"

    def text(self, name: str) -> Any:
        """Return an attribute's texts and substitutions; None if it is not there."""
        return parsed(self.attributes.get(name), self.place)

    def words(self, *same: str, **names: str) -> dict[str, Any]:
        """Return the attributes that are there, under these words: as they are called, or by the name of the attribute."""
        some = {**{one: one for one in same}, **names}
        return {word: self.text(name) for word, name in some.items() if name in self.attributes}


def entities(source: str, path: str) -> list[Any]:
    """Return a launch file's actions; raise Fatal if it is not one of ROS 2."""
    some = _yaml(source, path) if path.endswith((".yaml", ".yml")) else _xml(source, path)
    return [action(one) for one in some]


def _xml(source: str, path: str) -> list[Entity]:
    root = Entity("", Given(), whole(1, path))
    stack, parser = [root], xml.parsers.expat.ParserCreate()

    def begin(tag: str, attributes: dict[str, str]) -> None:
        place = whole(parser.CurrentLineNumber, path)
        if len(stack) > DEEPEST:
            raise Fatal(f"a launch file may be nested at most {DEEPEST} deep", place)
        stack[-1].inside.append(one := Entity(tag, Given(attributes), place))
        stack.append(one)

    def doctype(*_: object) -> None:
        raise Fatal(
            "the launch file must have one element <launch> and no DOCTYPE", whole(parser.CurrentLineNumber, path)
        )

    parser.StartElementHandler = begin
    parser.EndElementHandler = lambda _tag: stack.pop()
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(source, True)
    except xml.parsers.expat.ExpatError as wrong:
        message = f"the launch file must be XML: {xml.parsers.expat.ErrorString(wrong.code)}"
        raise Fatal(message, (path, wrong.lineno, wrong.offset + 1, 1)) from None
    top = root.inside[0]
    if top.tag != "launch":
        raise Fatal("the launch file must have one element <launch> and no DOCTYPE", whole(1, path))
    if any(map(_is_old, _all(top))):
        fix = "ROS 2 launch files say exec= for type=, and $(var x) for $(arg x); port it first"
        raise Fatal("this is a launch file of ROS 1", top.place, fix)
    return top.inside


def _all(entity: Entity) -> Iterator[Entity]:
    yield entity
    for one in entity.inside:
        yield from _all(one)


def _is_old(one: Entity) -> bool:
    """Whether an element is of ROS 1: nodes have a type, substitutions say arg or find."""
    if one.tag in OF_ROS1 or (one.tag == "node" and "type" in one.attributes and "exec" not in one.attributes):
        return True
    return any("$(find " in value or "$(arg " in value for value in one.attributes.values())


def _yaml(source: str, path: str) -> list[Entity]:
    try:
        top = yaml.compose(source, yaml.SafeLoader)
    except yaml.MarkedYAMLError as wrong:
        mark = wrong.problem_mark
        place = (path, mark.line + 1, mark.column + 1, 1) if mark else whole(1, path)
        raise Fatal(f"the launch file must be YAML: {wrong.problem}", place) from None
    except (yaml.YAMLError, ValueError) as wrong:
        raise Fatal(f"the launch file must be YAML: {wrong}", whole(1, path)) from None
    pairs = top.value if isinstance(top, yaml.MappingNode) else []
    listed = next((value for key, value in pairs if key.value == "launch"), None)
    if not isinstance(listed, yaml.SequenceNode):
        raise Fatal("the launch file must have a list under 'launch:'", whole(1, path))
    return _entities(listed, path, 0)


def _entities(node: Any, path: str, depth: int) -> list[Entity]:
    """Return the entities of a list of maps with one key each."""
    pairs = ((key, below) for item in node.value if isinstance(item, yaml.MappingNode) for key, below in item.value)
    return [_entity(str(key.value), below, whole(key.start_mark.line + 1, path), depth) for key, below in pairs]


def _entity(tag: str, node: Any, place: Place, depth: int) -> Entity:
    if depth > DEEPEST:
        raise Fatal(f"a launch file may be nested at most {DEEPEST} deep", place)
    made = Entity(tag, Given(), place)
    if isinstance(node, yaml.SequenceNode):
        made.inside = _entities(node, place[0], depth + 1)
    for key, below in node.value if isinstance(node, yaml.MappingNode) else ():
        name = str(key.value)
        if name == "children" and isinstance(below, yaml.SequenceNode):
            made.inside += _entities(below, place[0], depth + 1)
        elif isinstance(below, yaml.SequenceNode) and any(isinstance(one, yaml.MappingNode) for one in below.value):
            made.inside += [
                _entity(name, one, whole(one.start_mark.line + 1, place[0]), depth + 1) for one in below.value
            ]
        elif not isinstance(below, yaml.MappingNode):
            made.attributes[name] = yaml.SafeLoader("").construct_object(below, deep=True)
    return made


def made_of(name: str, /, *args: Any, **words: Any) -> Any:
    """Return an object of the class of this name of `launch` or `launch_ros`."""
    return (NAMES["launch"].get(name) or NAMES["launch_ros"][name])(*args, **words)


def action(entity: Entity) -> Any:
    """Return an entity's action, with its condition."""
    do, entity.is_action = TAGS.get(entity.tag), True
    made = _at(do(entity) if do else type(f"<{entity.tag}>", (Action,), {})(), entity)
    made.__dict__["left"] = [*entity.left()] if do else []
    return made


def _at(made: Any, entity: Entity) -> Any:
    """Return an object of an entity, with its place and condition."""
    made.__dict__["place"] = entity.place
    for name, kind in (("if", "IfCondition"), ("unless", "UnlessCondition")):
        if name in entity.attributes:
            made.given["condition"] = condition = made_of(kind, entity.text(name))
            condition.__dict__["place"] = entity.place
    return made


def _simple(kind: str, **names: str) -> Callable[[Entity], Any]:
    return lambda entity: made_of(kind, **entity.words(**names))


def _parameters(entity: Entity, tag: str = "param") -> list[Any]:
    return [_parameter(one) for one in entity.below(tag)]


def _parameter(entity: Entity) -> Any:
    """Return what launch_ros makes of a <param>: a file, or a dictionary with one name."""
    if "from" in entity.attributes:
        allowed = entity.text("allow_substs")
        return _at(made_of("ParameterFile", entity.text("from"), False if allowed is None else allowed), entity)
    return {str(entity.attributes.get("name", "")): _value(entity)}


def _value(entity: Entity) -> Any:
    if nested := entity.below("param"):
        return {str(one.attributes.get("name", "")): _value(one) for one in nested}
    value, kind, glue = (entity.attributes.get(name) for name in ("value", "type", "value-sep"))
    if value is None:
        return Unknown("it has neither a value nor parameters in it", entity.place)
    if isinstance(value, str) and isinstance(glue, str):
        value = [_scalar(one) for one in value.split(glue)]
    if kind is None:
        return _at(made_of("ParameterValue", parsed(value, entity.place)), entity) if isinstance(value, str) else value
    listed = str(kind).startswith("list_of_")
    known = TYPES.get(str(kind).removeprefix("list_of_").removesuffix("s") if listed else str(kind))
    if known is None:
        return Unknown(f"its type {kind} is not known", entity.place)
    kinds = list[known] if listed else known  # type: ignore[valid-type]
    return _at(made_of("ParameterValue", parsed(value, entity.place), kinds), entity)


def _scalar(text: str) -> Any:
    try:
        return read(text.strip())
    except Refused:
        return text


def _nodes_words(entity: Entity) -> dict[str, Any]:
    words = entity.words(package="pkg", executable="exec", name="name", namespace="namespace", plugin="plugin")
    if "namespace" not in words and "ns" in entity.attributes:
        words["namespace"] = entity.text("ns")
    words["remappings"] = [(one.text("from"), one.text("to")) for one in entity.below("remap")]
    return words | {"parameters": _parameters(entity)}


def _node(entity: Entity, kind: str = "Node") -> Any:
    words = _nodes_words(entity) | entity.words(*STARTED, prefix="launch-prefix")
    for word, name in (("arguments", "args"), ("ros_arguments", "ros_args")):
        if name in entity.attributes:
            words[word] = command_line(entity.attributes[name], entity.place)
    words["additional_env"] = _environment(entity)
    if kind == "ComposableNodeContainer":
        words["composable_node_descriptions"] = [_component(one) for one in entity.below("composable_node")]
    return made_of(kind, **words)


def _environment(entity: Entity) -> dict[str, Any]:
    return {str(one.attributes.get("name")): one.text("value") for one in entity.below("env")}


def _component(entity: Entity) -> Any:
    return _at(
        made_of("ComposableNode", **_nodes_words(entity), extra_arguments=_parameters(entity, "extra_arg")), entity
    )


def _load(entity: Entity) -> Any:
    some = [_component(one) for one in entity.below("composable_node")]
    return made_of("LoadComposableNodes", some, entity.text("target"))


def _executable(entity: Entity) -> Any:
    cmd = command_line(entity.attributes.get("cmd", ""), entity.place)
    words = entity.words(*STARTED, prefix="launch-prefix")
    return made_of("ExecuteProcess", cmd=cmd, additional_env=_environment(entity), **words)


def _kept(entity: Entity) -> dict[str, Any]:
    return {str(one.attributes.get("name")): one.text("value") for one in entity.below("keep")}


def _reset(entity: Entity) -> Any:
    return made_of("ResetLaunchConfigurations", _kept(entity))


def _group(entity: Entity) -> Any:
    kept = _kept(entity)
    some = [action(one) for one in entity.inside if one.tag != "keep"]
    return made_of("GroupAction", some, launch_configurations=kept, **entity.words("scoped", "forwarding"))


def _include(entity: Entity) -> Any:
    given = [(one.text("name"), one.text("value")) for one in [*entity.below("arg"), *entity.below("let")]]
    return made_of("IncludeLaunchDescription", entity.text("file"), launch_arguments=given)


def _arg(entity: Entity) -> Any:
    if "value" in entity.attributes:
        return _let(entity)
    choices = [one.attributes.get("value") for one in entity.below("choice")]
    return made_of("DeclareLaunchArgument", entity.text("name"), default_value=entity.text("default"), choices=choices)


def _timer(entity: Entity) -> Any:
    return made_of("TimerAction", entity.text("period"), [action(one) for one in entity.inside])


def _set_parameter(entity: Entity) -> Any:
    # A text, even one without substitutions, is read as YAML.
    return made_of("SetParameter", entity.text("name"), made_of("ParameterValue", entity.text("value")))


_let = _simple("SetLaunchConfiguration", name="name", value="value")
_push = _simple("PushRosNamespace", namespace="namespace")
TAGS: dict[str, Callable[[Entity], Any]] = {
    "arg": _arg, "let": _let, "node": _node, "executable": _executable, "include": _include,
    "lifecycle_node": lambda entity: _node(entity, "LifecycleNode"),
    "node_container": lambda entity: _node(entity, "ComposableNodeContainer"), "load_composable_node": _load,
    "group": _group, "timer": _timer, "ros_timer": _timer, "push-ros-namespace": _push, "push_ros_namespace": _push,
    "set_env": _simple("SetEnvironmentVariable", name="name", value="value"),
    "unset_env": _simple("UnsetEnvironmentVariable", name="name"),
    "append_env": _simple("AppendEnvironmentVariable", name="name", value="value", prepend="prepend"),
    "set_remap": _simple("SetRemap", src="from", dst="to"), "set_parameter": _set_parameter,
    "set_use_sim_time": _simple("SetUseSimTime", value="value"),
    "set_parameters_from_file": _simple("SetParametersFromFile", filename="filename"), "reset": _reset,
    "log": _simple("LogInfo", msg="message", level="level"), "log_info": _simple("LogInfo", msg="message"),
    "set_ros_log_dir": _simple("SetROSLogDir", new_log_dir="new_log_dir"), "shutdown": _simple("Shutdown", reason="reason"),
}  # fmt: skip
