"""No link: robot and cloud are joined by other means, or not at all."""

from collections.abc import Sequence
from typing import Literal

from fogspec.compile.links.protocol import LinkEnd
from fogspec.spec.schema import Application


class NoLink:
    """Nothing is written, started or opened."""

    name: str = "none"
    protocol: Literal["tcp", "udp"] | None = None
    port: int = 0
    packages: Sequence[str] = ()

    def end(self, application: Application, side: Literal["cloud", "robot"]) -> LinkEnd:
        """Nothing."""
        return LinkEnd({}, {})

    def notes(self, application: Application, cloud: str) -> Sequence[str]:
        """Nothing."""
        return ()

    def opening(self, application: Application, infra: str, address: str) -> str | None:
        """Nothing."""
        return None
