"""Configure links between robot and cloud, by their name in a spec."""

from fogspec.compile.links.none import NoLink
from fogspec.compile.links.protocol import Link
from fogspec.compile.links.wireguard import WireGuard
from fogspec.compile.links.zenoh import Zenoh
from fogspec.language.schema import Application

LINKS: dict[str, Link] = {link.name: link for link in (NoLink(), Zenoh(), WireGuard())}


def link_of(application: Application) -> Link:
    """Return the link that the spec selects."""
    return LINKS[application.spec.connectivity.link]


def port_of(application: Application) -> int:
    """Return the port that the cloud machine listens on; 0 without a link."""
    return application.spec.connectivity.port or link_of(application).port
