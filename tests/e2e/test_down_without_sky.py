"""`fogspec down` where SkyPilot is not installed: what runs on this host is ended all the same."""

import pytest

from fogspec.backends.registry import owner_of
from fogspec.base.errors import CloudError
from fogspec.base.layout import Layout
from fogspec.deploy.down import down
from fogspec.deploy.state import SystemWallClock


class Host:
    name = "local"

    def __init__(self, layout: Layout) -> None:
        self.left = [owner_of(layout).deployment_name("sha256:01234567", "0123ab")]

    def list(self, *_: object) -> list[str]:
        return list(self.left)

    def stop(self, job) -> None:
        self.left.remove(job.name)


def test_what_can_be_ended_is_ended_and_what_cannot_be_asked_is_said(tmp_path):
    layout = Layout(tmp_path, tmp_path / "specs/arm.yaml", "arm")
    host = Host(layout)

    def elsewhere():
        raise CloudError("SkyPilot is not installed here", "pip install it")

    with pytest.raises(CloudError) as failed:
        down(layout, [elsewhere, lambda: host], SystemWallClock(), print)
    assert host.left == []
    assert "SkyPilot is not installed here; pip install it" in failed.value.hints
