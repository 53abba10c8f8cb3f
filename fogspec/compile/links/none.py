"""Configure no link: robot and cloud are connected by other means, or not at all."""

from collections.abc import Sequence
from typing import Literal

from fogspec.compile.links.protocol import LinkEnd
from fogspec.language.schema import Application
from fogspec.language.warned import Warned


class NoLink:
    """A link without files, processes and ports."""

    name: str = "none"
    protocol: Literal["tcp", "udp"] | None = None
    port: int = 0
    packages: Sequence[str] = ()

    def end(self, application: Application, side: Literal["cloud", "robot"]) -> LinkEnd:
        """Return an end without files and environment."""
        return LinkEnd({}, {})

    def warnings(self, application: Application, cloud: str) -> Sequence[Warned]:
        """Return no warnings."""
        return ()

    def opening(self, application: Application, infra: str, address: str) -> str | None:
        """Return None: there is no port to open."""
        return None
