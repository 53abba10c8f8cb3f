"""The WireGuard link under real ROS 2: a service call through the tunnel, everything else firewalled, strangers refused."""

import json
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from fogspec.compile.links.wireguard import interface
from tests.ros.joined import ADDRESS, OTHER, Joined, joined, missing, until
from tests.ros.namespaces import PYTHON

NODE = str(Path(__file__).parent / "nodes" / "tunnel.py")
pytestmark = [
    pytest.mark.skipif(missing("wireguard") is not None, reason=str(missing("wireguard"))),
]


@pytest.fixture(scope="module")
def ends(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Joined]:
    """Both ends up behind their firewalls, and a planner in the cloud."""
    with joined(tmp_path_factory.mktemp("wireguard"), "wireguard") as both:
        both.exchange()
        both.firewall()
        both.up("cloud")
        both.up("robot")
        served = both.nets["cloud"].python("planner", NODE, "serve", "0.02", **both.environment("cloud"))
        assert until(lambda: "up" in served.said()), served.said()
        yield both


def test_without_the_tunnel_the_cable_lets_no_ros_pass(tmp_path: Path) -> None:
    with joined(tmp_path, "wireguard") as both:
        both.firewall()
        environment = {side: {"ROS_STATIC_PEERS": ADDRESS[OTHER[side]]} for side in OTHER}
        served = both.nets["cloud"].python("planner", NODE, "serve", "0", **environment["cloud"])
        assert until(lambda: "up" in served.said()), served.said()
        assert asked(both, 4, **environment["robot"]) == []


def asked(both: Joined, patience_s: float, **environment: str) -> list[float]:
    words = [str(PYTHON), NODE, "ask", "5", str(patience_s)]
    run = both.nets["robot"].run(words, 600, **environment)
    assert run.returncode == 0, run.stderr
    return list(json.loads(run.stdout.splitlines()[-1]))


def test_a_service_call_goes_through_the_tunnel_and_nowhere_else(ends: Joined) -> None:
    took = asked(ends, 15, **ends.environment("robot"))
    assert len(took) == 5
    assert all(one >= 0.02 for one in took), "the work takes as long"


def test_the_handshake_is_seen(ends: Joined) -> None:
    assert until(lambda: ends.script("robot", "check").returncode == 0)


def test_a_private_key_is_in_no_other_file_than_its_own(ends: Joined) -> None:
    for side in ("robot", "cloud"):
        folder = ends.keys(side)
        assert stat.S_IMODE((folder / "private.key").stat().st_mode) == 0o600
        secret = (folder / "private.key").read_text().strip()
        files = [path for path in ends.folder.rglob("*") if path.is_file() and path != folder / "private.key"]
        assert not any(secret in path.read_text("utf-8", "replace") for path in files)


def test_a_robot_with_another_key_gets_no_handshake(tmp_path: Path) -> None:
    with joined(tmp_path, "wireguard") as both:
        both.exchange()
        both.exchange_as("rogue")
        both.firewall()
        both.up("cloud")
        rogue = both.up("robot", home="rogue")
        assert not until(lambda: both.script("robot", "check", home="rogue").returncode == 0, 6)
        rogue.stop()
        both.up("robot")
        assert until(lambda: both.script("robot", "check").returncode == 0), "the robot itself is let in"


def test_ending_the_link_leaves_no_interface(tmp_path: Path) -> None:
    with joined(tmp_path, "wireguard") as both:
        both.exchange()
        up = both.up("cloud")
        links = ["ip", "-brief", "link"]
        assert until(lambda: "is up" in up.said()), up.said()
        assert "fogc-" in both.nets["cloud"].run(links, 10).stdout
        up.stop()
        assert "fogc-" not in both.nets["cloud"].run(links, 10).stdout
        assert not list(Path("/etc/wireguard").glob(f"{interface(both.app.metadata.name, 'cloud')}*"))
