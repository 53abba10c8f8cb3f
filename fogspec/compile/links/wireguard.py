"""Configure WireGuard: a tunnel between two addresses of the application, and ROS 2 discovery through it.

ROS_STATIC_PEERS (ROS 2 Iron and later) names the other end, so that no multicast is needed.
"""

import hashlib
import ipaddress
from collections.abc import Sequence
from typing import Literal

from fogspec.base.clouds import cloud_of
from fogspec.compile.links.protocol import LinkEnd
from fogspec.language.schema import Application
from fogspec.language.warned import Warned, open_port, warned

# Shared address space of RFC 6598, which private networks of homes and data centers rarely use.
SPACE = ipaddress.IPv4Network("100.64.0.0/10")

FRAGMENT_BYTES = 1300  # below the tunnel's MTU of 1420 with room for headers
BUFFER_BYTES = 4 << 20


class WireGuard:
    """A tunnel for each application, with two addresses derived from its name."""

    name: str = "wireguard"
    protocol: Literal["tcp", "udp"] | None = "udp"
    port: int = 51820
    packages: Sequence[str] = ("iproute2", "wireguard-go", "wireguard-tools")

    def end(self, application: Application, side: Literal["cloud", "robot"]) -> LinkEnd:
        """Return the configuration of the tunnel for wg-quick."""
        here, there = addresses(application.name)
        if side == "cloud":
            here, there = there, here
        port = application.spec.connectivity.port or self.port
        lines = [
            "[Interface]",
            f"Address = {here}/32",
            *([f"ListenPort = {port}"] if side == "cloud" else []),
            # The key is in a file of its own: no configuration contains it.
            "PostUp = wg set %i private-key /etc/wireguard/%i.key",
            "",
            "[Peer]",
            "PublicKey = @PEER@",
            f"AllowedIPs = {there}/32",
            *([] if side == "cloud" else [f"Endpoint = @CLOUD_ADDRESS@:{port}", "PersistentKeepalive = 25"]),
        ]
        profiles = f"@LINK@/{side}.fastdds.xml"
        # Its first name is that of Humble and Jazzy, and deprecated since.
        environment = {"ROS_STATIC_PEERS": str(there), "FASTRTPS_DEFAULT_PROFILES_FILE": profiles}
        environment["FASTDDS_DEFAULT_PROFILES_FILE"] = profiles
        if side == "cloud":
            environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        only = ["127.0.0.1", str(here)] if side == "cloud" else []
        files = {f"{side}.conf": "\n".join(lines) + "\n", f"{side}.fastdds.xml": fast_dds(only)}
        return LinkEnd(files, environment)

    def warnings(self, application: Application, cloud: str) -> Sequence[Warned]:
        """Return the port that the user must open, because SkyPilot opens TCP ports only."""
        if not cloud_of(cloud).on_skypilot:
            return ()
        port = application.spec.connectivity.port or self.port
        return (warned(open_port, cloud=cloud, protocol="udp", port=port),)

    def opening(self, application: Application, infra: str, address: str) -> str | None:
        """Return a command of the cloud's CLI that opens the port to every address, if it is known."""
        cloud, region = cloud_of(infra), infra.partition("/")[2]
        if not cloud.on_skypilot:
            return None
        port = application.spec.connectivity.port or self.port
        what = f"open UDP port {port} of {address}, or the robot cannot connect"
        if cloud.open_udp is None:
            return f"{what}: SkyPilot opens TCP ports only"
        return f"{what}: {cloud.open_udp.format(region=region, address=address, port=port)}"


def fast_dds(only: Sequence[str]) -> str:
    """Return a profile for Fast DDS, the default middleware of ROS 2; other middlewares ignore it.

    A message larger than one datagram is sent in fragments that fit into the tunnel's packets, so that a lost packet
    costs one fragment and not 64 KiB; the buffers hold a burst of them. `only` restricts the interfaces to these addresses.
    """
    interfaces = [f"        <address>{address}</address>" for address in only]
    listed = ["      <interfaceWhiteList>", *interfaces, "      </interfaceWhiteList>"] if only else []
    return "\n".join(
        [
            '<?xml version="1.0" encoding="UTF-8"?>',
            '<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">',
            "  <transport_descriptors>",
            "    <transport_descriptor>",
            "      <transport_id>udp</transport_id>",
            "      <type>UDPv4</type>",
            f"      <sendBufferSize>{BUFFER_BYTES}</sendBufferSize>",
            f"      <receiveBufferSize>{BUFFER_BYTES}</receiveBufferSize>",
            f"      <maxMessageSize>{FRAGMENT_BYTES}</maxMessageSize>",
            *listed,
            "    </transport_descriptor>",
            "  </transport_descriptors>",
            '  <participant profile_name="fogspec" is_default_profile="true">',
            "    <rtps>",
            "      <userTransports><transport_id>udp</transport_id></userTransports>",
            "      <useBuiltinTransports>false</useBuiltinTransports>",
            "    </rtps>",
            "  </participant>",
            "</profiles>",
            "",
        ]
    )


def addresses(name: str) -> tuple[ipaddress.IPv4Address, ipaddress.IPv4Address]:
    """Return the addresses of robot and cloud in the tunnel, derived from the name of the application."""
    pairs = SPACE.num_addresses // 2
    pair = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") % pairs
    return SPACE[2 * pair], SPACE[2 * pair + 1]


def interface(name: str, side: Literal["cloud", "robot"]) -> str:
    """Return the name of the network interface at one end: at most 15 characters, distinct for each application."""
    return f"fog{side[0]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
