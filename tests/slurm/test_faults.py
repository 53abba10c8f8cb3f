"""A handful of faults on the real engine; `make slurm-faults` has them by the dozen."""

import random

from tests.slurm.faults import MACHINES, Measuring, Storm, judge, wrong
from tests.slurm.site import Site


def test_what_breaks_is_a_state_of_a_sample(site: Site) -> None:
    nodes = {"s-1x2": "memory", "c-2x4": "crash", "c-16x32": "garbage"}
    storm = Storm(site, nodes, [(Measuring(1), "worker"), (Measuring(1), "server")], random.Random(1))
    assert storm.run("storm", steps=300) == 1
    assert storm.done == 2
    records = site.results("storm")
    said = {node: (records[name].state, records[name].reason) for node, name in MACHINES.items()}
    assert said["s-1x2"] == ("failed", "out_of_memory")
    assert said["c-2x4"] == ("failed", "crash")
    assert said["c-16x32"][0] == "ok"
    assert "unreadable lines" in (records["16CPU--32GB"].detail or "")
    assert "an error of its own" in (records["2CPU--4GB"].detail or "")
    found = judge(site, "storm")
    assert wrong(found) == 0, found
