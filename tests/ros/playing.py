"""Starts what a generated launch file says, in its order, as `ros2 launch` does; `launch` itself is not on PyPI.

python -m tests.ros.playing LAUNCH_FILE

Nodes start by `ros2 run` with their names, remappings and parameters, components by `ros2 component load`. What launch would
start again when it ends starts once.
"""

import contextlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.support.launching import Entity, launched

KNOWN = {
    "package", "executable", "name", "namespace", "parameters", "remappings", "arguments", "prefix", "additional_env", "output",
    "on_exit", "exec_name", "respawn", "respawn_delay", "composable_node_descriptions", "cmd", "cwd",
}  # fmt: skip
INNERMOST = re.compile(r"\$\((find-pkg-share|find-pkg-prefix|env|command) ([^()]*)\)")
KINDS = {
    "FindPackageShare": "find-pkg-share", "FindPackagePrefix": "find-pkg-prefix", "EnvironmentVariable": "env",
    "Command": "command",
}  # fmt: skip


def main(path: Path) -> int:
    """Start everything, wait for the last process or one whose end ends all, end the others; its exit code."""
    running: list[tuple[subprocess.Popen[bytes], bool]] = []
    loading: list[tuple[subprocess.Popen[bytes], bool]] = []
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with tempfile.TemporaryDirectory() as folder:
        try:
            for one in launched(path):
                if one.kind == "SetEnvironmentVariable":
                    os.environ[one.arguments[0]] = one.arguments[1]
                elif one.kind == "OpaqueFunction":
                    one.keywords["function"](None)
                else:
                    first, *loads = commands(one, Path(folder))
                    running.append((_started(one, first), "on_exit" in one.keywords))
                    loading += [(_started(one, argv), False) for argv in loads]
            code = _waited(running)
        except KeyboardInterrupt:
            code = 130
        for process, _ in running + loading:
            if process.poll() is None:
                end(process)
    return code


def _started(one: Entity, argv: list[str]) -> "subprocess.Popen[bytes]":
    more = {text(key): text(value) for key, value in one.keywords.get("additional_env", {}).items()}
    return subprocess.Popen(argv, cwd=one.keywords.get("cwd"), env={**os.environ, **more})


def _waited(running: "list[tuple[subprocess.Popen[bytes], bool]]") -> int:
    while running:
        for process, ends_all in running:
            if process.poll() is not None and (ends_all or process is running[-1][0]):
                return process.returncode
        time.sleep(0.05)
    return 0


def commands(one: Entity, folder: Path) -> Iterator[list[str]]:
    """Yield the command line of an action, then those that load its components; `folder` is for parameters."""
    words = one.keywords
    if strange := words.keys() - KNOWN:
        raise ValueError(f"this player gives no {', '.join(sorted(strange))}")
    if one.kind == "ExecuteProcess":
        yield [text(word) for word in words["cmd"]]
        return
    argv = [*shlex.split(text(words.get("prefix", ""))), "ros2", "run", words["package"], words["executable"]]
    argv += map(text, words.get("arguments", []))
    name, namespace = text(words.get("name", "")), text(words.get("namespace", ""))
    ros = [f"__node:={name}"] * bool(name) + [f"__ns:={namespace}"] * bool(namespace)
    ros = [part for rule in [*ros, *_rules(words)] for part in ("-r", rule)]
    for given in words.get("parameters", []):
        ros += ["--params-file", _file({"/**": {"ros__parameters": values(given)}}, folder) if isinstance(given, dict)
                else parameter_file(given, folder)]  # fmt: skip
    yield [*argv, "--ros-args", *ros] if ros else argv
    for component in words.get("composable_node_descriptions", []):
        yield [
            *("ros2", "component", "load"),
            f"{namespace.rstrip('/')}/{name}",
            *_component(component.keywords, folder),
        ]


