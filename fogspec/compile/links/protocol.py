"""The interface of a link between robot and cloud."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

from fogspec.spec.schema import Application


@dataclass(frozen=True, slots=True)
class LinkEnd:
    """One end of a link: reviewed files by name, and what the nodes at this end see in their environment.

    No file holds a key. What is known only when the machine is up stands in them as a word between two @, which
    `link.sh` replaces on the spot: @CLOUD_ADDRESS@, @KEYS@ (the folder of this end's key), @PEER@ (the other's public half).
    In the environment @LINK@ stands for the folder of the reviewed files.
    """

    files: Mapping[str, str]
    environment: Mapping[str, str]


class Link(Protocol):
    """How robot and cloud are joined: configuration as data; what starts it is `templates/link.sh.j2`.

    `packages` are Debian packages that an end needs, with DISTRO for the ROS 2 distribution; `port` is the one that
    the cloud machine listens on, `protocol` which kind; without a protocol there is no link at all.
    """

    name: str
    protocol: Literal["tcp", "udp"] | None
    port: int
    packages: Sequence[str]

    def end(self, application: Application, side: Literal["cloud", "robot"]) -> LinkEnd:
        """Return the files and the environment of one end."""
        ...

    def notes(self, application: Application, cloud: str) -> Sequence[str]:
        """Return what a reviewer must know or do for this link on this cloud."""
        ...

    def opening(self, application: Application, infra: str, address: str) -> str | None:
        """Return how to open the port of the machine at `address`, where the engine does not; None where nothing is to do."""
        ...
