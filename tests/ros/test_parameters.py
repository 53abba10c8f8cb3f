"""A node gets each parameter with the value and the type that its spec says, measured and deployed alike.

The launch of the wheels is not ROS 2's own, which hands files on as they are: what counts here is what a node makes of them.
"""

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from fogspec.base.layout import Layout
from fogspec.compile.launch_files import launch_files
from fogspec.compile.tasks import command
from fogspec.language.schema import Node
from tests.ros.namespaces import PYTHON, Net
from tests.support.launching import launched
from tests.unit.compile.test_tasks import application

NODE = """\
import json, sys, rclpy
rclpy.init(args=sys.argv)
node = rclpy.create_node("own", automatically_declare_parameters_from_overrides=True)
some = {name: one.value for name, one in node.get_parameters_by_prefix("v").items()}
print(json.dumps({name: list(one) if hasattr(one, "typecode") else one for name, one in some.items()}))
"""
VALUES: list[Any] = [
    True, False, 0, -1, 38, 2**53 + 1, 2**63 - 1, -(2**63), 0.0, 38.0, -2.5, 1e22, 1e-7, 1.7976931348623157e308,
    "", " ", "1", "007", "08", "1e3", "123E5", "0x1F", "1_000", "3.", ".5", "+1", "1.0", "nan", ".nan", "inf", ".inf",
    "infinity", "true", "True", "yes", "no", "on", "off", "y", "N", "null", "~", "2026-11-30", "12:30", "#a", "- a", "a: b",
    "{a: 1}", "[1]", "'", '"', "\\", "$HOME", "%d", "@a", "!a", "&a", "*a", "é", "a\tb", "a\nb",
    [True, False], [1, 2], [1], [1.0, 2.5], ["007", "1e3"], ["", "y"], ["true", "08"], ["a, b", "[c]"],
]  # fmt: skip


@pytest.mark.parametrize("road", ["measured", "deployed"])
def test_values_and_types_arrive(net: Net, tmp_path: Path, road: str) -> None:
    set_to = {f"n{number}": value for number, value in enumerate(VALUES)}
    node = {"package": "own", "executable": "node", "parameters": {"v": set_to}}
    if road == "measured":
        argv = command(Node.model_validate(node))
        words = argv[argv.index("--ros-args") :]
    else:
        layout = Layout.of(tmp_path / "specs" / "own.yaml", "own")
        layout.cloud.parent.mkdir(parents=True)
        layout.cloud.write_bytes(launch_files(application(cloud=[node], ros={}), layout)[layout.cloud])
        (one,) = launched(layout.cloud)
        words = ["--ros-args", "--params-file", *one.keywords["parameters"]]
    ran: subprocess.CompletedProcess[str] = net.run([str(PYTHON), "-c", NODE, *words], 600)
    assert ran.returncode == 0, ran.stderr
    found = json.loads(ran.stdout.splitlines()[-1])
    wrong = {name: (value, found.get(name)) for name, value in set_to.items() if repr(found.get(name)) != repr(value)}
    assert not wrong
