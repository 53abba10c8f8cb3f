"""The conclusion that the demo ends with: the manifest's own figures."""

import re
from pathlib import Path

import pytest

from tools import demo


def test_the_conclusion_says_what_the_manifest_says(monkeypatch: pytest.MonkeyPatch) -> None:
    name = "grasp-planning-recorded"
    monkeypatch.setattr(demo, "NAME", name)
    monkeypatch.setattr(demo, "RESULTS", Path("results") / f"{name}.yaml")
    said = {line.split()[0]: line for line in demo.conclusion()}
    manifest = Path(f"compiled/{name}/manifest.yaml").read_text("utf-8")
    instance = re.search(r"^ +instance: (\S+)$", manifest, re.MULTILINE)
    month = re.search(r"\$([\d.]+)/month", manifest)
    assert instance
    assert month
    assert f" {instance[1]} in " in said["chosen"]
    assert f" ${float(month[1]):.0f}/month" in said["cost"]
