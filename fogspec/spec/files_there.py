"""What a spec names beside itself and is not there: an error of every command that plans, pins or starts something with it."""

import os
import re
from collections.abc import Iterator
from pathlib import Path

from fogspec.base.files import read_file
from fogspec.base.yaml.positions import Path as FieldPath
from fogspec.base.yaml.positions import dotted
from fogspec.spec.launch_text import STARTS
from fogspec.spec.rules.finding import Finding
from fogspec.spec.rules.nodes import all_nodes
from fogspec.spec.schema import Application, Node, Spec
from fogspec.spec.suggest import closest

CODE = "FS545"
INTERPRETERS = re.compile(r"(?:python[0-9.]*|bash|sh|ruby|perl|node)")
LAUNCH_FILE = re.compile(r".+\.(?:py|xml|ya?ml)")
PACKAGE_NAME = re.compile(rb"<name>\s*([A-Za-z0-9_-]+)\s*</name>")
MOST_BYTES = 1 << 18
NO_PACKAGES = ("build", "install", "log")
MARKERS = ("COLCON_IGNORE", "AMENT_IGNORE")


def missing_files(application: Application, folder: Path, measured: bool) -> Iterator[Finding]:
    """Find what is not in `folder`, the spec's own, and must be there when a machine is started.

    `measured` says whether requests are sent to it too.
    """
    spec = application.spec
    nodes = [(path, node) for path, node in all_nodes(spec) if path[1] == "cloud" or (measured and path[1] != "robot")]
    named: list[tuple[FieldPath, str]] = []
    if spec.ros is not None and spec.ros.workspace is not None:
        named.append((("spec", "ros", "workspace"), spec.ros.workspace))
    if measured and spec.benchmark.workload.bag is not None:
        named.append((("spec", "benchmark", "workload", "bag"), spec.benchmark.workload.bag))
    for path, node in nodes:
        named += _parameter_files(path, node)
        if (at := program(node)) is not None and node.cmd is not None:
            named.append(((*path, "cmd", at), node.cmd[at]))
    for path, name in named:
        if not os.path.isabs(name) and not _exists(folder / name):
            message = f"{dotted(path)} names {name}, which is not there"
            yield Finding(CODE, path, message, "paths are relative to the spec's folder")
    yield from _packages(spec, folder, nodes)


def _parameter_files(path: FieldPath, node: Node) -> Iterator[tuple[FieldPath, str]]:
    """Return the parameter files of a node and its components that are beside the spec; others are in packages there."""
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


def _packages(spec: Spec, folder: Path, nodes: list[tuple[FieldPath, Node]]) -> Iterator[Finding]:
    """Find packages of nodes that neither the workspace nor `ros.apt` has."""
    if spec.ros is None or spec.ros.workspace is None or not (folder / spec.ros.workspace).is_dir():
        return
    known = packages_of(folder / spec.ros.workspace / "src")
    for path, node in nodes:
        installed = node.package is None or any(
            name.endswith(f"-{node.package.replace('_', '-')}") for name in spec.ros.apt
        )
        if installed or node.package in known:
            continue
        near = closest(str(node.package), sorted(known))
        message = f"{dotted((*path, 'package'))} {node.package} is not in {spec.ros.workspace}/src"
        apt = f"ros-{spec.ros.distro}-{str(node.package).replace('_', '-')}"
        fix = f"write '{near}'" if near else f"add it there, or {apt} to spec.ros.apt"
        yield Finding(CODE, (*path, "package"), message, fix, (("spec", "ros"),))


def packages_of(folder: Path) -> set[str]:
    """Return the names of the packages below a workspace's `src`, as colcon finds them."""
    found = set[str]()
    for parent, folders, files in os.walk(folder):
        if any(name in files for name in MARKERS):
            folders.clear()
            continue
        folders[:] = [name for name in folders if not name.startswith(".") and name not in NO_PACKAGES]
        if "package.xml" in files:
            folders.clear()
            try:
                content = read_file(os.path.join(parent, "package.xml"), MOST_BYTES)
            except OSError:
                continue
            if (name := PACKAGE_NAME.search(content)) is not None:
                found.add(name[1].decode())
    return found


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:
        return False
