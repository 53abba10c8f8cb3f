"""An application that is measured and compiled for a cloud, with SkyPilot as the tests simulate it."""

from collections.abc import Iterator

import pytest

from fogspec.backends import registry
from fogspec.backends.skypilot.backend import SkyPilotDeployments
from tests.support.fake_sky import Cloud, beside
from tests.support.running import Shell, copied, measure, project

AT = ("--catalog", "offers.csv")
MANIFEST = "compiled/demo/manifest.yaml"
WORK = """\
import time
import fogspec_probe
while True:
    fogspec_probe.start("plan")
    time.sleep(0.02)
    fogspec_probe.stop("plan")
"""


@pytest.fixture
def cloud(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cloud]:
    """The cloud, where nothing runs yet; what runs there when the test is over is ended."""

    def fill(made: Shell) -> None:
        project(made, WORK)
        measure(made)
        made("compile", "specs/demo.yaml", *AT)

    copied(shell, "an application that is measured for a cloud", fill)
    found = Cloud(shell.folder.parent / "cloud")
    monkeypatch.setattr(SkyPilotDeployments, "poll_s", 0.05)
    monkeypatch.setattr(registry, "deployment_backend", beside(registry.deployment_backend, found))
    yield found
    for name in list(found.machines):
        found.end(name)
