"""A machine on AWS whose controller is gone ends itself, by its own role, at the same API."""

from tests.aws.site import until
from tests.slurm.abandoned import ABANDONED, Abandoned
from tests.tools.aws import engine


def test_a_machine_that_nobody_looks_after_ends_itself(abandoned: Abandoned) -> None:
    site = abandoned.site
    abandoned.up()
    until(lambda: not site.jobs(), 1200 + 60 * abandoned.minutes)
    assert {machine.state for machine in site.instances()} == {"terminated"}, "ended, not only stopped"
    known = engine.clusters(site.cluster, refresh=True)
    assert not [one for one in known if one.startswith(ABANDONED)], "and SkyPilot sees it"
