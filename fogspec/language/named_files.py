"""The files next to a spec that it names: what must be there, and what must be sent to a machine."""

import re
from collections.abc import Iterator

from fogspec.base.yaml.positions import Path
from fogspec.language.launch_text import STARTS
from fogspec.language.schema import Node, Spec

INTERPRETERS = re.compile(r"(?:python[0-9.]*|bash|sh|ruby|perl|node)")
LAUNCH_FILE = re.compile(r".+\.(?:py|xml|ya?ml)")


def all_nodes(spec: Spec) -> Iterator[tuple[Path, Node]]:
    """Return every node of the spec with its path."""
    for where, some in (("cloud", spec.cloud), ("robot", spec.robot)):
        for i, node in enumerate(some):
            yield ("spec", where, i), node
    if spec.benchmark.workload.node is not None:
        yield ("spec", "benchmark", "workload", "node"), spec.benchmark.workload.node


def nodes_on_machine(spec: Spec, measured: bool) -> list[tuple[Path, Node]]:
    """Return the nodes that run on the machine, with the one that sends requests where it is `measured`."""
    return [(path, node) for path, node in all_nodes(spec) if path[1] == "cloud" or (measured and path[1] != "robot")]


def named_files(spec: Spec, measured: bool) -> Iterator[tuple[Path, str]]:
    """Yield each file and directory that the spec names relative to itself, with the path of the field."""
    if spec.ros is not None and spec.ros.workspace is not None:
        yield ("spec", "ros", "workspace"), spec.ros.workspace
    if measured and spec.benchmark.workload.bag is not None:
        yield ("spec", "benchmark", "workload", "bag"), spec.benchmark.workload.bag
    for path, node in nodes_on_machine(spec, measured):
        yield from _parameter_files(path, node)
        if (at := program(node)) is not None and node.cmd is not None:
            yield (*path, "cmd", at), node.cmd[at]


def words_of_commands(spec: Spec, measured: bool) -> Iterator[tuple[Path, str]]:
    """Yield the words of commands that may name a file next to the spec, with their paths."""
    for path, node in nodes_on_machine(spec, measured):
        if node.cmd is None:
            continue
        words = [((*path, "cmd", i), word) for i, word in enumerate(node.cmd)]
        words += [((*path, "arguments", i), word) for i, word in enumerate(node.arguments)]
        yield from ((at, word) for at, word in words if word and not word.startswith(("-", "/", *STARTS)))


def measurement_sends_files(spec: Spec) -> bool:
    """Return whether a measured machine is sent files: something that runs on it is named relative to the spec."""
    if spec.files is not None:
        return bool(spec.files)
    commands = any(node.cmd is not None for _, node in nodes_on_machine(spec, measured=True))
    return commands or spec.probe.bag is not None or any(named_files(spec, measured=True))


def sends_files(spec: Spec) -> bool:
    """Return whether a machine is sent files next to the spec."""
    if spec.files is not None:
        return bool(spec.files)
    return measurement_sends_files(spec) or spec.deployment.ready is not None


def _parameter_files(path: Path, node: Node) -> Iterator[tuple[Path, str]]:
    """Yield the parameter files of a node and its components that are next to the spec; others are in packages there."""
    parts = [(path, node.parameter_files)]
    parts += [
        ((*path, "composable_node_descriptions", i), one.parameter_files)
        for i, one in enumerate(node.composable_node_descriptions)
    ]
    for at, files in parts:
        yield from (((*at, "parameter_files", i), file) for i, file in enumerate(files) if not file.startswith(STARTS))


def program(node: Node) -> int | None:
    """Return the index of the word of `cmd` that is a file beside the spec: a program, a script or a launch file."""
    words = node.cmd or []
    if not words:
        return None
    if "/" in words[0]:
        return 0
    if words[:2] == ["ros2", "launch"]:
        alone = len(words) > 2 and LAUNCH_FILE.fullmatch(words[2])
        return 2 if alone else None
    if INTERPRETERS.fullmatch(words[0]):
        first = next((i for i, word in enumerate(words[1:], 1) if not word.startswith("-")), None)
        options = words[1:first] if first is not None else words[1:]
        # With -m or -c there is no script; an option such as -W takes the next word.
        return first if first is not None and not {"-m", "-c", "-W", "-X", "-o", "-e"} & set(options) else None
    return None
