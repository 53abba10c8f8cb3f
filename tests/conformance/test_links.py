"""What every link must hold to, and what each writes: configuration without keys, for names of the spec and no others."""

import json
import re
import subprocess
from itertools import combinations
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogspec.base.layout import Layout
from fogspec.compile.launch_files import launch_files, link_script
from fogspec.compile.links import LINKS
from fogspec.compile.links.wireguard import addresses, interface
from fogspec.compile.links.zenoh import common_name, router
from fogspec.language.graph_names import exposed
from fogspec.language.schema import Application
from fogspec.language.warned import sentence
from tests.unit.compile.test_tasks import application

PASSING = {"expose": {"/tf": "topic", "/plan": "service", "/navigate": "action"}}
SIDES = ("cloud", "robot")


def arm(link: str, **more: Any) -> Application:
    spec = {"ros": {}, "connectivity": {"link": link, **PASSING}}
    return application(**(spec | more))


@pytest.mark.parametrize("name", LINKS)
def test_a_link_writes_the_same_for_the_same_spec_and_no_key(name):
    app = arm(name)
    for side in SIDES:
        end = LINKS[name].end(app, side)
        assert end == LINKS[name].end(app, side)
        for text in end.files.values():
            assert "PRIVATE KEY" not in text
            assert not re.search(r"PrivateKey\s*=", text)
        assert all(re.fullmatch(r"[A-Z_]+", key) for key in end.environment)
    assert (LINKS[name].protocol is None) == (not LINKS[name].end(app, "cloud").files)


@pytest.mark.parametrize("name", ["zenoh", "wireguard"])
def test_what_is_only_known_later_is_a_word_that_the_script_replaces(name):
    app = arm(name)
    script = link_script(app, Layout.of("specs/x.yaml", "app"))
    words = {
        word
        for side in SIDES
        for text in LINKS[name].end(app, side).files.values()
        for word in re.findall(r"@[A-Z_]+@", text)
    }
    assert words == {"@CLOUD_ADDRESS@", "@PEER@"} | ({"@KEYS@"} if name == "zenoh" else set())
    assert all(word in script for word in words)


@pytest.mark.parametrize("name", ["zenoh", "wireguard"])
def test_the_script_passes_shellcheck(name, tmp_path):
    script = tmp_path / "link.sh"
    script.write_text(link_script(arm(name), Layout.of("specs/x.yaml", "app")))
    try:
        checked = subprocess.run(["shellcheck", "-S", "info", str(script)], capture_output=True, text=True)
    except FileNotFoundError:
        pytest.skip("needs shellcheck: apt-get install shellcheck")
    assert checked.returncode == 0, checked.stdout


def test_the_spec_says_what_passes():
    app = arm(
        "zenoh", probe={"request": "image", "response": "/pose"}, metrics={"m": {"topic": "/cost", "field": "f"}},
        cloud=[{"package": "p", "executable": "e", "name": "planner", "namespace": "arm",
                "remappings": {"/a": "/camera", "b": "goal", "c": "~/state", "d": "{ns}/x"}}],
    )  # fmt: skip
    found = exposed(app.spec)
    assert found.topics == ("/cost", "/image", "/pose", "/tf")
    assert (found.services, found.actions) == (("/plan",), ("/navigate",))
    assert found.names == ("/arm/goal", "/arm/planner/state", "/camera")


def test_zenoh_denies_by_default_and_names_every_key():
    config = router(arm("zenoh"), "cloud", 7448)
    access = config["access_control"]
    assert (access["enabled"], access["default_permission"]) == (True, "deny")
    by_id = {rule["id"]: rule for rule in access["rules"]}
    here, robot = access["policies"]
    assert here == {"rules": ["everything"], "subjects": ["here"]}
    assert "everything" not in robot["rules"]
    allowed = [key for rule in robot["rules"] for key in by_id[rule]["key_exprs"]]
    assert sorted(allowed) == sorted([
        "@ros2_lv/**", "*/plan/*/*", "*/tf/*/*", "*/tf/*/*/@adv/**",
        *(f"*/navigate/_action/{part}/*/*" for part in ("send_goal", "get_result", "cancel_goal", "feedback", "status")),
        *(f"*/navigate/_action/{part}/*/*/@adv/**" for part in ("feedback", "status")),
    ])  # fmt: skip
    tls = config["transport"]["link"]["tls"]
    assert tls["enable_mtls"] is True
    assert [one for one in config["listen"]["endpoints"] if not one.startswith("tls/")] == ["tcp/127.0.0.1:7447"]


@given(
    st.lists(st.from_regex(r"[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?", fullmatch=True), min_size=2, max_size=2, unique=True)
)
def test_names_of_certificates_and_interfaces_fit_and_differ(names):
    one, two = names
    for name in names:
        assert all(len(common_name(name, side)) <= 64 for side in SIDES)
        assert all(len(interface(name, side)) <= 15 for side in SIDES)
        assert common_name(name, "robot") != common_name(name, "cloud")
    assert common_name(one, "robot") != common_name(two, "robot")
    assert interface(one, "robot") != interface(two, "robot")


