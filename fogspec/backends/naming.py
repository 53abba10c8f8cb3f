"""Names of clusters: each begins so that its application can be told from it alone."""

import re

from fogspec.base import digest

LONGEST = 24


def deployment_name(application: str, manifest: str, token: str) -> str:
    """The name of a launch: which application, which manifest (its digest), and a token that no other launch has."""
    return f"fogspec-{_short(application)}-{digest.shorten(manifest, 8)}-{token}"


def is_deployment_of(name: str, application: str) -> bool:
    """Whether a launch with this name is one of the application's, and not of one whose name begins alike."""
    return re.fullmatch(rf"fogspec-{re.escape(_short(application))}-[0-9a-f]{{8}}-[0-9a-f]{{6}}", name) is not None


def is_machine_of(name: str, application: str) -> bool:
    """Whether a machine with this name was started for the application, to be measured or to be used."""
    return is_deployment_of(name, application) or name.startswith(sample_prefix(application))


def sample_prefix(application: str) -> str:
    """What the names of all machines that an application's samples were ever measured on begin with."""
    return f"fogspec-{digest.shorten(digest.of_bytes(application.encode()), 8)}-"


def _short(application: str) -> str:
    """Names of clusters must be short on some clouds: a longer name ends in a digest of the whole."""
    if len(application) <= LONGEST:
        return application
    return f"{application[: LONGEST - 7].rstrip('-')}-{digest.shorten(digest.of_value(application), 6)}"
