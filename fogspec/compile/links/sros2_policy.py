"""Make an SROS2 policy (policy.xml, version 0.2.0) for the named nodes of a spec, which denies by default.

A spec does not declare publishers and subscribers, so each node may do both with the names in the spec.
"""

from collections.abc import Sequence

from fogspec.base.text import xml
from fogspec.language.graph_names import exposed
from fogspec.language.schema import Application, Node

# Topics that every ROS 2 node uses: its log, its parameters, the clock.
OF_EVERY_NODE = {"publish": ("rosout", "parameter_events"), "subscribe": ("parameter_events", "clock")}
SERVICES_OF_EVERY_NODE = (
    "describe_parameters",
    "get_parameter_types",
    "get_parameters",
    "list_parameters",
    "set_parameters",
    "set_parameters_atomically",
)


def policy(application: Application) -> str:
    """Return the policy, one enclave for each side; nodes without a name have no profile, because SROS2 needs the name."""
    sides = {"cloud": application.spec.cloud, "robot": application.spec.robot}
    enclaves = [line for side, nodes in sides.items() for line in _enclave(application, side, nodes)]
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', '<policy version="0.2.0">', "  <enclaves>", *enclaves]
    return "\n".join([*lines, "  </enclaves>", "</policy>", ""])


def _enclave(application: Application, side: str, nodes: Sequence[Node]) -> list[str]:
    named = [node for node in nodes if node.name]
    if not named:
        return []
    inner = [f"        {line}" for node in named for line in _profile(application, node)]
    path = xml(f"/{application.name.replace('-', '_').replace('@', '/')}/{side}")
    return [f'    <enclave path="{path}">', "      <profiles>", *inner, "      </profiles>", "    </enclave>"]


def _profile(application: Application, node: Node) -> list[str]:
    passing = exposed(application.spec)
    space = "/" + (node.namespace or "").strip("/")
    topics, calls = (*passing.topics, *passing.names), (*passing.services, *passing.names)
    lines = [f'<profile ns="{xml(space)}" node="{xml(node.name)}">']
    for verb in ("publish", "subscribe"):
        lines += _rule("topic", verb, [*topics, *(f"/{name}" for name in OF_EVERY_NODE[verb])])
    lines += _rule("service", "reply", [*calls, *(f"~/{name}" for name in SERVICES_OF_EVERY_NODE)])
    lines += _rule("service", "request", calls)
    for verb in ("call", "execute"):
        lines += _rule("action", verb, passing.actions)
    return [*lines, "</profile>"]


def _rule(kind: str, verb: str, names: Sequence[str]) -> list[str]:
    if not names:
        return []
    inner = [f"    <{kind}>{xml(name)}</{kind}>" for name in dict.fromkeys(names)]
    return [f'  <{kind}s {verb}="ALLOW">', *inner, f"  </{kind}s>"]
