"""From the robot's key and `fogspec apply` to a robot that calls the planner through the tunnel, and `fogspec down`."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from fogspec.language.loader import load
from tests.ros.joined import ADDRESS, Joined, joined, missing
from tests.ros.namespaces import PYTHON, ROOT
from tests.support.deployed import MANIFEST, SPEC, Deployed

NODE = str(Path(__file__).parent / "nodes" / "tunnel.py")
# While machines are measured the link is not there, and nothing of ROS 2 may reach this host's network.
PLANNER = f'[ -z "$ROS_STATIC_PEERS" ] && exec sleep 600; exec {PYTHON} {NODE} serve 0.02'
CLIENT = [str(PYTHON), NODE, "ask", "10", "20"]
LINKED = SPEC.replace(
    "  probe:",
    f"    - cmd: [sh, -c, {json.dumps(PLANNER)}]\n  robot:\n    - cmd: {json.dumps(CLIENT)}\n"
    "  connectivity: {link: wireguard, expose: {/plan: service}}\n  probe:",
)
pytestmark = pytest.mark.skipif(missing("wireguard") is not None, reason=str(missing("wireguard")))


def fogspec(both: Joined, side: str, app: Deployed, *words: str) -> "subprocess.CompletedProcess[str]":
    """The command line on one computer, in the application's folder."""
    there = [
        "sh",
        "-c",
        'cd "$1" && shift && exec "$@"',
        "sh",
        str(app.folder),
        sys.executable,
        "-m",
        "fogspec",
        *words,
    ]
    links = {"FOGSPEC_LINKS": str(both.folder / side), "PYTHONPATH": str(ROOT)}
    return both.nets[side].run(there, 600, **links)


def test_apply_joins_the_robot_to_what_it_started_and_down_parts_them(tmp_path: Path) -> None:
    app = Deployed.made(tmp_path / "app", LINKED)
    (loaded,) = load([app.folder / "specs" / "tiny.yaml"])
    with joined(tmp_path, "wireguard", loaded.application) as both:
        both.firewall()
        refused = fogspec(both, "cloud", app, "apply", MANIFEST, "--yes")
        assert refused.returncode == 5, refused
        assert "link.sh robot keys" in refused.stderr

        script = str(app.folder / "compiled" / "tiny" / "link" / "link.sh")
        keys = both.nets["robot"].run(["bash", script, "robot", "keys"], 600, FOGSPEC_LINKS=str(both.folder / "robot"))
        assert keys.returncode == 0, keys
        mine = both.keys("cloud").parent / "robot"
        mine.mkdir(parents=True)
        shutil.copy(both.keys("robot") / "public", mine)

        try:
            applied = fogspec(both, "cloud", app, "apply", MANIFEST, "--yes")
            assert applied.returncode == 0, applied
            assert str(mine / "peer") in applied.stderr, "what to copy to the robot is said"
            taken = both.script("robot", "peer", said=(mine / "peer").read_text())
            assert taken.returncode == 0, taken
            assert both.script("robot", "address", ADDRESS["cloud"]).returncode == 0

            launch = str(app.folder / "compiled" / "tiny" / "robot.launch.py")
            words = [sys.executable, "-m", "tests.ros.playing", launch]
            played = both.nets["robot"].run(words, 600, FOGSPEC_LINKS=str(tmp_path / "robot"), PYTHONPATH=str(ROOT))
            assert played.returncode == 0, played
            took = json.loads(next(line for line in played.stdout.splitlines() if line.startswith("[")))
            assert len(took) == 10
        finally:
            down = fogspec(both, "cloud", app, "down", "tiny")
        assert down.returncode == 0, down
        assert app.alive() == []
        assert "fogc-" not in both.nets["cloud"].run(["ip", "-brief", "link"], 600).stdout
        assert not (mine / "peer").exists()
