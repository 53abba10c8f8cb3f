"""A compiled sample in a container: set-up, the nodes, their limits, their secrets, and that all of it ends."""

import hashlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from fogspec.backends.skypilot import secrets_file
from fogspec.language.lockfile import REGISTRY_LOGIN
from tests.containers import engine
from tests.containers.engine import Podman
from tests.ros.benching import NODES
from tests.tools.aws import images
from tests.tools.slurm import nodes, ros

pytestmark = pytest.mark.slow
IMAGE = "localhost/team/nodes"
SECRET = "a-key-of-the-team-5e1c"
SPEC: dict[str, Any] = {
    "apiVersion": "fogspec.dev/v1alpha1",
    "kind": "Application",
    "metadata": {"name": "planner"},
    "spec": {
        "ros": {"distro": "jazzy", "image": f"{IMAGE}@sha256:{'0' * 64}"},
        "secrets": ["TEAM_KEY", *REGISTRY_LOGIN],
        "infra": ["aws/us-east-1"],
        "benchmark": {
            "machines": ["c6i.large"],
            "warmup": 1,
            "ready_timeout": "3min",
            "budget": "$1",
            "stop": {"requests": 20, "duration": "1min"},
        },
    },
}
# It says what it sees, leaves a chain of processes behind that hide from the process that started them.
WORK = """\
import hashlib, os, subprocess, sys, time
import fogspec_probe

login = sorted(name for name in os.environ if name.startswith("SKYPILOT_DOCKER_"))
key = os.environ["TEAM_KEY"]
print("sees", os.environ["TEAM_IMAGE"], login, hashlib.sha256(key.encode()).hexdigest(), flush=True)
print("key", key, flush=True)
chain = '''import os, signal, time
end_s = time.monotonic() + 600
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP): signal.signal(number, signal.SIG_IGN)
while time.monotonic() < end_s:
    if os.fork(): os._exit(0)
    os.setsid(); time.sleep(0.01)
'''
subprocess.Popen([sys.executable, "-c", chain], env={}, start_new_session=True)

while True:
    fogspec_probe.start("work"); time.sleep(0.1); fogspec_probe.stop("work")
"""


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Podman]:
    """Podman with an image: Debian with ROS 2."""
    if why := engine.missing():
        pytest.skip(why)
    folder = tmp_path_factory.mktemp("podman")
    if not ros.prepare(folder / "opt", nodes.PYTHON):
        pytest.skip("needs ROS 2: make ros-env")
    with engine.podman(folder) as found:
        found("import", "--change", "ENV TEAM_IMAGE=1", "--change", f"ENV PATH={images.PATH}", str(images.ROOT), IMAGE)
        yield found


def sample(podman: Podman, project: Path, spec: dict[str, Any], *options: str) -> tuple[dict[str, Any], list[Any], str]:
    """Compile and measure in a container; return the outcome, the timings and all that was printed."""
    whole = SPEC | {"spec": SPEC["spec"] | spec}
    (project / "specs").mkdir(exist_ok=True)
    YAML().dump(whole, project / "specs" / "planner.yaml")
    words = [sys.executable, "-m", "fogspec", "compile", "planner"]
    ended = subprocess.run(words, cwd=project, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    (path,) = (project / "compiled" / "planner" / "tasks").iterdir()
    task = YAML(typ="safe").load(path)
    assert task["resources"]["image_id"] == f"docker:{whole['spec']['ros']['image']}"
    secret = project / "secrets"
    secret.write_text(f"export TEAM_KEY={SECRET}\n")
    opt = podman.folder / "opt" / "ros"
    with podman.running(IMAGE, "-v", f"{opt}:/opt/ros:ro", *options):
        podman("cp", f"{project}/specs/.", f"{engine.NAME}:/root/sky_workdir")
        podman.inside("mkdir -p ~/.fogspec")
        for there, here in task["file_mounts"].items():
            podman("cp", str(project / here), f"{engine.NAME}:{there.replace('~', '/root')}")
        podman("cp", str(secret), f"{engine.NAME}:{secrets_file.THERE.replace('~', '/root')}")
        assert SECRET not in podman("inspect", engine.NAME) + podman("image", "inspect", IMAGE)
        given = ["-e", "SKYPILOT_TASK_ID=1", *(word for name in REGISTRY_LOGIN for word in ("-e", f"{name}=login"))]
        said = podman.inside(f"exec 2>&1; cd ~/sky_workdir && {task['setup']}", *given)
        said += podman.inside(f"exec 2>&1; cd ~/sky_workdir && {task['run']}", *given, code=None)
        said += podman.inside("cat ~/.fogspec/out/process-*.log")
        left = podman.inside("ps -e -o args=").splitlines()
        assert podman.inside("ls ~/.fogspec").split().count("secrets") == 0
    assert [one for one in left if not one.startswith(("/bin/bash", "ps "))] == [], "all of the sample has ended"
    assert SECRET not in said
    return (
        json.loads(part(said, "outcome.json")),
        [json.loads(one) for one in part(said, "timings.jsonl").splitlines()],
        said,
    )


def part(said: str, name: str) -> str:
    """A file that the run script prints."""
    return said.partition(f"=== fogspec begin {name} ===\n")[2].partition(f"=== fogspec end {name} ===")[0]


def test_a_node_under_the_limits_of_its_container(image: Podman, tmp_path: Path) -> None:
    (tmp_path / "specs").mkdir()
    (tmp_path / "specs" / "work.py").write_text(WORK)
    spec = {"cloud": [{"cmd": ["python3", "work.py"]}], "probe": {"callback": "work"}}
    outcome, timings, said = sample(image, tmp_path, spec, "--cpus=0.5", "--memory=1g")
    assert outcome["state"] == "ok", outcome
    assert sum("latency_s" in one for one in timings) >= 20
    digest = hashlib.sha256(SECRET.encode()).hexdigest()
    assert f"sees 1 [] {digest}" in said
    assert "key $TEAM_KEY" in said
    assert outcome["resources"]["vcpus"] == 0.5


def test_ros_2_nodes_and_a_probe_of_topics(image: Podman, tmp_path: Path) -> None:
    (tmp_path / "specs").mkdir()
    for name in ("busy.py", "client.py"):
        (tmp_path / "specs" / name).write_bytes((NODES / name).read_bytes())
    spec = {
        "cloud": [{"cmd": ["python3", "busy.py", "topic", "0.02", "/tmp/truth"]}],
        "probe": {"request": "/imu", "response": "/pose"},
        "benchmark": SPEC["spec"]["benchmark"]
        | {"workload": {"node": {"cmd": ["python3", "client.py", "topic", "4000"]}}},
    }
    outcome, timings, _ = sample(image, tmp_path, spec)
    found = [one["latency_s"] for one in timings if "latency_s" in one]
    assert len(found) >= 20, outcome
