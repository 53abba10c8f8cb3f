"""Digests of what a measurement reads, by hand: a later version that reads more must not change those of older results."""

import hashlib
import json

from fogspec.spec import fingerprints
from tests.unit.compile.test_tasks import application

APPLICATION = application(cloud=[{"cmd": ["./node"]}])


def test_empty_fields_count_and_fields_that_came_later_do_not_while_they_are_not_set() -> None:
    found = fingerprints.measured_part(APPLICATION)
    assert {"cloud", "ros", "probe", "metrics", "secrets", "workload"} <= set(found)
    assert (found["secrets"], found["metrics"], found["ros"]) == ([], {}, None)
    assert "scenarios" not in found
    assert None not in found["probe"].values()
    assert not set(found) & {"constraints", "objective", "hardware", "infra", "deployment", "ignore", "budget"}
    text = json.dumps(found, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    assert fingerprints.measured_digest(APPLICATION) == f"sha256:{hashlib.sha256(text.encode()).hexdigest()}"


def test_what_plans_read_of_the_benchmark_is_what_they_first_read_while_nothing_else_is_set() -> None:
    assert set(fingerprints.planned_part(APPLICATION)["benchmark"]) == {
        "machines", "min_success_rate", "sampler", "scenarios", "setup_timeout", "stop", "warmup", "workload",
    }  # fmt: skip


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
    assert fingerprints.fitted_part(APPLICATION) == {"statistic": "mean", "targets": [], "local": False}


def test_parts_are_named_by_short_digests_of_their_own() -> None:
    found = fingerprints.measured_fields(APPLICATION)
    assert found["secrets"] == hashlib.sha256(b"[]").hexdigest()[:12]
    assert fingerprints.chosen_fields(APPLICATION)["ignore"] == hashlib.sha256(b"[]").hexdigest()[:12]
    assert fingerprints.field_of_measured("workload") == "spec.benchmark.workload"
    assert fingerprints.field_of_measured("cloud") == "spec.cloud"
