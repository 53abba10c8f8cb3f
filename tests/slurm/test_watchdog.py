"""A machine whose controller is gone ends itself."""

import time

from tests.slurm.conftest import ABANDONED, Abandoned
from tests.slurm.site import Site
from tests.tools.slurm import engine

PATIENCE_S = 300.0


def test_a_machine_that_nobody_looks_after_ends_itself(site: Site, abandoned: Abandoned) -> None:
    abandoned.up()
    end = time.monotonic() + PATIENCE_S
    while any(ABANDONED in name for name in site.jobs()):
        assert time.monotonic() < end, "its lifetime was a minute"
        time.sleep(1)
    assert ABANDONED not in engine.clusters(site.cluster, refresh=True)
    assert site.left() == []
