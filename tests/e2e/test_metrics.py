"""The third objective as a user meets it: a metric of the application in every output, with its interval, limit and unit."""

import json
import re
from pathlib import Path

import pytest
import yaml

from fogspec.base.layout import Layout
from fogspec.language.fingerprints import measured_record
from fogspec.language.loader import load
from fogspec.results.io import read_results
from tests.support.menus import with_role
from tests.support.results import write
from tests.support.running import Shell, shell  # noqa: F401

ROOT = Path(__file__).resolve().parents[2]
SPEC = "specs/vslam-recorded.yaml"


@pytest.fixture
def there(shell: Shell) -> Shell:
    """SLAM's samples, with a path length that falls with the vCPUs, weighed in place of the latency."""
    text = (ROOT / SPEC).read_text("utf-8")
    text = text.replace(
        "  constraints:\n", "  metrics: { path_length: { topic: /length, field: data, unit: m } }\n  constraints:\n"
    )
    text = text.replace("    latency: 40ms", "    metrics: { path_length: 40 }\n    latency: 1s")
    spec = shell.write(SPEC, text.replace("alpha: 0.5", "alpha: 0.9\n    metric: path_length"))
    recorded = read_results(Layout.of(str(ROOT / SPEC), "vslam-recorded"))
    assert recorded is not None
    samples = [
        one.model_copy(update={"metrics": {"path_length": 30 + 40 / one.machine.cpus}}) for one in recorded.spec.samples
    ]
    record = measured_record(load([str(spec)])[0].application)
    body = recorded.spec.model_copy(update={"samples": samples, "inputs": record})
    write(shell.folder / "results" / "vslam-recorded", body)
    return shell


def test_the_menu_names_the_metric_in_headings_and_columns(there: Shell) -> None:
    out = there("menu", "vslam-recorded").out
    assert "<= 40" in out  # in the heading of its column
    assert re.search(r"3\d(\.\d+)?\s+m", out)
    assert "metrics.path_length at most 40 m" in out
    assert "least path_length" in out


def test_every_file_carries_value_interval_limit_and_unit(there: Shell) -> None:
    there("compile", SPEC)
    folder = there.folder / "compiled" / "vslam-recorded"
    menu = yaml.safe_load((folder / "menu.yaml").read_text("utf-8"))["spec"]
    assert with_role(menu, "balanced")
    assert with_role(menu, "least")
    for entry in menu["front"]:
        found = entry["metrics"]["path_length"]
        low, high = found["interval"]
        assert low <= found["value"] <= high
        assert (found["limit"], found["unit"]) == (40, "m")
    assert menu["metric"] == "path_length"
    assert menu["scale"]["path_length"] == "40 m"
    manifest = yaml.safe_load((folder / "manifest.yaml").read_text("utf-8"))
    [expected] = manifest["expected"]["metrics"]
    assert (expected["name"], expected["limit"], expected["unit"]) == ("path_length", 40, "m")
    assert expected["interval"][0] <= expected["predicted"] <= expected["interval"][1]
    every, latency = (manifest["expected"][one]["probability_met"] for one in ("limits", "latency"))
    assert 0.9 < every <= min(expected["probability_met"], latency)
    assert max(expected["probability_met"], latency) <= 0.999, "no model is certain, of one limit or of all"
    assert "path_length in m" in (folder / "menu.svg").read_text("utf-8")
    out = there("explain", "vslam-recorded").out
    assert " m [" in out
    assert "metrics.path_length: " in out


def test_the_metric_and_its_limit_can_be_others_for_once(there: Shell) -> None:
    of_latency = there("menu", "vslam-recorded", "--metric", "latency", "--limit", "path_length=none").out
    assert "0.90 latency" in of_latency
    assert "metrics.path_length" not in of_latency.split("\n")[1]
    [menu] = json.loads(
        there("menu", "vslam-recorded", "--limit", "path_length=32", "--cost", "none", "-o", "json").out
    )
    assert menu["limits"]["metrics.path_length"] == 32
    assert menu["balanced"]["cpus"] > 16
    missed = there("menu", "vslam-recorded", "--limit", "path_length=5", code=4).out
    assert "missed    metrics.path_length: limit 5 m; the best" in missed
    assert re.search(r"needs 3\d(\.\d+)? m, 6\.\d+ times the limit", " ".join(missed.split()))


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--metric", "length"), "vslam-recorded has no metric named length; spec.metrics: path_length"),
        (("--limit", "width=3"), "vslam-recorded has no metric named width"),
        (("--limit", "path_length"), "--limit is a metric and its bound"),
        (("--limit", "path_length=-1"), "--limit is a metric and its bound"),
    ],
)
def test_a_metric_that_does_not_exist_is_named(there: Shell, words: tuple[str, ...], says: str) -> None:
    assert says in there("menu", "vslam-recorded", *words, code=2).err
