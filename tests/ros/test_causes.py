"""A sample without a response says why, as far as the graph or a node's output shows it."""

import pytest

from tests.ros.benching import bench, node
from tests.ros.namespaces import Net

TOPICS = {"request": "/imu", "response": "/pose"}
CAUSES = {
    "inactive": "no node publishes /pose: /planner is unconfigured: it was not activated",
    "map": "no response to them on /pose: /map: offered volatile, requested transient local by /planner",
    "elsewhere": "no response to them on /pose: no node subscribes to /imu",
    "extrapolation": "Lookup would require extrapolation into the past",
}


@pytest.mark.parametrize("kind", CAUSES)
def test_silence_has_a_cause(net: Net, kind: str) -> None:
    spec = {
        "cloud": [node("silent", kind)], "probe": TOPICS,
        "benchmark": {"workload": {"node": node("client", "topic", 4000)}, "ready_timeout": "30s",
                      "stop": {"duration": "10min"}},
    }  # fmt: skip
    sample, _ = bench(net, spec)
    assert (sample["state"], sample["reason"]) == ("failed", "no_response"), sample
    assert CAUSES[kind] in sample["detail"], sample["detail"]


def test_a_process_in_another_graph_is_named(net: Net) -> None:
    there = node("busy", "topic", 0.02, net.folder / "truth")
    spec = {
        "cloud": [{"cmd": ["env", "ROS_DOMAIN_ID=119", *there["cmd"]]}], "probe": TOPICS,
        "benchmark": {"workload": {"node": node("client", "topic", 4000)}, "ready_timeout": "30s",
                      "stop": {"duration": "10min"}},
    }  # fmt: skip
    sample, _ = bench(net, spec)
    assert "has ROS_DOMAIN_ID 119, and the sample " in sample["detail"], sample["detail"]
