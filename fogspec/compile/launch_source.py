"""Write nodes as Python launch files have them: the same lines for the deployment and for a measured container."""

import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import zip_longest
from typing import Any

from fogspec.base.templates import python, render
from fogspec.language.launch_text import CLASSES, Substitution, has_allowed, has_substitution, imports, parts
from fogspec.language.schema import ComposableNode, Node

WRITTEN = "written("  # the launch file's own function


def node_launch(node: Node) -> str:
    """Return a launch file that starts one node, for a measurement: it ends with the node."""
    once = node.model_copy(update={"launch": node.launch.model_copy(update={"respawn": False})})
    return render("node.launch.py.j2", **words([once]), together=True)


def words(nodes: Sequence[Node], labels: Sequence[str | None] = ()) -> dict[str, Any]:
    """Return the template values for nodes: what is imported, and how each one is written.

    `labels` are the names that launch writes in front of what the nodes print, None for its own.
    """
    ros = [node for node in nodes if node.cmd is None]
    substitutions = {module: sorted(names) for module, names in imports(list(nodes)).items()}
    containers = [node for node in ros if node.composable_node_descriptions]
    described = (["ParameterFile"] if _files_with(ros) else []) + (["ParameterValue"] if _values_with(ros) else [])
    return {
        "nodes": [_written(node, label) for node, label in zip_longest(nodes, labels)],
        "has_nodes": bool(ros),
        "writes": any(one.startswith(WRITTEN) for node in ros for one in _parameters(node, 0)),
        "has_processes": len(ros) < len(nodes),
        "substitutions": sorted(substitutions.items()),
        "ros_actions": (["ComposableNodeContainer"] if containers else [])
        + (["Node"] if len(containers) < len(ros) else []),
        "descriptions": (["ComposableNode"] if containers else []) + described,
    }


