"""Programs in place of a robot's: each writes down how it was started, and waits to be ended. No ROS 2 is needed."""

import json
import os
import re
import shlex
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import yaml

from fogspec.compile.launch_source import flat as _flat
from tests.support.launch_facts import of_one
from tests.support.launching import Entity, launched

LONGEST_S = 1200.0  # a bound against hangs
STUB = """\
#!/usr/bin/env -S "{python}" -IS
import json, os, sys, time
name, words = os.path.basename(sys.argv[0]), sys.argv[1:]
if name == "ros2" and words[:1] == ["run"]:
    program = os.environ["AMENT_PREFIX_PATH"] + f"/lib/{{words[1]}}/{{words[2]}}"
    os.execv(program, [program, *words[3:]])
if name == "nice":
    os.environ["PREFIX"] = " ".join(["nice", *words[:2]])
    os.execvp(words[2], words[2:])
if name == "xacro":
    print("$(command '" + " ".join(["xacro", *words]) + "')", end="")
    raise SystemExit
given = [word for i, word in enumerate(words) if words[i - 1] == "--params-file"]
files = {{word: open(word).read() if os.path.exists(word) else word for word in given}}
line = {{"program": sys.argv[0], "words": words, "files": files, "env": dict(os.environ)}}
part = f"{{os.environ['STARTED']}}/.{{os.getpid()}}"
with open(part, "w") as file:
    json.dump(line, file)
os.rename(part, part.replace("/.", "/"))
time.sleep({longest})
"""
PREFIXED = ("nice", "xacro", "ros2")


def played(path: Path, prefix: Path, folder: Path) -> list[dict[str, Any]]:
    """Play a launch file in a folder, with stubs in `prefix`, where the packages that it names are; return what they wrote."""
    expected = 0
    for one in launched(path):
        if one.kind in ("Node", "ComposableNodeContainer"):
            _stub(prefix / "lib" / one.keywords["package"] / one.keywords["executable"])
            expected += 1 + len(one.keywords.get("composable_node_descriptions", []))
        elif one.kind == "ExecuteProcess":
            program = one.keywords["cmd"][0]
            if isinstance(program, Entity | list):
                program = "".join(f"{prefix}" if isinstance(part, Entity) else part for part in program)
            _stub(prefix / "bin" / program)
            expected += 1
    for name in PREFIXED:
        _stub(prefix / "bin" / name)
    started, log = path.parent / "started", path.parent / "log"
    started.mkdir(exist_ok=True)
    environment = {
        "PATH": str(prefix / "bin"), "AMENT_PREFIX_PATH": str(prefix), "STARTED": str(started), "HOME": os.environ["HOME"],
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, sys.path)]), "TMPDIR": str(path.parent),
    }  # fmt: skip
    with log.open("w") as out:
        play = [sys.executable, "-m", "tests.ros.playing", str(path)]
        running = subprocess.Popen(play, env=environment, stdout=out, stderr=out, cwd=folder)
        end = time.monotonic() + LONGEST_S
        while len(_done(started)) < expected and running.poll() is None and time.monotonic() < end:
            time.sleep(0.02)
        running.terminate()
        running.wait(LONGEST_S)
    found = [json.loads(one.read_text()) for one in _done(started)]
    assert len(found) == expected, log.read_text()
    for one in found:
        own = {key: value for key, value in one["env"].items() if environment.get(key) != value}
        one["env"] = {key: value for key, value in own.items() if key not in ("LC_CTYPE", "PWD")}
    return found


def _stub(path: Path) -> None:
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(STUB.format(python=sys.executable, longest=LONGEST_S))
        path.chmod(0o755)


def _done(folder: Path) -> list[Path]:
    return sorted(one for one in folder.iterdir() if not one.name.startswith("."))


def facts(found: list[dict[str, Any]], prefix: Path, folder: Path, temporary: Path) -> list[dict[str, Any]]:
    """Return what stubs wrote down, in the words of `tests/cases/launch/golden.json`: files by their names in `folder`."""
    text = json.dumps(found)
    text = re.sub(rf"{prefix}/share/([\w-]+)", r"$(find-pkg-share \1)", text).replace(f"{folder}/", "")
    made, loads = [], []
    for one in json.loads(text):
        (loads if one["words"][:2] == ["component", "load"] else made).append(one)
    nodes = {one["program"] + str(i): _fact(one, prefix, temporary) for i, one in enumerate(made)}
    for load in loads:
        container, component = _component(load["words"][2:])
        (whole,) = [one for one in nodes.values() if _full(one) == container]
        whole.setdefault("components", []).append(component)
    for one in nodes.values():
        if "components" in one:
            one["components"].sort(key=lambda each: json.dumps(each, sort_keys=True))
    return sorted(nodes.values(), key=lambda one: json.dumps(one, sort_keys=True))


def _full(fact: dict[str, Any]) -> str:
    return f"{fact.get('namespace', '').rstrip('/')}/{fact.get('name', '')}"


def _fact(one: dict[str, Any], prefix: Path, temporary: Path) -> dict[str, Any]:
    program, words = one["program"], one["words"]
    match = re.fullmatch(rf"{prefix}/lib/([^/]+)/([^/]+)", program)
    if match is None and "--ros-args" not in words:
        return {"kind": "process", "argv": [os.path.basename(program), *words], "env": one["env"]}
    plain = words[: words.index("--ros-args")] if "--ros-args" in words else words
    ros = [word for word in words[len(plain) :] if word not in ("--ros-args", "--")]
    fact: dict[str, Any] = {
        "kind": "node",
        "executable": f"<{match[1]}>/{match[2]}" if match else os.path.basename(program),
        "arguments": plain,
        "env": one["env"],
    }
    fact["prefix"] = shlex.split(one["env"].pop("PREFIX", ""))
    rules, files, values, rest = [], [], {}, []
    given = iter(ros)
    for word in given:
        if word == "-r":
            rules.append(next(given).partition(":=")[::2])
        elif word == "-p":
            name, _, value = next(given).partition(":=")
            values[name] = yaml.safe_load(value)
        elif word == "--params-file":
            path = next(given)
            content = yaml.safe_load(one["files"][path])
            if isinstance(content, str):
                files.append(content)
            elif path.startswith(str(temporary)) and (own := of_one(content)) is not None:
                values |= dict(_flat(own))
            else:
                files.append(json.dumps(content, sort_keys=True))
        else:
            rest.append(word)
    special = {"__node": "name", "__ns": "namespace"}
    fact |= {special[source]: target for source, target in rules if source in special}
    fact["remappings"] = sorted([source, target] for source, target in rules if source not in special)
    return fact | {"ros_arguments": rest, "files": files, "values": values}


def _component(words: list[str]) -> tuple[str, dict[str, Any]]:
    container, package, plugin, *rest = words
    fact: dict[str, Any] = {
        "package": package,
        "plugin": plugin,
        "remappings": [],
        "parameters": {},
        "extra_arguments": {},
    }
    for flag, value in zip(rest[::2], rest[1::2], strict=True):
        name, _, given = value.partition(":=")
        match flag:
            case "-n":
                fact["name"] = value
            case "--node-namespace":
                fact["namespace"] = value
            case "-r":
                fact["remappings"].append([name, given])
            case "-p":
                fact["parameters"][name] = json.loads(given)
            case "-e":
                fact["extra_arguments"][name] = json.loads(given)
    fact["remappings"].sort()
    return container, fact
