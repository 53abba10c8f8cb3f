"""`fogspec-lab conformance` through SkyPilot's own AWS provisioner, as anyone with an account starts it."""

import json
import os
import shutil

import pytest

from tests.aws.site import AwsSite
from tests.tools.aws import cloud, shapes


@pytest.mark.rare
@pytest.mark.timeout(3600)
def test_every_step_passes_and_ec2_has_nothing_left(site: AwsSite) -> None:
    site.project.mkdir(parents=True)
    words = ("conformance", "--infra", f"aws/{shapes.REGION}", "--max", "$2", "--yes", "--out", "report.json")
    said = site.run(*words, patience_s=3500, program="fogspec_lab")
    assert "at most $" in said.stderr
    report = json.loads((site.project / "report.json").read_text())
    assert [step["state"] for step in report["steps"]] == ["ok"] * len(report["steps"]), report["steps"]
    assert site.left() == []
    assert {one.type for one in site.instances()} == {one["instance"] for one in report["machines"]}
    # EC2's own list of launches and ends, with a minute at least each.
    assert 0 < site.bill() <= report["worst_usd"] < 2
    assert 0 < report["spent_usd"] <= report["worst_usd"]
    text = json.dumps(report)
    assert [word for word in (str(site.cluster), str(site.project), cloud.ACCOUNT) if word in text] == []
    if keep := os.environ.get("FOGSPEC_KEEP_REPORT"):
        shutil.copy(site.project / "report.json", keep)
