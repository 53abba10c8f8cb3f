"""The life of a manifest on a real SkyPilot over a real Slurm: a robot is served, another alpha, diff, apply, down."""

import json
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

import pytest
from ruamel.yaml import YAML

from tests.slurm.abandoned import ABANDONED
from tests.slurm.conftest import Benched
from tests.slurm.robot import Robot
from tests.slurm.site import Site, recorded

SMALL = "2CPU--4GB"


def manifest(name: str) -> str:
    return f"compiled/{name}/manifest.yaml"


def status(site: Site, spec: str) -> dict[str, Any]:
    return dict(json.loads(site.run("status", spec, "-o", "json").stdout)[0]["deployment"])


def machines(site: Site, name: str) -> list[dict[str, Any]]:
    path = site.project / ".fogspec" / name / "deployment.yaml"
    return list(YAML(typ="safe").load(path)["spec"]["machines"]) if path.exists() else []


def observed(site: Site, spec: str, patience_s: float = 1200.0) -> dict[str, Any]:
    """The status once something was observed."""
    end = time.monotonic() + patience_s
    while True:
        live = status(site, spec)
        if live["observed"] is not None and live["observed"]["p50_s"] is not None:
            return live
        assert time.monotonic() < end, live
        time.sleep(2)


@pytest.fixture
def robot(benched: Benched, tmp_path: Path) -> Iterator[Robot]:
    found = Robot(tmp_path / "robot", benched.site)
    yield found
    found.net.close()


def test_from_measurements_to_a_robot_that_is_served_and_back(benched: Benched, robot: Robot) -> None:
    site, spec = benched.site, benched.spec
    assert "link.sh robot keys" in site.run("apply", manifest("life"), "--yes", code=5).stderr
    robot.make_keys("life")
    said = site.run("apply", manifest("life"), "--yes")
    assert "/month" in said.stderr
    assert str(site.links("life") / "peer") in said.stderr, "what to copy to the robot is said"
    (first,) = machines(site, "life")
    assert (first["state"], first["machine"]["instance"]) == ("serving", SMALL)
    assert first["name"] in site.jobs()
    assert "no changes" in site.run("apply", manifest("life"), "--yes").stdout

    robot.take("life")
    slow = robot.plays("life")
    live = observed(site, spec)
    assert (live["sync"], live["spent_usd"] > 0) == ("Synced", True)
    assert live["health"] in ("NotJudged", "Healthy")
    assert live["observed"]["p50_s"] < median(slow), "what the robot sees has the way in it"

    path = site.project / spec
    path.write_text(path.read_text().replace("alpha: 0", "alpha: 1"))
    differs = site.run("diff", spec).stdout
    assert f"{SMALL} in slurm/fogtest" in differs
    assert "no benchmark needed" in differs
    site.run("apply", manifest("life"), "--yes", code=3)
    site.compile(spec)
    site.run("apply", manifest("life"), "--yes")
    assert site.jobs(ABANDONED) == [one["name"] for one in machines(site, "life")], "the old machine is gone"
    (second,) = machines(site, "life")
    assert second["machine"]["instance"] != SMALL
    robot.take("life")
    assert median(robot.plays("life")) < median(slow) / 2

    assert "nothing is left" in site.run("down", "life").stdout
    assert site.left(spare=ABANDONED) == []
    assert machines(site, "life") == []
    assert not (site.links("life") / "peer").exists()


def test_an_apply_that_was_killed_leaves_nothing_after_down(site: Site) -> None:
    """Also when the live state is lost with it: the machine is found by its label."""
    spec = site.write("killed-apply", [SMALL])
    site.compile(spec)
    recorded(site, "killed-apply")
    site.compile(spec)
    applying = subprocess.Popen(
        site._argv(("apply", manifest("killed-apply"), "--yes")), cwd=site.project,
        env=site._env(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    end = time.monotonic() + 1200
    while not [name for name in site.jobs() if name.startswith("fogspec-") and "-killed-apply-" in name]:
        assert time.monotonic() < end
        assert applying.poll() is None
        time.sleep(0.5)
    applying.send_signal(signal.SIGKILL)
    applying.wait()
    (site.project / ".fogspec" / "killed-apply" / "deployment.yaml").unlink()
    assert "1 ended" in site.run("down", "killed-apply").stdout
    assert site.left(spare=ABANDONED) == []
