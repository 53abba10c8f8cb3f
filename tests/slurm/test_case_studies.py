"""A case study as it is on Slurm: its compiled task builds the workspace on a node with ROS 2, for a user who is not root."""

import shutil

import pytest

from tests.ros.namespaces import ROOT
from tests.slurm.site import Site

NODES = ("2CPU--4GB", "2CPU--16GB")
# Where it is measured, and fewer requests; the rest is what the repository has.
CHANGES = {
    "infra: [aws/us-east-1]": "infra: [slurm/fogtest]",
    "allow: [c6i.*, m6i.*, r6i.*, c7i.*, m7i.*, c6a.*, m6a.*, c7a.*, m7a.*]": "allow: ['*']",
    "machines: [local/1cpu-2gib, local/2cpu-2gib]": f"machines: [{', '.join(NODES)}]\n    budget: $5\n    ready_timeout: 10min",
    "warmup: 10": "warmup: 2",
    "requests: 130, duration: 1min": "requests: 15, duration: 5min",
}


@pytest.mark.rare
def test_two_nodes_of_one_network_measure_visual_slam_and_do_not_hear_each_other(site: Site) -> None:
    specs = site.project / "specs"
    ignored = shutil.ignore_patterns("build", "install", "log", "__pycache__")
    shutil.copytree(ROOT / "specs" / "ros2_ws", specs / "ros2_ws", ignore=ignored)
    text = (ROOT / "specs" / "vslam.yaml").read_text("utf-8")
    for old, new in CHANGES.items():
        assert old in text
        text = text.replace(old, new)
    (specs / "vslam.yaml").write_text(text, "utf-8")
    site.compile("specs/vslam.yaml")
    assert site.bench("specs/vslam.yaml").ended() == 0
    records = site.results("vslam")
    assert {name: one.state for name, one in records.items()} == dict.fromkeys(NODES, "ok")
    for one in records.values():
        assert one.requests >= 15
        assert one.failed_requests == 0
        # Half of all responses, if it heard the other's camera too; a listener that is late may miss one of its own.
        assert 5 * (one.unmatched or 0) < one.requests
        assert 0 < one.metrics["drift"] < 0.2
    assert site.left() == []
