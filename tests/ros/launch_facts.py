"""What the real `launch` and `launch_ros` start from fogspec's launch files, kept as facts in tests/golden/launch_facts.json.

On a machine with ROS 2: `. /opt/ros/jazzy/setup.sh; ROS_PYTHON=python3 python -m tests.ros.launch_facts --write`. Without
`--write` the facts are compared. `ROS_PYTHON` is a Python that can import `launch` and `launch_ros`.

The programs that are started are not ROS 2 nodes: each writes down how it was started, and ends.
"""

import contextlib
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from fogspec.base.layout import Layout
from fogspec.base.yaml.writer import yaml_text
from fogspec.compile.launch_files import launch_files, robot_launch
from fogspec.language.loader import load

ROOT = Path(__file__).resolve().parents[2]
FACTS = ROOT / "tests" / "golden" / "launch_facts.json"
LONGEST_S = 30.0
PACKAGE = "demo_nodes"
SPEC = f"""\
apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {{ name: arm }}
spec:
  cloud:
    - package: {PACKAGE}
      executable: planner
      name: left
      namespace: /arm
      parameters: {{ gain: 38.0, rate: 10, model: GQCNN-4.0-PJ }}
      remappings: {{ /image: /camera/image }}
      arguments: [--fast]
  robot: [{{ package: {PACKAGE}, executable: client }}]
  ros: {{ distro: jazzy, image: "docker.io/library/ros:jazzy" }}
  probe: {{ request: /a, response: /b }}
  infra: [aws/us-east-1]
  benchmark: {{ budget: $1 }}
  connectivity: {{ link: none }}
"""
LISTING_1 = """\
from launch import LaunchDescription
from launch_ros.actions import Node
from fogspec.ros import SkyLaunchDescription


def generate_launch_description():
    planner = Node(package="demo_nodes", executable="planner")
    sky = SkyLaunchDescription(nodes=[planner], max_latency=0.01, max_cost=0.01, min_cpu=2, max_cpu=64, alpha=0.7)
    client = Node(package="demo_nodes", executable="client")
    return LaunchDescription([{returned}])
"""
PROGRAM = """\
#!/usr/bin/env python3
import json, os, sys, time
words, found = sys.argv[1:], {}
if "--params-file" in words:
    found["parameters"] = open(words[words.index("--params-file") + 1]).read()
line = {"program": os.path.basename(sys.argv[0]), "arguments": words, "rmw": os.environ.get("RMW_IMPLEMENTATION", ""), **found}
with open(os.environ["FOGSPEC_FACTS"], "a") as facts:
    facts.write(json.dumps(line) + "\\n")
time.sleep(0.5)
"""
LINK = """\
printf '{"program": "link.sh", "arguments": ["%s", "%s"]}\\n' "$1" "$2" >> "$FOGSPEC_FACTS"
[ "$2" = up ] && exec sleep 60
exit 0
"""


def project(folder: Path) -> dict[str, tuple[Path, int]]:
    """Make the programs and the launch files; return each file with the number of programs that it starts."""
    (folder / "specs").mkdir(parents=True)
    spec = folder / "specs" / "arm.yaml"
    spec.write_text(SPEC)
    (one,) = load([spec])
    layout = Layout.of(str(spec), "arm")
    found = launch_files(one.application, layout)
    robot = robot_launch(one.application, layout)
    if robot is None:
        raise SystemExit("the spec has nodes on the robot")
    for path, content in {**found, layout.compiled / "robot.launch.py": robot}.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    prefix = folder / "prefix"
    (prefix / "share" / "ament_index" / "resource_index" / "packages").mkdir(parents=True)
    (prefix / "share" / "ament_index" / "resource_index" / "packages" / PACKAGE).touch()
    for name in ("planner", "client"):
        program = prefix / "lib" / PACKAGE / name
        program.parent.mkdir(parents=True, exist_ok=True)
        program.write_text(PROGRAM)
        program.chmod(0o755)
    pinned = folder / "listing" / "compiled" / "arm"
    (pinned / "link").mkdir(parents=True)
    (pinned / "link" / "link.sh").write_text(LINK)
    body = {
        "instance": "m6i.large", "infra": "aws/us-east-1", "robot_environment": {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"},
        "cloud": [{"package": PACKAGE, "executable": "planner"}],
    }  # fmt: skip
    pins = {"files": [{"path": "link/link.sh", "digest": f"sha256:{hashlib.sha256(LINK.encode()).hexdigest()}"}]}
    manifest = {"kind": "DeploymentManifest", "metadata": {"name": "arm"}, "spec": body, "pins": pins}
    (pinned / "manifest.yaml").write_text(yaml_text(manifest, "fogspec compile"))
    forms = {"built": "client", "returned": "sky, client"}
    for name, returned in forms.items():
        (folder / "listing" / f"{name}.launch.py").write_text(LISTING_1.replace("{returned}", returned))
    return {
        "cloud.launch.py": (layout.cloud, 1),
        "robot.launch.py": (layout.compiled / "robot.launch.py", 1),
        **{f"Listing 1, {name}": (folder / "listing" / f"{name}.launch.py", 3) for name in forms},
    }


def facts(python: str) -> dict[str, Any]:
    """Return what each launch file starts, under the `launch` of this Python."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made).resolve()
        found = {name: _played(python, folder, path, count) for name, (path, count) in project(folder).items()}
        return json.loads(re.sub(r"/tmp/launch_params_\w+", "@params", json.dumps(found).replace(str(folder), "@")))


def _played(python: str, folder: Path, path: Path, count: int) -> dict[str, Any]:
    written, log = folder / "facts", folder / "log"
    for one in (written, log):
        one.unlink(missing_ok=True)
    environment = {
        **os.environ,
        "AMENT_PREFIX_PATH": f"{folder / 'prefix'}:{os.environ.get('AMENT_PREFIX_PATH', '')}",
        "PYTHONPATH": f"{os.environ.get('PYTHONPATH', '')}:{ROOT}",
        "FOGSPEC_FACTS": str(written),
        "ROS_LOG_DIR": str(folder / "ros"),
    }
    environment.pop("RMW_IMPLEMENTATION", None)
    with log.open("w") as out:
        play = [python, str(ROOT / "tests" / "ros" / "play_launch.py"), str(path)]
        running = subprocess.Popen(play, env=environment, cwd=path.parent, stdout=out, stderr=subprocess.STDOUT)
        end = time.monotonic() + LONGEST_S
        while running.poll() is None and time.monotonic() < end and len(_lines(written)) < count:
            time.sleep(0.1)
        time.sleep(1.0)
        with contextlib.suppress(ProcessLookupError):
            running.send_signal(signal.SIGINT)
        running.wait(LONGEST_S)
    started = sorted((json.loads(line) for line in _lines(written)), key=json.dumps)
    said = [line.partition("]: ")[2] for line in _lines(log) if "not started here" in line]
    return {"starts": started, "says": said, **({} if started else {"log": _lines(log)[-5:]})}


def _lines(path: Path) -> list[str]:
    return path.read_text().splitlines() if path.is_file() else []


def main(arguments: list[str]) -> int:
    """Write or compare the facts; return the exit code."""
    text = json.dumps(facts(os.environ.get("ROS_PYTHON", "python3")), indent=2, sort_keys=True) + "\n"
    if "--write" in arguments:
        FACTS.write_text(text)
        return 0
    same = FACTS.is_file() and FACTS.read_text() == text
    print("the facts are as committed" if same else text)
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
