"""A machine on AWS whose controller is gone ends itself, by its own role, at the same API."""

import os

from fogspec.backends.skypilot.client import Client
from tests.aws.site import AwsSite, until
from tests.tools.aws import engine

NAME = "fogspec-abandoned"


def test_a_machine_that_nobody_looks_after_ends_itself(site: AwsSite) -> None:
    site.compile(site.write("hangs", ["c6i.xlarge"]))
    task = site.task("hangs", "c6i.xlarge")
    task["resources"]["autostop"]["idle_minutes"] = 1
    task["run"] = "sleep 3600"
    before, given = dict(os.environ), engine.environment(site.cluster)
    with Client() as client:
        try:
            os.environ.clear()
            os.environ.update(given)
            client.ready()
        finally:
            os.environ.clear()
            os.environ.update(before)
        asked = client.call("launch", 300, task=task, name=NAME, root=str(site.project))
        until(lambda: client.call("launched", 300, request=asked["request"], name=NAME), 900.0)
    (machine,) = site.instances()
    assert (machine.name, machine.state) == (NAME, "running")
    until(lambda: not site.jobs(), 900.0)
    (machine,) = site.instances()
    assert machine.state == "terminated", "ended, not only stopped"
    assert NAME not in engine.clusters(site.cluster, refresh=True), "and SkyPilot sees it"
