"""A node of one's own gets what its launch file says from the player of the wheels: name, namespace, parameters, remappings."""

import json
from pathlib import Path

from fogspec.base.layout import Layout
from fogspec.compile.launch_files import robot_launch
from tests.ros.namespaces import PYTHON, ROOT, Net
from tests.tools import ros_prefix
from tests.unit.compile.test_tasks import application

NODE = """\
#!{python}
import json, rclpy
rclpy.init()
node = rclpy.create_node("own", automatically_declare_parameters_from_overrides=True)
names = ("gain", "rate", "text", "list", "deep.flag", "filed")
values = {{name: node.get_parameter(name).value for name in names}}
print(json.dumps([node.get_fully_qualified_name(), node.resolve_topic_name("image"), values]), flush=True)
"""
SAYS = {
    "package": "own", "executable": "node", "name": "planner", "namespace": "/arm", "remappings": {"image": "/camera/image"},
    "parameters": {"gain": 38.0, "rate": 38, "text": "7", "list": [1.0, 2.5], "deep": {"flag": True}},
    "parameter_files": ["own.yaml"],
}  # fmt: skip


def test_a_node_is_given_what_its_launch_file_says(net: Net, tmp_path: Path) -> None:
    (tmp_path / "ros" / "bin").mkdir(parents=True)
    ros_prefix.write(tmp_path / "ros", str(tmp_path / "ros"))
    program = tmp_path / "prefix" / "lib" / "own" / "node"
    program.parent.mkdir(parents=True)
    program.write_text(NODE.format(python=PYTHON))
    program.chmod(0o755)
    layout = Layout.of(tmp_path / "specs" / "own.yaml", "own")
    layout.robot.parent.mkdir(parents=True)
    layout.spec.parent.mkdir()
    (layout.spec.parent / "own.yaml").write_text("/arm/planner: {ros__parameters: {filed: [a, b], rate: 1}}\n")
    content = robot_launch(application(robot=[SAYS], ros={}), layout)
    assert content is not None
    layout.robot.write_bytes(content)
    path = f"{tmp_path}/ros/bin:{PYTHON.parent}:/usr/bin:/bin"
    play = [
        "env",
        f"PATH={path}",
        f"AMENT_PREFIX_PATH={tmp_path}/prefix",
        f"PYTHONPATH={ROOT}",
        "ros2",
        "launch",
        str(layout.robot),
    ]
    played = net.run(play, 600)
    assert played.returncode == 0, played.stderr
    assert json.loads(played.stdout.splitlines()[-1]) == [
        "/arm/planner", "/camera/image",
        {"gain": 38.0, "rate": 38, "text": "7", "list": [1.0, 2.5], "deep.flag": True, "filed": ["a", "b"]},
    ]  # fmt: skip
