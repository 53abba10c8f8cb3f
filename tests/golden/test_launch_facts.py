"""What the real launch started from fogspec's launch files, kept as facts, and compared again where there is one."""

import json
import os
import subprocess
import sys

import pytest

from tests.ros.launch_facts import FACTS, LONGEST_S, facts

PYTHON = os.environ.get("ROS_PYTHON", "python3")


def test_the_facts_say_what_the_files_are_for() -> None:
    found = json.loads(FACTS.read_text("utf-8"))
    [planner] = found["cloud.launch.py"]["starts"]
    assert (
        planner["parameters"]
        == "/arm/left:\n  ros__parameters:\n    gain: 38.0\n    model: GQCNN-4.0-PJ\n    rate: 10\n"
    )
    assert planner["arguments"][0] == "--fast"
    built, returned = (found[f"Listing 1, {how}"] for how in ("built", "returned"))
    assert built == returned
    assert [one["program"] for one in built["starts"]] == ["client", "link.sh", "link.sh"]
    assert built["starts"][0]["rmw"] == "rmw_zenoh_cpp"
    assert "This launch deploys nothing" in built["says"][0]


@pytest.mark.slow
@pytest.mark.timeout(8 * LONGEST_S)
def test_the_real_launch_starts_what_the_facts_say() -> None:
    words = [PYTHON, "-c", "import launch, launch_ros.actions"]
    if subprocess.run(words, capture_output=True, check=False).returncode:
        pytest.skip(
            f"{PYTHON} has no launch and launch_ros: they come with ROS 2, and as no package of PyPI; set ROS_PYTHON"
        )
    assert facts(PYTHON) == json.loads(FACTS.read_text("utf-8")), f"{sys.executable} -m tests.ros.launch_facts --write"
