"""The paper's Listing 1, word for word, and constraints that cannot be read: as `fogspec init` meets them."""

from pathlib import Path

import pytest

from fogspec.spec.launch_import import read_launch
from tests.support.running import Shell, shell  # noqa: F401

LAUNCH = """\
import os
from launch import LaunchDescription
from launch_ros.actions import Node
from fogros2 import SkyLaunchDescription


def generate_launch_description():
    planner = Node(package="p", executable="planner")
    SkyLaunchDescription(
        nodes=[planner],
        {constraints}
    )
    return LaunchDescription([Node(package="p", executable="client")])
"""
LISTING_1 = """\
max_latency=0.01,  # 0.01 sec
        max_cost=0.01,  # 0.01 cent per request
        min_cpu=2, max_cpu=64, min_memory=4, max_memory=512, min_memory_cpu_ratio=2, max_memory_cpu_ratio=8,
        gpu_types=["none", "T4"], alpha=0.7, num_steps=100,"""


def test_listing_1_reads_without_loss_and_its_cent_is_said(tmp_path: Path) -> None:
    path = tmp_path / "listing.launch.py"
    path.write_text(LAUNCH.format(constraints=LISTING_1))
    found = read_launch(path)
    assert found.constraints == {"latency": "10ms", "cost": "0.01 cent/request"}
    assert found.hardware == {
        "cpus": "2..64", "memory": "4GiB..512GiB", "memory_per_cpu": "2GiB..8GiB", "gpus": ["none", "T4"],
    }  # fmt: skip
    assert (found.objective, found.stop) == ({"alpha": 0.7}, {"requests": 100})
    [note] = found.notes
    assert note.span.line == 12
    assert "0.01 cent/request" in note.message
    assert "100 times" in note.message


@pytest.mark.parametrize(
    ("constraints", "field"),
    [
        ('max_latency=float(os.environ["LIMIT"]),', "constraints.latency"),
        ('constraint={"max_latency": 0.01, "max_cost": [1]},', "constraints.cost"),
        ('constraint={"max_latency": 0.01, "alpha": compute()},', "objective.alpha"),
        ("gpus=3,", "hardware.gpus"),
        ('constraint={"latnecy": 0.01},', "constraints.latency"),
        ('constraint={"rate": 30, "latency": 0.01},', "constraints.cost"),
        ("cpu_number=4,", "hardware.cpus"),
        ('constraint=os.environ["CONSTRAINT"],', "constraints.latency"),
    ],
)
def test_a_constraint_that_cannot_be_read_leaves_its_field_empty(shell: Shell, constraints: str, field: str) -> None:
    shell.write("a.launch.py", LAUNCH.format(constraints=constraints))
    ended = shell("init", "specs/a.yaml", "--from-launch", "a.launch.py", code=1)
    assert "a.launch.py:11:" in ended.err
    assert f"error[FS115]: spec.{field} has no value" in ended.err
    assert f"{field.rpartition('.')[2]}:" in shell.read("specs/a.yaml")


@pytest.mark.parametrize("constraints", ['constraint={"min_cpu": 4},', "constraint={},", "alpha=0.7,"])
def test_limits_that_a_launch_file_with_constraints_does_not_have_are_not_made_up(
    shell: Shell, constraints: str
) -> None:
    shell.write("a.launch.py", LAUNCH.format(constraints=constraints))
    shell("init", "specs/a.yaml", "--from-launch", "a.launch.py")
    assert not {"latency", "cost"} & {
        line.strip().partition(":")[0] for line in shell.read("specs/a.yaml").splitlines()
    }
