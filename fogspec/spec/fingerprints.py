"""Digests of the parts of a spec that each stage reads: a change elsewhere leaves the stage's files fresh."""

from collections.abc import Mapping
from typing import Any

from fogspec.base import digest
from fogspec.spec.schema import Application


def measured_part(application: Application) -> dict[str, Any]:
    """Return what a measurement depends on: nodes, environment, probe, metrics, workload."""
    body = application.spec.model_dump(mode="json")
    benchmark = body["benchmark"]
    scenarios = {"scenarios": benchmark["scenarios"]} if benchmark["scenarios"] else {}
    return {
        **scenarios,
        "cloud": body["cloud"],
        "ros": body["ros"],
        "probe": {key: value for key, value in body["probe"].items() if value is not None},
        "metrics": body["metrics"],
        "workload": benchmark["workload"],
        "warmup": benchmark["warmup"],
        "min_success_rate": benchmark["min_success_rate"],
        "secrets": body["secrets"],
    }


def planned_part(application: Application) -> dict[str, Any]:
    """Return what the sampling plan depends on besides the catalog: also hardware, infra and sampling."""
    body = application.spec.model_dump(mode="json")
    benchmark = {key: value for key, value in body["benchmark"].items() if key not in ("budget", "batch_size")}
    return {
        **measured_part(application),
        "name": application.metadata.name,
        "hardware": body["hardware"],
        "infra": body["infra"],
        "benchmark": benchmark,
    }


def chosen_part(application: Application) -> dict[str, Any]:
    """Return what choice and deployment depend on besides results and catalog: limits, objective, machines."""
    body = application.spec.model_dump(mode="json")
    names = ("constraints", "objective", "hardware", "infra", "metrics", "robot", "connectivity", "deployment")
    return {key: body[key] for key in names}


def chosen_fields(application: Application) -> dict[str, str]:
    """Return a short digest of each part of `chosen_part`, so that a later change can be named."""
    return {name: digest.shorten(digest.of_value(value)) for name, value in chosen_part(application).items()}


def measured_fields(application: Application) -> dict[str, str]:
    """Return a short digest of each part of `measured_part`, so that a later change can be named."""
    return {name: digest.shorten(digest.of_value(value)) for name, value in measured_part(application).items()}


def changed_pins(measured: Mapping[str, str] | None, now: Mapping[str, str]) -> list[str]:
    """Return the names pinned to something else since they were measured; names not pinned then are unknown."""
    return sorted(name for name, one in (measured or {}).items() if now.get(name, one) != one)


def measured_digest(application: Application) -> str:
    """Return the digest of `measured_part`."""
    return digest.of_value(measured_part(application))


def planned_digest(application: Application) -> str:
    """Return the digest of `planned_part`."""
    return digest.of_value(planned_part(application))


def chosen_digest(application: Application) -> str:
    """Return the digest of `chosen_part`."""
    return digest.of_value(chosen_part(application))
