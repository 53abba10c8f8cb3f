"""A machine whose controller is gone ends itself."""

import time

from tests.slurm.conftest import ABANDONED
from tests.slurm.site import Site
from tests.tools.slurm import engine

PATIENCE_S = 240.0


def test_a_machine_that_nobody_looks_after_ends_itself(site: Site, abandoned: float) -> None:
    while any(ABANDONED in name for name in site.jobs()):
        assert time.monotonic() < abandoned + PATIENCE_S, "its lifetime was a minute"
        time.sleep(1)
    assert ABANDONED not in engine.clusters(site.cluster, refresh=True)
    assert site.left() == []
