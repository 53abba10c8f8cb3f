"""From a spec to a robot that calls the planner in the cloud: only generated files, two computers, one tunnel."""

import json
import os
import sys
from pathlib import Path

import pytest

from fogspec.base.templates import render
from fogspec.compile.launch_files import link_of_machine, robot_launch
from fogspec.compile.tasks import LINK_PEER, deployed_processes, ros_environment
from fogspec.language.schema import Application
from tests.ros.joined import ADDRESS, joined, missing, until
from tests.ros.namespaces import PYTHON, ROOT
from tests.support.agent import AGENT
from tests.support.jobs import GENERATED

NODE = str(Path(__file__).parent / "nodes" / "tunnel.py")
pytestmark = pytest.mark.skipif(missing("wireguard") is not None, reason=str(missing("wireguard")))


def application() -> Application:
    """Processes in place of packages: no workspace can be built without `ros2`, which is not on PyPI."""
    spec = {
        "cloud": [{"cmd": [str(PYTHON), NODE, "serve", "0.02"]}], "robot": [{"cmd": [str(PYTHON), NODE, "ask", "10", "20"]}],
        "probe": {"service": "/plan"}, "infra": ["slurm/lab"], "connectivity": {"link": "wireguard"},
    }  # fmt: skip
    return Application.model_validate({
        "apiVersion": "fogspec.dev/v1alpha1", "kind": "Application", "metadata": {"name": f"whole-{os.getpid()}"}, "spec": spec
    })  # fmt: skip


def test_the_generated_files_bring_the_robots_request_to_the_cloud_and_back(tmp_path: Path) -> None:
    app = application()
    with joined(tmp_path, "wireguard", app) as both:
        both.firewall()
        (tmp_path / "specs").mkdir()
        text = robot_launch(app, both.layout)
        assert text is not None
        both.layout.robot.write_bytes(text)

        public = both.script("robot", "keys").stdout.strip()
        words = {
            **ros_environment(app.spec),
            "processes": deployed_processes(app),
            "listeners": [],
            "asks": [],
            "ready": None,
            "ends": False,
        }
        run = render("deploy.sh.j2", **GENERATED, **words, link=link_of_machine(app))
        out = tmp_path / "out"
        machine = both.nets["cloud"].start(
            "machine", ["bash", "-c", run], FOGSPEC_AGENT=str(AGENT), FOGSPEC_OUT=str(out), FOGSPEC_LINK=str(both.layout.link),
            FOGSPEC_LINKS=str(tmp_path / "cloud"), **{LINK_PEER: public},
        )  # fmt: skip
        assert until(lambda: (out / "link.pub").is_file() and (out / "link.pub").read_text()), machine.said()
        assert both.script("robot", "peer", said=(out / "link.pub").read_text()).returncode == 0
        assert both.script("robot", "address", ADDRESS["cloud"]).returncode == 0

        play = [sys.executable, "-m", "tests.ros.playing", str(both.layout.robot)]
        links = {"FOGSPEC_LINKS": str(tmp_path / "robot"), "PYTHONPATH": str(ROOT)}
        played = both.nets["robot"].run(play, 600, **links)
        assert played.returncode == 0, played.stderr + machine.said()
        took = json.loads(next(line for line in played.stdout.splitlines() if line.startswith("[")))
        assert len(took) == 10
        assert all(one >= 0.02 for one in took)
        assert "fogr-" not in both.nets["robot"].run(["ip", "-brief", "link"], 600).stdout, (
            "the robot's end went with it"
        )
