"""The execution backends by name, imported when they are used, and the owner of the machines that they start."""

import importlib
from typing import Any

from fogspec.backends.naming import Owner
from fogspec.backends.protocol import DeploymentBackend
from fogspec.base.clouds import cloud_of
from fogspec.base.layout import Layout
from fogspec.base.repository import repository_of

SAMPLES = {
    "local": "fogspec.backends.local.backend:LocalSamples",
    "skypilot": "fogspec.backends.skypilot.backend:SkyPilotSamples",
}
DEPLOYMENTS = {
    "local": "fogspec.backends.local.backend:LocalDeployments",
    "skypilot": "fogspec.backends.skypilot.backend:SkyPilotDeployments",
}


def sample_backend(name: str) -> Any:
    """Return the class of the `fogspec.backends.protocol.SampleBackend` with this name; raise KeyError if there is none."""
    return _load(SAMPLES[name])


def deployment_backend(infra: str) -> DeploymentBackend:
    """Return the backend for deployments on this infra: this host for `local`, else SkyPilot."""
    backend: DeploymentBackend = _load(DEPLOYMENTS["skypilot" if cloud_of(infra).on_skypilot else "local"])()
    return backend


def owner_of(layout: Layout) -> Owner:
    """Return the owner of the machines of an application in its environment."""
    return Owner(repository_of(layout.root), layout.environment, layout.application)


def _load(name: str) -> Any:
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)
