"""The link's script without a network: keys, public halves, and what is refused; and what the task is told."""

import stat
import subprocess
from pathlib import Path

import pytest

from fogspec.base.errors import InvalidInput, Refused
from fogspec.base.layout import Layout
from fogspec.base.templates import render
from fogspec.catalog.machine import Machine
from fogspec.compile.launch_files import launch_files, link_of_machine, link_script
from fogspec.compile.tasks import deploy_task, deploy_work, deployed_processes, ros_environment
from fogspec.deploy import link as link_files
from fogspec.language.schema import Application
from tests.support.jobs import GENERATED
from tests.unit.compile.test_tasks import application

LAYOUT = Layout.of("specs/x.yaml", "app")


@pytest.fixture(autouse=True)
def links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FOGSPEC_LINKS", str(tmp_path / "my links"))
    return tmp_path / "my links"


def arm(link: str = "zenoh") -> Application:
    return application(ros={}, connectivity={"link": link, "expose": {"/t": "topic"}})


def at(app: Application, side: str, *words: str, said: str = "") -> "subprocess.CompletedProcess[str]":
    script = link_script(app, LAYOUT)
    return subprocess.run(["bash", "-c", script, "link.sh", side, *words], input=said, capture_output=True, text=True)


def test_keys_are_made_once_and_are_the_owners_alone(links):
    app = arm()
    public = at(app, "robot", "keys").stdout.strip()
    private = links / "app" / "robot" / "private.key"
    before = private.read_bytes()
    assert stat.S_IMODE(private.stat().st_mode) == 0o600
    assert stat.S_IMODE(private.parent.stat().st_mode) == 0o700
    assert at(app, "robot", "keys").stdout.strip() == public
    assert private.read_bytes() == before
    assert link_files.environment(app, LAYOUT) == {"FOGSPEC_LINK_PEER": public}
    assert "PRIVATE" not in public


def test_before_the_robot_has_a_key_nothing_is_launched():
    with pytest.raises(Refused) as refused:
        link_files.environment(arm(), LAYOUT)
    assert "on the robot: bash compiled/app/link/link.sh robot keys" in refused.value.hints
    assert link_files.environment(application(), LAYOUT) == {}


def test_public_halves_are_exchanged_and_forgotten(links):
    app = arm()
    assert at(app, "robot", "keys").returncode == 0
    cloud = at(app, "cloud", "keys").stdout
    files = link_files.join(app, LAYOUT, "203.0.113.7", cloud)
    assert {path.name: path.read_text().strip() for path in files} == {"peer": cloud.strip(), "address": "203.0.113.7"}
    link_files.leave(app, LAYOUT)
    link_files.leave(app, LAYOUT)
    assert sorted(path.name for path in (links / "app" / "robot").iterdir()) == ["private.key", "public", "public.pem"]


@pytest.mark.parametrize(("address", "kept"), [("2001:db8::1", "[2001:db8::1]"), ("host.example", "host.example")])
def test_an_address_is_kept_as_a_url_wants_it(links, address, kept):
    assert at(arm(), "robot", "address", address).returncode == 0
    assert (links / "app" / "robot" / "address").read_text().strip() == kept


@pytest.mark.parametrize("address", ["", "a b", "x;touch owned", "$(id)", "a/b", 'a"b'])
def test_what_is_no_address_is_refused(address, links):
    assert at(arm(), "robot", "address", address).returncode == 1
    assert not (links / "app" / "robot" / "address").exists()


def test_what_is_no_public_half_of_the_other_end_is_refused():
    app = arm()
    robot = at(app, "robot", "keys").stdout
    for said in ("", "\n", "hello", "AAAA", "$(id)", robot):
        refused = at(app, "robot", "peer", said=said)
        assert refused.returncode == 1, said
        assert refused.stderr.startswith("link: ")
    with pytest.raises(InvalidInput, match=r"certificate of CN=robot\.app, not of CN=cloud\.app"):
        link_files.join(app, LAYOUT, "203.0.113.7", robot)


@pytest.mark.parametrize("link", ["zenoh", "wireguard"])
def test_a_private_key_is_not_taken_for_a_public_half(link, links):
    app = arm(link)
    if link == "wireguard" and subprocess.run(["bash", "-c", "command -v wg"], capture_output=True).returncode:
        pytest.skip("needs wg: apt-get install wireguard-tools")
    assert at(app, "robot", "keys").returncode == 0
    private = (links / "app" / "robot" / "private.key").read_text()
    body = "".join(line for line in private.splitlines() if not line.startswith("-----"))
    assert at(app, "robot", "peer", said=body).returncode == 1


def test_up_before_the_exchange_says_what_is_missing(tmp_path):
    app = arm()
    layout = Layout.of(tmp_path / "specs" / "x.yaml", "app")
    for path, content in launch_files(app, layout).items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    run = subprocess.run(["bash", str(layout.link / "link.sh"), "robot", "up"], capture_output=True, text=True)
    assert (run.returncode, run.stderr) == (1, "link: the cloud end is not known here: link.sh robot peer\n")


def test_the_compiled_script_prints_the_public_half_and_never_the_private_one(tmp_path, links):
    app = arm()
    layout = Layout.of(tmp_path / "specs" / "x.yaml", "app")
    for path, content in launch_files(app, layout).items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    ran = [
        subprocess.run(
            ["bash", str(layout.link / "link.sh"), "robot", "keys"], check=True, capture_output=True, text=True
        )
        for _ in range(2)
    ]
    public = (links / "app" / "robot" / "public").read_text()
    assert [one.stdout.strip() for one in ran] == [public.strip()] * 2
    body = (links / "app" / "robot" / "private.key").read_text().splitlines()[1]
    assert all(body not in one.stdout + one.stderr for one in ran)
    assert list(layout.link.rglob("*key*")) == [], "no key is beside the compiled files"


