"""What a spec's nodes start, in the words in which `tests/cases/launch/golden.json` has what the real launch started."""

import json
import re
import shlex
from pathlib import Path
from typing import Any

import yaml

from fogspec.compile.launch_source import flat as _flat
from fogspec.importers.launch.sandboxed.parameters import applies_to
from fogspec.language.launch_text import has_allowed
from fogspec.language.schema import ComposableNode, Node

Facts = list[dict[str, Any]]

SHARE = re.compile(r"\$\(find-pkg-share ([A-Za-z0-9_.-]+)\)")


def facts_of(nodes: list[Node], written: dict[str, str], shares: dict[str, Path]) -> Facts:
    """One fact for each process, sorted; `written` are files beside the spec, `shares` the packages that are here."""
    found = [_fact(node, written, shares) for node in nodes]
    return sorted(found, key=lambda one: json.dumps(one, sort_keys=True))


def _fact(node: Node, written: dict[str, str], shares: dict[str, Path]) -> dict[str, Any]:
    if node.cmd is not None and "--ros-args" in node.cmd:
        words = node.cmd[node.cmd.index("--ros-args") + 1 :]
        name = next(word.partition(":=")[2] for word in words if word.startswith("__node:="))
        arguments = node.cmd[1 : node.cmd.index("--ros-args")]
        return _node(node.cmd[0], arguments, node, name, [], {})
    if node.cmd is not None:
        return {"kind": "process", "argv": node.cmd, "env": node.env}
    files: list[str] = []
    values: dict[str, Any] = {}
    for path in node.parameter_files:
        text = _text(path, written, shares)
        if text is None:
            files.append(path)
        elif has_allowed(node) and path in written and (own := of_one(yaml.safe_load(text))) is not None:
            values |= dict(_flat(own))
        else:
            files.append(json.dumps(yaml.safe_load(text), sort_keys=True))
    values |= dict(_flat(node.parameters))
    fact = _node(f"<{node.package}>/{node.executable}", node.arguments, node, node.name, files, values)
    if node.composable_node_descriptions:
        some = [_component(one, written, shares) for one in node.composable_node_descriptions]
        fact["components"] = sorted(some, key=lambda one: json.dumps(one, sort_keys=True))
    return fact


def _node(
    program: str, arguments: list[str], node: Node, name: str | None, files: list[str], values: Any
) -> dict[str, Any]:
    plain = arguments[: arguments.index("--ros-args")] if "--ros-args" in arguments else arguments
    ros = [word for word in arguments[len(plain) :] if word not in ("--ros-args", "--")]
    given = [ros[i + 1].partition(":=")[::2] for i, word in enumerate(ros) if word == "-r"]
    ros = [word for i, word in enumerate(ros) if "-r" not in ros[max(0, i - 1) : i + 1]]
    fact = {
        "kind": "node", "executable": program, "arguments": plain, "ros_arguments": ros, "env": node.env,
        "prefix": shlex.split(node.launch.prefix or ""), "remappings": _pairs(dict(given) | node.remappings), "files": files,
        "values": values,
    }  # fmt: skip
    return fact | {key: value for key, value in (("name", name), ("namespace", node.namespace)) if value}


def _component(node: ComposableNode, written: dict[str, str], shares: dict[str, Path]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    full = f"{node.namespace or ''}/{node.name}"
    for path in node.parameter_files:
        for section, content in yaml.safe_load(_text(path, written, shares) or "{}").items():
            if applies_to(section, full):
                values |= dict(_flat(content["ros__parameters"]))
    values |= dict(_flat(node.parameters))
    fact = {
        "package": node.package, "plugin": node.plugin, "remappings": _pairs(node.remappings), "parameters": values,
        "extra_arguments": node.extra_arguments,
    }  # fmt: skip
    return fact | {key: value for key, value in (("name", node.name), ("namespace", node.namespace)) if value}


def _pairs(remappings: dict[str, str]) -> list[list[str]]:
    return [list(pair) for pair in sorted(remappings.items())]


def of_one(sections: dict[str, Any]) -> dict[str, Any] | None:
    """Return the parameters of a file with one section, as launch writes it for one node; None of another file."""
    (only, *others) = sections.values()
    return None if others else only.get("ros__parameters")


def _text(path: str, written: dict[str, str], shares: dict[str, Path]) -> str | None:
    if path in written:
        return written[path]
    match = SHARE.match(path)
    file = shares.get(match[1], Path("/nowhere")) / path[match.end() :].lstrip("/") if match else None
    return file.read_text("utf-8") if file and file.is_file() else None
