"""`fogspec-lab conformance` on a real SkyPilot over a real Slurm."""

import json
import os
import shutil

import pytest

from tests.slurm.abandoned import ABANDONED
from tests.slurm.site import Site


@pytest.mark.rare
@pytest.mark.timeout(1800)
def test_every_step_passes_and_nothing_is_left(site: Site) -> None:
    site.project.mkdir(parents=True)
    words = (
        "conformance",
        "--infra",
        "slurm/fogtest",
        "--max",
        "$2",
        "--catalog",
        str(site.cluster / "catalog.csv"),
        "--yes",
    )
    said = site.run(*words, "--out", "report.json", patience_s=1500, program="fogspec_lab")
    assert "at most $" in said.stderr
    report = json.loads((site.project / "report.json").read_text())
    assert [step["state"] for step in report["steps"]] == ["ok"] * len(report["steps"])
    assert 0 < report["spent_usd"] < report["worst_usd"] < 2
    assert site.left(spare=ABANDONED) == []
    text = json.dumps(report)
    assert [word for word in (str(site.cluster), str(site.project)) if word in text] == []
    if keep := os.environ.get("FOGSPEC_KEEP_REPORT"):
        shutil.copy(site.project / "report.json", keep)