def deployed(app: Application, infra: str = "aws/us-east-1") -> dict:
    machine = Machine(infra=infra, instance="m6i.large", cpus=2.0, memory=8.0, price=0.096)
    return deploy_task(app, machine, deploy_work(app, LAYOUT))


def test_the_task_asks_for_the_robots_public_half_and_opens_one_port():
    task = deployed(arm())
    assert task["envs"] == {"FOGSPEC_LINK_PEER": None}
    assert task["resources"]["ports"] == [7448]
    assert task["file_mounts"]["~/.fogspec/link"] == "compiled/app/link"
    assert task["file_mounts"]["~/.fogspec/launch/cloud.launch.py"] == "compiled/app/cloud.launch.py"
    assert "ports" not in deployed(arm("wireguard"))["resources"], "SkyPilot opens TCP ports only"
    assert "ports" not in deployed(arm(), "slurm/lab")["resources"], "SkyPilot opens none there"


def test_the_link_starts_first_and_nodes_by_ros2_launch(tmp_path):
    (link, nodes) = deployed_processes(arm())
    said = tmp_path / "said"
    for name in ("bash", "ros2"):
        (tmp_path / name).write_text(f'#!/bin/sh\necho {name} "$@" >> "{said}"\n')
        (tmp_path / name).chmod(0o755)
    for words in (link, nodes):
        subprocess.run(words, check=True, env={"PATH": f"{tmp_path}:/usr/bin:/bin", "HOME": "/home/me and you"})
    assert said.read_text().splitlines() == [
        "bash /home/me and you/.fogspec/link/link.sh cloud up",
        "ros2 launch /home/me and you/.fogspec/launch/cloud.launch.py",
    ]
    assert deployed_processes(application(cloud=[{"cmd": ["./x", "y"]}])) == [{"argv": ["./x", "y"], "name": "x y"}]


def run_script(app: Application) -> str:
    ros = ros_environment(app.spec)
    return render(
        "deploy.sh.j2",
        **GENERATED,
        **ros,
        processes=deployed_processes(app),
        listeners=[],
        asks=None,
        ready=None,
        ends=False,
        link=link_of_machine(app),
    )


@pytest.mark.parametrize("link", ["zenoh", "wireguard"])
def test_the_machines_scripts_pass_shellcheck(link, tmp_path):
    for text in (run_script(arm(link)), link_script(arm(link), LAYOUT)):
        script = tmp_path / "script.sh"
        script.write_text(text)
        try:
            checked = subprocess.run(["shellcheck", "-s", "bash", "-S", "warning", "-e", "SC1091", str(script)],
                                     capture_output=True, text=True)  # fmt: skip
        except FileNotFoundError:
            pytest.skip("needs shellcheck: apt-get install shellcheck")
        assert checked.returncode == 0, checked.stdout


def machine(tmp_path: Path, **environment: str) -> "subprocess.CompletedProcess[str]":
    """The deployment's run script on a machine: real but for ROS 2 and for what keeps the nodes running."""
    app, folder = arm(), tmp_path / "compiled" / "app"
    layout = Layout.of(tmp_path / "specs" / "x.yaml", "app")
    for path, content in launch_files(app, layout).items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    (tmp_path / "agent.pyz").write_text("import os; print(os.environ['RMW_IMPLEMENTATION'])")
    (tmp_path / "setup.bash").write_text("")
    script = run_script(app).replace("/opt/ros/jazzy/setup.bash", str(tmp_path / "setup.bash"))
    words = {"PATH": "/usr/bin:/bin", "HOME": str(tmp_path / "home"), "FOGSPEC_AGENT": str(tmp_path / "agent.pyz"),
             "FOGSPEC_OUT": str(tmp_path / "out"), "FOGSPEC_LINK": str(folder / "link")}  # fmt: skip
    return subprocess.run(["bash", "-c", script], capture_output=True, text=True, env=words | environment)


def test_the_machine_makes_its_own_key_and_hands_out_its_public_half(tmp_path, links):
    public = at(arm(), "robot", "keys").stdout.strip()
    run = machine(tmp_path, FOGSPEC_LINK_PEER=public)
    assert (run.returncode, run.stdout) == (0, "rmw_zenoh_cpp\n"), run.stderr
    mine = tmp_path / "home" / ".fogspec" / "links" / "app" / "cloud"
    assert (tmp_path / "out" / "link.pub").read_text() == (mine / "public").read_text()
    assert (mine / "peer").read_text().strip() == public
    assert (mine / "private.key").read_bytes() != (links / "app" / "robot" / "private.key").read_bytes()
    link_files.join(arm(), LAYOUT, "203.0.113.7", (tmp_path / "out" / "link.pub").read_text())


@pytest.mark.parametrize("peer", [{}, {"FOGSPEC_LINK_PEER": ""}, {"FOGSPEC_LINK_PEER": "AAAA"}])
def test_without_the_robots_public_half_no_node_starts(tmp_path, peer):
    run = machine(tmp_path, **peer)
    assert run.returncode == 1
    assert "rmw_zenoh_cpp" not in run.stdout
    assert "link: " in run.stderr
