"""Names of machines, which identify their application."""

import re

from fogspec.base import digest

LONGEST = 24


def deployment_name(application: str, manifest: str, token: str) -> str:
    """Return the name of a deployment: the application, the manifest's digest, and a token that no other one has."""
    return f"fogspec-{_short(application)}-{digest.shorten(manifest, 8)}-{token}"


def is_deployment_of(name: str, application: str) -> bool:
    """Return whether a deployment with this name is one of the application, not of one with a longer name."""
    return re.fullmatch(rf"fogspec-{re.escape(_short(application))}-[0-9a-f]{{8}}-[0-9a-f]{{6}}", name) is not None


def is_machine_of(name: str, application: str) -> bool:
    """Return whether a machine with this name was started for the application, for a sample or a deployment."""
    return is_deployment_of(name, application) or name.startswith(sample_prefix(application))


def sample_prefix(application: str) -> str:
    """Return the prefix of the names of all machines of an application's samples."""
    return f"fogspec-{digest.shorten(digest.of_bytes(application.encode()), 8)}-"


def _short(application: str) -> str:
    """Return a name that is short enough for every cloud: a longer one ends in a digest of the whole."""
    if len(application) <= LONGEST:
        return application
    return f"{application[: LONGEST - 7].rstrip('-')}-{digest.shorten(digest.of_value(application), 6)}"
