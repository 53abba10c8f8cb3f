"""Names of machines, which are bound to the application of a repository that started them.

Every name has a digest of repository, environment and application in it, so that a name alone tells whether a machine may be
touched, whatever a committed file says. 80 bits of it cannot be met by trying out names of applications.
"""

import base64
import hashlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

from fogspec.base import digest
from fogspec.base.errors import Refused
from fogspec.base.layout import DEFAULT_ENVIRONMENT

OWNER_LABEL = "fogspec-owner"
# What a deployment was started for, all that it was given, and how many machines before it in its manifest were unavailable.
MANIFEST_LABEL, RUNS_LABEL, FALLBACK_LABEL = "fogspec-manifest", "fogspec-runs", "fogspec-fallback"
IN_NAME = 16  # characters of 5 bits
LONGEST = 24


@dataclass(frozen=True)
class Owner:
    """Whose machines they are: an application in an environment of a repository; see `fogspec.base.repository`."""

    repository: str
    environment: str
    application: str

    def __str__(self) -> str:
        return f"{self.name} of {self.repository}"

    @property
    def name(self) -> str:
        """The name of the application, with `@` and the environment behind it unless that is the default one."""
        own = self.environment != DEFAULT_ENVIRONMENT
        return f"{self.application}@{self.environment}" if own else self.application

    @cached_property
    def digest(self) -> str:
        """The whole digest, of lower-case letters and digits, as label: clouds allow 63 of `[a-z0-9-]`."""
        parts = [self.repository, self.environment, self.application]
        whole = hashlib.sha256("\0".join(parts).encode("utf-8", "surrogateescape")).digest()
        return base64.b32encode(whole).decode().rstrip("=").lower()

    @property
    def _words(self) -> str:
        """What people read in the name of a deployment."""
        return self.name.replace("@", "-")

    @property
    def prefix(self) -> str:
        """The prefix of the names of all its machines."""
        return f"fogspec-{self.digest[:IN_NAME]}-"

    @property
    def labels(self) -> dict[str, str]:
        """The labels of its machines."""
        return {OWNER_LABEL: self.digest}

    def deployment_name(self, manifest: str, token: str) -> str:
        """Return the name of a deployment: the application, the manifest's digest, and a token that no other one has."""
        return f"{self.prefix}{_short(self._words)}-{digest.shorten(manifest, 8)}-{token}"

    def has_deployment(self, name: str) -> bool:
        """Return whether a machine with this name is a deployment, not a sample, of this owner."""
        rest = name.removeprefix(self.prefix)
        return self.has(name) and re.fullmatch(rf"{_short(self._words)}-[0-9a-f]{{8}}-[0-9a-f]{{6}}", rest) is not None

    def has_sample(self, name: str) -> bool:
        """Return whether a machine with this name measures a sample of this owner."""
        return self.has(name) and not self.has_deployment(name)

    def has(self, name: str, labels: Mapping[str, str] | None = None) -> bool:
        """Return whether a machine with this name, and these labels if they are known, is one of this owner."""
        label = (labels or {}).get(OWNER_LABEL, self.digest)
        return label == self.digest and re.fullmatch(rf"{self.prefix}[a-z0-9-]{{1,100}}", name) is not None


class ForeignMachine(Refused):
    """A name that is not one of the owner's: the machine is not touched."""

    def __init__(self, names: Iterable[str], owner: Owner, where: str) -> None:
        super().__init__(
            f"{where} names {', '.join(names)}, which is not a machine of {owner}: nothing of it was touched",
            "another application, repository or folder started it, or this one under another origin",
            f"find out whose it is; then move {where} away, or end it if it is yours: "
            f"fogspec down {owner.application} --repository URL",
        )


def _short(application: str) -> str:
    """Return a name that is short enough for every cloud: a longer one ends in a digest of the whole."""
    if len(application) <= LONGEST:
        return application
    return f"{application[: LONGEST - 7].rstrip('-')}-{digest.shorten(digest.of_value(application), 6)}"
