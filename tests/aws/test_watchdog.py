"""A machine on AWS whose controller is gone ends itself, by its own role, at the same API."""

from tests.aws.conftest import ABANDONED, Abandoned
from tests.aws.site import until
from tests.tools.aws import engine


def test_a_machine_that_nobody_looks_after_ends_itself(abandoned: Abandoned) -> None:
    site, client = abandoned.site, abandoned.client
    until(lambda: client.call("launched", 300, request=abandoned.request, name=ABANDONED), site.patience_s)
    until(lambda: not site.jobs(), site.patience_s)
    (machine,) = site.instances()
    assert machine.state == "terminated", "ended, not only stopped"
    assert ABANDONED not in engine.clusters(site.cluster, refresh=True), "and SkyPilot sees it"
