"""What the real launch started from fogspec's launch files, kept as facts.

`launch` is no package of PyPI: `ROS_PYTHON=python3 python -m tests.ros.launch_facts` compares them where ROS 2 is installed.
"""

import json

from tests.ros.launch_facts import FACTS


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