def flat(parameters: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield parameters by their full names, sorted."""
    for key, value in sorted(parameters.items()):
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _all(nodes: Sequence[Node]) -> list[Node | ComposableNode]:
    return [*nodes, *(one for node in nodes for one in node.composable_node_descriptions)]


def _files_with(nodes: Sequence[Node]) -> bool:
    return any(has_allowed(node) or has_substitution(file) for node in _all(nodes) for file in node.parameter_files)


def _values_with(nodes: Sequence[Node]) -> bool:
    return any("ParameterValue(" in _value(node.parameters) for node in _all(nodes))


def _written(node: Node, label: str | None) -> dict[str, Any]:
    """Return each argument of a node's action as a Python expression, in the order of launch_ros' documentation."""
    delay_s = node.launch.respawn_delay
    common = {
        "additional_env": _map(node.env) if node.env else None,
        "respawn": "True" if node.launch.respawn else None,
        "respawn_delay": repr(float(delay_s)) if node.launch.respawn and delay_s else None,
    }
    if node.cmd is not None:
        named = repr(label) if label else None
        argv = {"cmd": _list([*node.cmd, *node.arguments], 12), "name": named, "cwd": "str(SPEC)"}
        return {"kind": "ExecuteProcess", "words": _set({**argv, **common}), "respawn": node.launch.respawn}
    words: dict[str, Any] = {
        "package": _text(str(node.package)),
        "executable": _text(str(node.executable)),
        **_named(node, 12),
        "exec_name": repr(label) if label else None,
        "arguments": _list(node.arguments, 12) if node.arguments else None,
        "prefix": _text(node.launch.prefix) if node.launch.prefix else None,
        **common,
    }
    kind = "Node"
    if node.composable_node_descriptions:
        kind = "ComposableNodeContainer"
        # launch_ros asks for both words.
        words["name"] = words["name"] or repr("")
        words["namespace"] = words["namespace"] or repr("")
        lines = "".join(_component(one) for one in node.composable_node_descriptions)
        words["composable_node_descriptions"] = f"[\n{lines}            ]"
    return {"kind": kind, "words": _set(words), "respawn": node.launch.respawn}


def _component(node: ComposableNode) -> str:
    words = {
        "package": _text(node.package),
        "plugin": _text(node.plugin),
        **_named(node, 20),
        "extra_arguments": f"[{_value(node.extra_arguments, 20)}]" if node.extra_arguments else None,
    }
    inner = "".join(f"                    {key}={value},\n" for key, value in _set(words).items())
    return f"                ComposableNode(\n{inner}                ),\n"


def _named(node: Node | ComposableNode, indent: int) -> dict[str, str | None]:
    """Return what nodes and components have in common."""
    parameters = None
    if node.parameters or node.parameter_files:
        inner = " " * (indent + 4)
        lines = [f"{inner}{_file(file, has_allowed(node))},\n" for file in node.parameter_files]
        lines += [f"{inner}{one},\n" for one in _parameters(node, indent + 4)]
        parameters = "[\n" + "".join(lines) + " " * indent + "]"
    pairs = list(node.remappings.items())
    return {
        "name": _text(node.name) if node.name else None,
        "namespace": _text(node.namespace) if node.namespace else None,
        "parameters": parameters,
        "remappings": python(pairs, indent) if pairs else None,
    }


def _parameters(node: Node | ComposableNode, indent: int) -> Iterator[str]:
    """Yield the parameters as launch takes them.

    Those of a node come in a file that the launch file writes, where all texts have quotes: to ROS 2 some are numbers or truth
    values without, such as 1e3, 08, nan and y, and launch writes those without. What launch is to substitute stays with it.
    """
    if isinstance(node, ComposableNode):
        if node.parameters:
            yield _value(node.parameters, indent)
        return
    named = dict(flat(node.parameters))
    left = {name: value for name, value in named.items() if _substitutes(value)}
    if written := {name: value for name, value in named.items() if name not in left}:
        yield f"{WRITTEN}{python(written, indent)})"
    if left:
        yield _value(left, indent)


def _substitutes(value: Any) -> bool:
    return any(
        isinstance(one, str) and has_substitution(one) for one in (value if isinstance(value, list) else [value])
    )


def _set(words: dict[str, str | None]) -> dict[str, str]:
    return {key: value for key, value in words.items() if value is not None}


def _file(path: str, allow_substs: bool) -> str:
    where = _text(path) if has_substitution(path) else f"str(SPEC / {path!r})"
    return (
        f"ParameterFile({where}, allow_substs=True)"
        if allow_substs
        else f"ParameterFile({where})"
        if where[0] == "["
        else where
    )


def _text(text: str) -> str:
    """Return a text as launch takes it: as it is, or as a list of substitutions."""
    some = parts(text)
    if not any(isinstance(one, Substitution) for one in some):
        return repr(text)
    return "[" + ", ".join(repr(one) if isinstance(one, str) else _substitution(one) for one in some) + "]"


def _substitution(one: Substitution) -> str:
    return f"{CLASSES[one.name][1]}({_text(one.given)})"


def _list(items: Sequence[str], indent: int) -> str:
    if not any(map(has_substitution, items)):
        return python(list(items), indent)
    inner = " " * (indent + 4)
    return "[\n" + "".join(f"{inner}{_text(one)},\n" for one in items) + " " * indent + "]"


def _map(values: dict[str, str]) -> str:
    if not any(map(has_substitution, values.values())):
        return python(values, 12)
    lines = "".join(f"                {key!r}: {_text(one)},\n" for key, one in values.items())
    return "{\n" + lines + "            }"


def _value(values: Any, indent: int = 0) -> str:
    """Return parameters as a Python expression; a text with substitutions stays a text for launch_ros."""
    if isinstance(values, str) and has_substitution(values):
        return f"ParameterValue({_text(values)}, value_type=str)"
    if isinstance(values, dict) and "$(" in json.dumps(values, default=str):
        inner = " " * (indent + 4)
        lines = "".join(f"{inner}{key!r}: {_value(one, indent + 4)},\n" for key, one in values.items())
        return "{\n" + lines + " " * indent + "}"
    if isinstance(values, list) and any(isinstance(one, str) and has_substitution(one) for one in values):
        # Each item is a list of substitutions of its own, else launch_ros would make one text of all.
        return (
            "[" + ", ".join(_text(one) if has_substitution(one) else f"[{json.dumps(one)!r}]" for one in values) + "]"
        )
    return python(values, indent)
