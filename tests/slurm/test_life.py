"""A job's whole life on the real engine, as the seam says it (tests/seams has the same on a simulated SkyPilot)."""

import time

import pytest

from fogspec.effects.disk.specfiles import read_document
from fogspec.plan import Plan
from fogspec.plugins.runners.skypilot import SkyPilotRunner
from fogspec.plugins.skypilot.calls import PREFIX
from fogspec.seams import Job, LostContact, Progress
from tests.slurm.site import Site

PATIENCE_S = 400.0


@pytest.mark.usefixtures("own_sky")
def test_from_provisioning_to_verified_gone(site: Site) -> None:
    site.compile(site.write("life", ["64CPU--128GB"], steps=40))
    sample = read_document(site.project / "compiled" / "life" / "plan.yaml", Plan).spec.samples[0]
    name = f"{PREFIX}life-{time.monotonic_ns():x}"
    folder = site.project / "attempts" / name
    job = Job(name, sample, site.task("life", "64CPU--128GB"), site.project, folder, 540.0)
    runner = SkyPilotRunner()
    begun = time.monotonic()
    runner.start(job)
    assert runner.look(job).running
    assert time.monotonic() - begun < 5, "it does not wait for the machine"

    other = SkyPilotRunner()
    assert list(other.strays(f"{PREFIX}life-", folder.parent)) == [name]
    first = awaited(other, job)
    assert (first.reason, first.lost, first.stopped_by) == (None, False, "steps"), first
    assert first.timings is not None
    assert len(first.timings.read_text().splitlines()) >= 40
    assert first.measured_s is not None
    assert first.setup_s is not None
    assert 40 * 0.026 <= first.measured_s < first.setup_s
    assert runner.look(job) == first, "looking says the same, whoever looks"

    ended(runner, job)
    ended(other, job)
    assert list(other.strays(f"{PREFIX}life-", folder.parent)) == []
    assert SkyPilotRunner().look(job) == first
    assert not [one for one in site.jobs() if name in one]


def awaited(runner: SkyPilotRunner, job: Job) -> Progress:
    """How it ended."""
    end = time.monotonic() + PATIENCE_S
    while (progress := runner.look(job)).running:
        assert time.monotonic() < end, progress
        time.sleep(0.2)
    return progress


def ended(runner: SkyPilotRunner, job: Job) -> None:
    """End it, however often that must be asked for."""
    end = time.monotonic() + PATIENCE_S
    while True:
        try:
            return runner.end(job)
        except LostContact:
            assert time.monotonic() < end
            time.sleep(1)
