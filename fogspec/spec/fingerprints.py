"""What each stage reads of a spec: a change elsewhere leaves the stage's files fresh (LANGUAGE: what makes what stale)."""

from collections.abc import Mapping
from typing import Any

from fogspec.base import digest
from fogspec.spec.schema import Application


def measured_part(application: Application) -> dict[str, Any]:
    """What a measurement depends on: nodes, environment, probe, metrics, workload."""
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
    """What the sampling plan depends on, besides the catalog: also hardware, infra and how machines are sampled."""
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
    """What choice and deployment depend on, besides results and catalog: limits, objective, admissible machines."""
    body = application.spec.model_dump(mode="json")
    names = ("constraints", "objective", "hardware", "infra", "metrics", "robot", "connectivity", "deployment")
    return {key: body[key] for key in names}


def chosen_fields(application: Application) -> dict[str, str]:
    """A short digest of each part of `chosen_part`, so that a later change can be named."""
    return {name: digest.shorten(digest.of_value(value)) for name, value in chosen_part(application).items()}


def measured_fields(application: Application) -> dict[str, str]:
    """A short digest of each part of `measured_part`, so that a later change can be named."""
    return {name: digest.shorten(digest.of_value(value)) for name, value in measured_part(application).items()}


def changed_pins(measured: Mapping[str, str] | None, now: Mapping[str, str]) -> list[str]:
    """What was pinned when it was measured, and is pinned to something else now: what was not pinned is not known."""
    return sorted(name for name, one in (measured or {}).items() if now.get(name, one) != one)


def measured_digest(application: Application) -> str:
    """Digest of `measured_part`."""
    return digest.of_value(measured_part(application))


def planned_digest(application: Application) -> str:
    """Digest of `planned_part`."""
    return digest.of_value(planned_part(application))


def chosen_digest(application: Application) -> str:
    """Digest of `chosen_part`."""
    return digest.of_value(chosen_part(application))
