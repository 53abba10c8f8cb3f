"""Define the interface of a link between robot and cloud."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

from fogspec.language.schema import Application
from fogspec.language.warned import Warned


@dataclass(frozen=True, slots=True)
class LinkEnd:
    """One end of a link: reviewed files by name, and environment variables for the nodes at this end.

    No file contains a key. Values that are unknown until the machine is up are placeholders, which `link.sh` replaces:
    @CLOUD_ADDRESS@, @KEYS@ (the directory of this end's key), @PEER@ (the peer's public key). In the environment, @LINK@
    stands for the directory of the reviewed files.
    """

    files: Mapping[str, str]
    environment: Mapping[str, str]


class Link(Protocol):
    """A connection of robot and cloud, as configuration that `templates/link.sh.j2` starts.

    `packages` are Debian packages for both ends, with DISTRO for the ROS 2 distribution. The cloud machine listens on
    `port` of `protocol`; None means that there is no link.
    """

    name: str
    protocol: Literal["tcp", "udp"] | None
    port: int
    packages: Sequence[str]

    def end(self, application: Application, side: Literal["cloud", "robot"]) -> LinkEnd:
        """Return the files and the environment of one end."""
        ...

    def warnings(self, application: Application, cloud: str) -> Sequence[Warned]:
        """Return warnings for the reviewer about this link on this cloud."""
        ...

    def opening(self, application: Application, infra: str, address: str) -> str | None:
        """Return instructions to open the port of the machine at `address`; None if nothing is to be done."""
        ...