def _component(words: dict[str, Any], folder: Path) -> list[str]:
    """Return a component as `ros2 component load` is told it."""
    name, namespace = text(words.get("name", "")), text(words.get("namespace", ""))
    argv = [words["package"], words["plugin"]] + (["-n", name] if name else [])
    argv += ["--node-namespace", namespace] if namespace else []
    for rule in _rules(words):
        argv += ["-r", rule]
    given: dict[str, Any] = {}
    for one in words.get("parameters", []):
        given |= (
            dict(_flat(values(one)))
            if isinstance(one, dict)
            else _of_file(parameter_file(one, folder), namespace, name)
        )
    extra = {key: value for one in words.get("extra_arguments", []) for key, value in values(one).items()}
    for flag, some in (("-p", given), ("-e", extra)):
        for key, value in some.items():
            argv += [flag, f"{key}:={json.dumps(value, ensure_ascii=False)}"]
    return argv


def _rules(words: dict[str, Any]) -> list[str]:
    return [f"{text(source)}:={text(target)}" for source, target in words.get("remappings", [])]


def text(value: Any) -> str:
    """Return a text, or parts of one, with launch's substitutions in place."""
    if isinstance(value, str):
        return value
    if isinstance(value, (list, tuple)):
        return "".join(map(text, value))
    if value.kind == "ParameterValue":
        return text(value.arguments[0])
    return _substituted(KINDS[value.kind], text(value.arguments[0]))


def _substituted(kind: str, given: str) -> str:
    if kind == "env":
        return os.environ[given]
    if kind == "command":
        return subprocess.check_output(shlex.split(given.strip("'\"")), text=True)
    for prefix in os.environ["AMENT_PREFIX_PATH"].split(os.pathsep):
        if (Path(prefix) / "share" / given).is_dir():
            return f"{prefix}/share/{given}" if kind == "find-pkg-share" else prefix
    raise LookupError(f"no package {given} is in {os.environ['AMENT_PREFIX_PATH']}")


def values(given: Any) -> Any:
    """Return parameters with substitutions in place, their types untouched."""
    if isinstance(given, dict):
        return {key: values(value) for key, value in given.items()}
    return text(given) if isinstance(given, Entity) else given


def parameter_file(given: Any, folder: Path) -> str:
    """Return the path of a parameter file; of one in which launch substitutes, that of what it makes of it."""
    if not isinstance(given, Entity):
        return text(given)
    path = text(given.arguments[0])
    if not given.keywords.get("allow_substs"):
        return path
    content, before = Path(path).read_text("utf-8"), ""
    while content != before:
        before, content = content, INNERMOST.sub(lambda match: _substituted(match[1], match[2]), content)
    return _written(content, folder)


def _file(content: Any, folder: Path) -> str:
    return _written(json.dumps(content, ensure_ascii=False), folder)  # JSON is YAML


def _written(content: str, folder: Path) -> str:
    path = folder / f"launch_params_{len(list(folder.iterdir()))}"
    path.write_text(content, "utf-8")
    return str(path)


def _of_file(path: str, namespace: str, name: str) -> dict[str, Any]:
    """Return what a parameter file sets for a component."""
    import yaml

    full, found = f"{namespace}/{name}".strip("/").split("/"), {}
    for section, content in yaml.safe_load(Path(path).read_text("utf-8")).items():
        parts = section.strip("/").split("/")
        if parts == ["**"] or parts == full or (parts[0] == "**" and parts[1:] == full[1 - len(parts) :]):
            found |= dict(_flat(content["ros__parameters"]))
    return found


def _flat(given: dict[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in given.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{key}.")
        else:
            yield f"{before}{key}", value


def end(process: "subprocess.Popen[bytes]") -> None:
    """INT, TERM and KILL, five seconds apart, as launch does."""
    for number, patience_s in ((signal.SIGINT, 5), (signal.SIGTERM, 5), (signal.SIGKILL, 600)):
        process.send_signal(number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(patience_s)
            return
    raise TimeoutError(f"{process.args} does not end")


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
