"""What a measurement reads, as a record of inputs."""

from typing import Any

import pytest

from fogspec.language import fingerprints
from fogspec.language.fingerprints import differing_rows, measured_record
from tests.unit.compile.test_tasks import application

APPLICATION = application(cloud=[{"cmd": ["./node"]}])


def test_a_record_has_each_field_that_is_set_by_its_path() -> None:
    found = measured_record(
        application(cloud=[{"cmd": ["./node"], "env": {"a.b": "1", "C": "2"}}]), None, {"n.py": "sha256:1"}
    )
    assert found["spec.cloud[0].cmd"] == ["./node"]
    assert (found['spec.cloud[0].env["a.b"]'], found["spec.cloud[0].env.C"]) == ("1", "2")
    assert found["spec.benchmark.warmup"] == APPLICATION.spec.benchmark.warmup
    assert found["n.py"] == "sha256:1"
    unread = ("constraints", "objective", "hardware", "infra", "deployment", "files", "benchmark.budget")
    assert not [name for name in found for one in unread if name.startswith(f"spec.{one}")]
    assert None not in found.values()


@pytest.mark.parametrize(
    ("before", "after", "changed"),
    [
        ({"a": 1}, {"a": 1}, []),
        ({"a": 1}, {"a": 1.0}, ["a"]),
        ({"a": 1}, {"a": True}, ["a"]),
        ({"b.py": "1", "spec.z": 1}, {"a.py": "1", "spec.z": 2}, ["spec.z", "a.py", "b.py"]),
        ({"a": [1, 2]}, {"a": [2, 1]}, ["a"]),
    ],
)
def test_what_differs_is_named(before: dict[str, Any], after: dict[str, Any], changed: list[str]) -> None:
    assert differing_rows(before, after) == changed


def test_a_waiver_names_parts_that_define_no_figures() -> None:
    for change in (
        "image",
        "spec.cloud",
        "spec.cloud[0].cmd",
        "spec.ros.image",
        "spec.secrets",
        "spec.benchmark.workload",
    ):
        assert fingerprints.waivable(change), change
    for change in ("spec.probe", "spec.probe.callback", "spec.metrics", "spec.clouds", "spec.benchmark.warmup"):
        assert not fingerprints.waivable(change), change


def test_models_depend_on_the_statistic_and_the_metrics_that_count() -> None:
    assert fingerprints.fitted_record(APPLICATION, {"library": None, "surrogate": 1}) == {
        "spec.constraints.statistic": "mean",
        "surrogate": 1,
    }
