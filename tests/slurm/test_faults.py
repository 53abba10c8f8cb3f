"""A handful of faults on the real engine; `make slurm-faults` has them by the dozen."""

import random

from tests.slurm.abandoned import ABANDONED
from tests.slurm.faults import MACHINES, Once, Storm, judge, wrong
from tests.slurm.site import Site


def test_what_breaks_is_a_state_of_a_sample_and_nothing_is_measured_twice(site: Site) -> None:
    nodes = {"s-1x2": "memory", "c-2x4": "crash", "c-16x32": "garbage"}
    broken = [
        (Once("sets up", "c-16x32"), "interrupt"),
        (Once("measures", "c-16x32"), "controller"),
        (Once("measures", "c-16x32"), "worker"),
        (Once("measures", "c-16x32"), "server"),
    ]
    storm = Storm(site, nodes, [*broken], random.Random(1), spare=ABANDONED)
    assert storm.run("storm", steps=500) == 3, "one bench was stopped, one killed, and one ended"
    assert storm.done == len(broken)
    assert storm.stopped == [(130, [])], "Ctrl-C in the middle of launches leaves nothing"

    records = site.results("storm")
    said = {node: (records[name].state, records[name].reason) for node, name in MACHINES.items()}
    assert said["s-1x2"] == ("failed", "out_of_memory")
    # All nodes are one host here, with one counter: the kernel's end of a process of s-1x2 may fall into this sample too.
    assert said["c-2x4"] in (("failed", "crash"), ("failed", "out_of_memory"))
    assert said["c-16x32"][0] == "ok"
    assert "unreadable lines" in (records["16CPU--32GB"].detail or "")
    assert "an error of its own" in (records["2CPU--4GB"].detail or "")
    attempts = [one.name for one in (site.project / ".fogspec" / "storm" / "attempts").iterdir()]
    assert sum("c-16x32" in name for name in attempts) == 2, "what ran on without its controller was not started again"
    found = judge(site, "storm", spare=ABANDONED)
    assert wrong(found) == 0, found
