"""Constraints in launch files as `fogspec init` reads them: as keywords, as in the paper's Listing 1, and unreadable ones."""

from pathlib import Path

import pytest
import yaml

from fogspec.importers.launch import read_launch
from tests.conftest import SHARED
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
KEYWORDS = """\
max_latency=0.01,  # 0.01 sec
        max_cost=0.01,  # 0.01 cent per request
        min_cpu=2, max_cpu=64, min_memory=4, max_memory=512, min_memory_cpu_ratio=2, max_memory_cpu_ratio=8,
        gpu_types=["none", "T4"], alpha=0.7, num_steps=100,"""


def test_keywords_read_without_loss_and_their_cent_is_said(tmp_path: Path) -> None:
    path = tmp_path / "listing.launch.py"
    path.write_text(LAUNCH.format(constraints=KEYWORDS))
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


# The shape of Listing 1: nothing is imported, and the keys are names.
WITHOUT_IMPORTS = """\
def generate_launch_description():
    {description}([
        Node(package="depot", executable="map_builder"),
    ], {constraint}{{
        latency: 0.25,
        cost: 0.02,
    }})
    return LaunchDescription([Node(package="depot", executable="map_client")])
"""
PAPER = SHARED / "data" / "paper" / "fogros2-config.tex"


def imported(shell: Shell, text: str) -> dict:
    """The body of the spec that `init` writes of a launch file, which must be valid."""
    shell.write("a.launch.py", text)
    shell("init", "specs/a.yaml", "--from-launch", "a.launch.py")
    return yaml.safe_load(shell.read("specs/a.yaml"))["spec"]


@pytest.mark.parametrize("description", ["fogros2.SkyLaunchDescription", "SkyLaunchDescription"])
@pytest.mark.parametrize("constraint", ["constraint = ", ""])
def test_a_launch_file_of_the_shape_of_listing_1_keeps_its_limits(
    shell: Shell, description: str, constraint: str
) -> None:
    spec = imported(shell, WITHOUT_IMPORTS.format(description=description, constraint=constraint))
    assert spec["constraints"] == {"latency": "250ms", "cost": "0.02 cent/request"}
    assert [one["executable"] for one in (*spec["cloud"], *spec["robot"])] == ["map_builder", "map_client"]


@pytest.mark.skipif(not PAPER.is_file(), reason="FOGSPEC_SHARED has no data/paper/fogros2-config.tex")
def test_the_papers_own_listing_keeps_its_limits(shell: Shell) -> None:
    listing = PAPER.read_text("utf-8").split("\\begin{listing}")[1].split("\\end{minted}")[0].split("{py}\n")[1]
    spec = imported(shell, listing)
    assert spec["constraints"] == {"latency": "10ms", "cost": "0.01 cent/request"}
    assert (len(spec["cloud"]), len(spec["robot"])) == (1, 1)


@pytest.mark.parametrize(
    "entry", ['launched(planner, constraint={"latency": 0.01})', "[]  # constraints: see depot.yaml"]
)
def test_where_no_node_can_be_read_the_limits_of_the_file_are_left_empty(shell: Shell, entry: str) -> None:
    shell.write(
        "a.launch.py", f"from depot import launched\n\n\ndef generate_launch_description():\n    return {entry}\n"
    )
    ended = shell("init", "specs/a.yaml", "--from-launch", "a.launch.py", code=1)
    assert "a.launch.py:5:5" in ended.err
    for field in ("latency", "cost"):
        assert f"error[FS115]: spec.constraints.{field} has no value" in ended.err
