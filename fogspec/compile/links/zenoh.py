"""Configure Zenoh: a router at each end, connected by mutual TLS on one port, which passes only names in the spec.

Key expressions follow the design document of rmw_zenoh_cpp: topics and services are `<domain>/<name>/<type>/<type hash>`,
an action is five of these, and liveliness tokens under `@ros2_lv` announce the graph. No wildcard matches a chunk that
begins with `@`, so it is always spelled out.
"""

import hashlib
import json
import re
from collections.abc import Iterator, Sequence
from typing import Any, Literal

from fogspec.base.clouds import cloud_of
from fogspec.compile.links.protocol import LinkEnd
from fogspec.language.graph_names import AllowedNames, exposed
from fogspec.language.schema import Application
from fogspec.language.warned import Warned, open_port, warned

LOCAL = "tcp/127.0.0.1:7447"  # default router address of rmw_zenoh_cpp nodes
DATA = ["put", "delete", "declare_subscriber"]
CALLS = ["query", "reply", "declare_queryable"]
GRAPH = ["liveliness_token", "declare_liveliness_subscriber", "liveliness_query"]
SERVICES_OF_ACTIONS = ("send_goal", "get_result", "cancel_goal")
TOPICS_OF_ACTIONS = ("feedback", "status")


class Zenoh:
    """A link with mutual TLS between two pinned certificates, which denies by default."""

    name: str = "zenoh"
    protocol: Literal["tcp", "udp"] | None = "tcp"
    port: int = 7448
    packages: Sequence[str] = ("openssl", "ros-DISTRO-rmw-zenoh-cpp")

    def end(self, application: Application, side: Literal["cloud", "robot"]) -> LinkEnd:
        """Return the configuration of the router as JSON, which is valid JSON5."""
        config = router(application, side, application.spec.connectivity.port or self.port)
        return LinkEnd({f"{side}.json5": _text(config)}, {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"})

    def warnings(self, application: Application, cloud: str) -> Sequence[Warned]:
        """Return the port that the user must open, if the cloud does not open ports."""
        if not cloud_of(cloud).opens_ports:
            port = application.spec.connectivity.port or self.port
            return (warned(open_port, cloud=cloud, protocol="tcp", port=port),)
        return ()

    def opening(self, application: Application, infra: str, address: str) -> str | None:
        """Return None: SkyPilot opens the port, or `apply` reports that it is unreachable."""
        return None


def _text(config: dict[str, Any]) -> str:
    """Return JSON with short lists on one line."""
    whole = json.dumps(config, indent=2) + "\n"
    return re.sub(r"\[[^][{}]*\]", lambda found: _short(found[0]), whole)


def _short(text: str) -> str:
    line = " ".join(text.split()).replace("[ ", "[").replace(" ]", "]")
    return line if len(line) <= 80 else text


def router(application: Application, side: Literal["cloud", "robot"], port: int) -> dict[str, Any]:
    """Return the configuration of one end's router (zenoh 1.x)."""
    peer = "robot" if side == "cloud" else "cloud"
    there = f"tls/@CLOUD_ADDRESS@:{port}"
    listens = [LOCAL, f"tls/0.0.0.0:{port}"] if side == "cloud" else [LOCAL]
    return {
        "mode": "router",
        "listen": {"endpoints": listens, "exit_on_failure": True},
        "connect": {"endpoints": [] if side == "cloud" else [there], "timeout_ms": -1, "exit_on_failure": False},
        "scouting": {"multicast": {"enabled": False}},
        "timestamping": {"enabled": True},
        "queries_default_timeout": 600000,
        "transport": {
            "link": {
                "tls": {
                    "enable_mtls": True,
                    # Only the certificate of the peer is trusted: its key identifies it, and the machine's
                    # address is not known when the certificate is made.
                    "verify_name_on_connect": False,
                    "root_ca_certificate": "@PEER@",
                    "listen_private_key": "@KEYS@/private.key",
                    "listen_certificate": "@KEYS@/public.pem",
                    "connect_private_key": "@KEYS@/private.key",
                    "connect_certificate": "@KEYS@/public.pem",
                }
            }
        },
        "access_control": access(application.name, peer, exposed(application.spec)),
    }


def access(name: str, peer: str, passing: AllowedNames) -> dict[str, Any]:
    """Return the access control, which denies by default: this end, on loopback, may send anything, the peer allowed names."""
    everything = {
        "id": "everything",
        "permission": "allow",
        "messages": [*DATA, *CALLS, *GRAPH],
        "key_exprs": ["**", "@ros2_lv/**", "**/@adv/**"],
    }
    graph = {"id": "graph", "permission": "allow", "messages": GRAPH, "key_exprs": ["@ros2_lv/**"]}
    rules = [everything, graph]
    for kind, messages, keys in _rules(passing):
        if keys:
            rules.append({"id": kind, "permission": "allow", "messages": messages, "key_exprs": keys})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [
            {"id": "here", "interfaces": ["lo"], "link_protocols": ["tcp"]},
            {"id": peer, "link_protocols": ["tls"], "cert_common_names": [common_name(name, peer)]},
        ],
        "policies": [
            {"rules": ["everything"], "subjects": ["here"]},
            {"rules": [rule["id"] for rule in rules[1:]], "subjects": [peer]},
        ],
    }


def _rules(passing: AllowedNames) -> Iterator[tuple[str, list[str], list[str]]]:
    """Yield the rules (id, messages, key expressions) for topics, services, and names of unknown kind."""
    topics = [
        *passing.topics,
        *(f"{action}/_action/{part}" for action in passing.actions for part in TOPICS_OF_ACTIONS),
    ]
    calls = [
        *passing.services,
        *(f"{action}/_action/{part}" for action in passing.actions for part in SERVICES_OF_ACTIONS),
    ]
    # A publisher that keeps messages for late joiners announces itself, is queried under its own key, and replies with the
    # key of the topic.
    yield "topics", [*DATA, "reply"], [key_of(name) for name in topics]
    yield "kept messages", [*DATA, *CALLS, *GRAPH], [f"{key_of(name)}/@adv/**" for name in (*topics, *passing.names)]
    yield "services", CALLS, [key_of(name) for name in calls]
    yield "remapped names", [*DATA, *CALLS], [key_of(name) for name in passing.names]


def common_name(name: str, side: str) -> str:
    """Return the common name of an end's certificate: at most 64 characters (RFC 5280, ub-common-name)."""
    whole = f"{side}.{name}"
    return whole if len(whole) <= 64 else f"{whole[:55]}.{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def key_of(name: str) -> str:
    """Return the key expression of a topic or service in any domain and of any type."""
    return f"*{name}/*/*"