def test_every_application_has_addresses_of_its_own():
    """FogROS2 gave every cloud machine the same address, so that one robot could have one machine."""
    names = [
        "grasp-planning",
        "vslam",
        "motion-planning-apartment",
        "motion-planning-cubicles",
        *(f"arm-{n}" for n in range(40)),
    ]
    for one, two in combinations(names, 2):
        assert not set(addresses(one)) & set(addresses(two))
    for name in names:
        robot, cloud = addresses(name)
        assert int(cloud) == int(robot) + 1


def test_nothing_that_is_written_for_the_cloud_holds_a_key_that_the_robot_made():
    """FogROS2 made the cloud's private key on the robot and sent it; here each end makes its own, where it is used."""
    for name in ("zenoh", "wireguard"):
        files = launch_files(arm(name), Layout.of("specs/x.yaml", "app"))
        script = next(text for path, text in files.items() if path.name == "link.sh").decode()
        assert {path.name for path in files} <= {
            "cloud.launch.py", "link.sh", "cloud.json5", "robot.json5", "cloud.conf", "robot.conf",
            "cloud.fastdds.xml", "robot.fastdds.xml"
        }  # fmt: skip
        assert not re.search(r"\b(scp|rsync|curl|wget|ssh)\b", script)


def test_the_policy_is_the_specs_names_for_each_named_node():
    import xml.etree.ElementTree as ET

    nodes = {"cloud": [{"package": "p", "executable": "e", "name": "planner", "namespace": "/arm"}],
             "robot": [{"package": "p", "executable": "e"}, {"package": "p", "executable": "e", "name": "camera"}]}  # fmt: skip
    app = arm("wireguard", connectivity={"link": "wireguard", **PASSING, "sros2": True}, **nodes)
    files = launch_files(app, Layout.of("specs/x.yaml", "app"))
    root = ET.fromstring(next(text for path, text in files.items() if path.name == "policy.xml"))
    assert (root.tag, root.get("version")) == ("policy", "0.2.0")
    assert [one.get("path") for one in root.iter("enclave")] == ["/app/cloud", "/app/robot"]
    profiles = {(one.get("ns"), one.get("node")): one for one in root.iter("profile")}
    assert set(profiles) == {("/arm", "planner"), ("/", "camera")}
    topics = [one.text for one in profiles["/", "camera"].findall("topics[@publish='ALLOW']/topic")]
    assert topics == ["/tf", "/rosout", "/parameter_events"]
    assert [one.text for one in profiles["/", "camera"].findall("actions[@call='ALLOW']/action")] == ["/navigate"]


def test_config_is_json_and_readable():
    text = LINKS["zenoh"].end(arm("zenoh"), "robot").files["robot.json5"]
    assert json.loads(text)["connect"]["endpoints"] == ["tls/@CLOUD_ADDRESS@:7448"]
    assert max(map(len, text.splitlines())) < 120


def test_the_command_that_opens_the_udp_port_is_one_that_a_shell_reads_as_it_is_meant(tmp_path):
    link, app = LINKS["wireguard"], arm("wireguard")
    spoken = {
        "aws/us-east-1": "--protocol udp --port 51820 --cidr 0.0.0.0/0 --group-id sg-1",
        "gcp/us-central1": "firewall-rules create fogspec-udp-51820 --allow udp:51820 --network sg-1",
        "azure/eastus": "vm open-port --port 51820 --priority 900 --ids sg-1",
    }
    for name in ("aws", "gcloud", "az"):
        # What asks for the machine at the address is answered, what opens is said.
        (tmp_path / name).write_text('#!/bin/sh\ncase "$*" in *203.0.113.7*) echo sg-1 ;; *) echo "$*" ;; esac\n')
        (tmp_path / name).chmod(0o755)
    for infra, expected in spoken.items():
        said = link.opening(app, infra, "203.0.113.7")
        what, _, command = said.partition(": ")
        assert what == "open UDP port 51820 of 203.0.113.7, or the robot cannot connect"
        path = {"PATH": f"{tmp_path}:/usr/bin:/bin"}
        run = subprocess.run(["bash", "-ec", command], capture_output=True, text=True, env=path)
        assert (run.returncode, run.stderr) == (0, "")
        assert run.stdout.strip().endswith(expected)
        assert infra.partition("/")[2] in said or not infra.startswith("aws")
        assert "fogspec apply says the command" in sentence(link.warnings(app, infra.partition("/")[0])[0])
    assert link.opening(app, "lambda/us-east-1", "203.0.113.7").endswith("SkyPilot opens TCP ports only")
    assert link.opening(app, "local", "127.0.0.1") is None


@pytest.mark.parametrize("name", ["none", "zenoh"])
def test_a_tcp_port_is_opened_by_skypilot(name):
    assert LINKS[name].opening(arm(name), "aws/us-east-1", "203.0.113.7") is None
