"""The zenoh link between two computers that are joined by nothing else: what passes, what does not, and who."""

import json
import re
import shutil
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.ros.joined import ADDRESS, Joined, joined, missing, until
from tests.ros.namespaces import PYTHON

NODE = str(Path(__file__).parent / "nodes" / "over_zenoh.py")
DUMB = """
import socket
listening = socket.create_server(("127.0.0.1", 7448))
print("up", flush=True)
listening.accept()[0].send(b"hello")
listening.accept()
"""
STRANGER = str(Path(__file__).parent / "nodes" / "stranger.py")
pytestmark = pytest.mark.skipif(missing("zenoh") is not None, reason=str(missing("zenoh")))


@pytest.fixture(scope="module")
def ends(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Joined]:
    """Both ends up behind their firewalls, and a planner in the cloud."""
    with joined(tmp_path_factory.mktemp("zenoh"), "zenoh") as both:
        both.exchange()
        both.firewall()
        both.up("cloud")
        both.up("robot")
        served = both.nets["cloud"].python("planner", NODE, "serve", "0.02")
        assert until(lambda: "up" in served.said()), served.said()
        assert until(lambda: said(both, "robot", "ask", "plan", "1") == ["planned"])
        yield both


def said(both: Joined, side: str, *words: str, node: str = NODE) -> Any:
    """What a short-lived node at one end prints; None while it cannot even reach its router, or hangs on the way to it."""
    try:
        run = both.nets[side].run([str(PYTHON), node, *words], 120)
    except subprocess.TimeoutExpired:
        return None
    return json.loads(run.stdout.splitlines()[-1]) if run.returncode == 0 else None


def test_a_service_answers_through_the_link_and_one_that_is_not_named_does_not(ends: Joined) -> None:
    assert until(lambda: said(ends, "robot", "ask", "plan") == ["planned"])
    assert said(ends, "robot", "ask", "secret", "2") == []
    assert until(lambda: said(ends, "cloud", "ask", "secret", "1") == ["planned"]), "at its own end it is there"


def test_named_topics_pass_both_ways_and_others_neither(ends: Joined) -> None:
    ends.nets["robot"].python("camera", NODE, "publish")
    heard = ["image", "pose of image", "secret_image"]
    assert until(lambda: said(ends, "robot", "listen", "3") == heard), "what is secret comes from the robot itself only"


def test_what_another_implementation_of_rmw_zenoh_says_passes_and_is_kept_back_the_same(ends: Joined) -> None:
    served = ends.nets["cloud"].python("stranger", STRANGER, "serve")
    try:
        assert until(lambda: "up" in served.said()), served.said()
        everything = ["/plan", "/pose", "/secret", "/secret_pose"]
        assert until(lambda: said(ends, "cloud", "look", node=STRANGER) == everything), "at its own end all is there"
        passed: set[str] = set()
        assert until(
            lambda: passed.update(said(ends, "robot", "look", node=STRANGER) or []) or passed >= {"/plan", "/pose"}
        )
        assert passed == {"/plan", "/pose"}
    finally:
        served.stop()


def test_a_message_that_is_kept_for_late_joiners_passes(ends: Joined) -> None:
    kept = ends.nets["cloud"].python("keeper", NODE, "keep")
    assert until(lambda: "up" in kept.said())
    assert until(lambda: "kept" in (said(ends, "robot", "late", "2") or []))


def test_the_graph_is_seen_from_the_other_end(ends: Joined) -> None:
    assert until(lambda: "planner" in (said(ends, "robot", "graph") or []))


def test_plain_tcp_is_refused(ends: Joined) -> None:
    for port in (7447, 7448):
        assert said(ends, "robot", "plain", f"tcp/{ADDRESS['cloud']}:{port}") == "refused"


def test_the_other_end_answers_as_itself(ends: Joined) -> None:
    assert ends.script("robot", "check").returncode == 0


def test_who_is_not_the_robot_can_tell_whether_the_other_end_answers_as_itself(ends: Joined) -> None:
    """`fogspec apply` on another computer has public halves only; no stranger passes for the machine."""
    here, mine = ends.keys("robot", home="desk"), ends.keys("robot")
    here.mkdir(parents=True)
    for name in ("peer", "peer.pem", "address"):
        shutil.copy(mine / name, here)
    assert ends.script("robot", "check", home="desk").returncode == 0
    (here / "address").write_text("127.0.0.1\n")
    listening = ends.nets["robot"].start("stranger", [sys.executable, "-c", DUMB])
    assert until(lambda: "up" in listening.said())
    assert ends.script("robot", "check", home="desk").returncode == 1, "whatever listens there is not the machine"
    listening.stop()
    shutil.copy(mine / "address", here)
    shutil.copy(mine / "public.pem", here / "peer.pem")
    refused = ends.script("robot", "check", home="desk")
    assert refused.returncode == 1
    assert re.search("does not answer as CN=cloud.*: .*certificate", refused.stderr), "and why"


def test_a_private_key_is_readable_by_its_owner_alone_and_at_its_own_end_only(ends: Joined) -> None:
    for side, other in (("robot", "cloud"), ("cloud", "robot")):
        folder = ends.keys(side)
        assert stat.S_IMODE((folder / "private.key").stat().st_mode) == 0o600
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        secret = re.sub(r"-----.*-----|\s", "", (folder / "private.key").read_text())
        elsewhere = [path for path in ends.folder.rglob("*") if path.is_file() and folder not in path.parents]
        assert elsewhere
        assert not any(secret in re.sub(r"\s", "", path.read_text("utf-8", "replace")) for path in elsewhere), other


def test_making_keys_again_changes_nothing(ends: Joined) -> None:
    before = (ends.keys("robot") / "private.key").read_bytes()
    public = ends.script("robot", "keys").stdout
    assert (ends.keys("robot") / "private.key").read_bytes() == before
    assert public == (ends.keys("robot") / "public").read_text()


def test_a_rogue_with_a_certificate_of_the_same_name_is_refused(tmp_path: Path) -> None:
    """It has the right name, the reviewed configuration, and the cloud's certificate; only not the robot's key."""
    with joined(tmp_path, "zenoh") as both:
        both.exchange()
        both.exchange_as("rogue")
        both.firewall()
        both.up("cloud")
        served = both.nets["cloud"].python("planner", NODE, "serve", "0")
        assert until(lambda: "up" in served.said())
        rogue = both.up("robot", home="rogue")
        assert until(lambda: said(both, "robot", "ask", "plan", "1") == [])
        assert said(both, "robot", "ask", "plan", "4") == []
        rogue.stop()
        both.up("robot")
        assert until(lambda: said(both, "robot", "ask", "plan", "1") == ["planned"]), "the robot itself is let in"
