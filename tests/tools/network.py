"""A bridge with the controller's address, and for each node or machine a network of its own with a cable to it."""

import subprocess
from collections.abc import Sequence

BRIDGE, CABLE = "lab", "eth0"
CONTROLLER = "10.88.0.1"
ROBOT = "10.88.0.200"
READY = 'hostname "$0" && mount -t tmpfs none /dev/shm && ip link set lo up && echo up && read -r _ && exec "$@"'


def address(number: int) -> str:
    """Of the node with this number."""
    return f"10.88.0.{10 + number}"


def start() -> None:
    """The bridge."""
    _ip("link", "add", BRIDGE, "type", "bridge")
    _ip("addr", "add", f"{CONTROLLER}/24", "dev", BRIDGE)
    _ip("link", "set", BRIDGE, "up")


def attach(holder: str, name: str, address: str) -> None:
    """A cable from the bridge to the network of the process `holder`; `name` is the cable's end here."""
    _ip("link", "add", name, "type", "veth", "peer", "name", CABLE, "netns", holder)
    _ip("link", "set", name, "master", BRIDGE, "up")
    for words in (["addr", "add", f"{address}/24", "dev", CABLE], ["link", "set", CABLE, "up"]):
        subprocess.run(["nsenter", "--target", holder, "--net", "ip", *words], check=True)


def on_node(name: str, number: int, command: Sequence[str]) -> None:
    """Run a command with a node's name, network and shared memory; returns when it did, as daemons do at once."""
    words = ["unshare", "--net", "--mount", "--uts", "sh", "-c", READY, name, *command]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        if process.stdout.readline() != b"up\n":
            raise SystemExit("a network namespace does not come up")
        attach(str(process.pid), name, address(number))
        process.communicate(b"\n")
        if process.returncode:
            raise SystemExit(f"{command[0]} of {name} ends with {process.returncode}")


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)
