"""A machine whose controller is gone ends itself."""

import time

from tests.slurm.abandoned import ABANDONED, Abandoned
from tests.slurm.site import Site
from tests.tools.slurm import engine

PATIENCE_S = 600.0


def test_a_machine_that_nobody_looks_after_ends_itself(site: Site, abandoned: Abandoned) -> None:
    abandoned.up()
    end = time.monotonic() + PATIENCE_S + 60 * abandoned.minutes
    while any(ABANDONED in name for name in site.jobs()):
        assert time.monotonic() < end, "its lifetime is over"
        time.sleep(1)
    assert not [one for one in engine.clusters(site.cluster, refresh=True) if one.startswith(ABANDONED)]
    assert site.left() == []
