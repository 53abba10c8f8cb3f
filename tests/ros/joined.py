"""A robot and a cloud machine as two network namespaces with one cable between them, and a firewall at both ends.

The link's own script runs at each end as it does on a robot and on a machine: keys, public halves, up. What differs
from there is the router of zenoh: rmw_zenoh is not on PyPI, so the same router comes as the package eclipse-zenoh.
"""

import contextlib
import itertools
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

from fogspec.base.layout import Layout
from fogspec.compile.launch_files import launch_files
from fogspec.compile.links import link_of, port_of
from fogspec.compile.links.wireguard import interface
from fogspec.language.schema import Application
from tests.ros.namespaces import PYTHON, Net, Process

ADDRESS = {"robot": "10.77.0.1", "cloud": "10.77.0.2"}
OTHER = {"robot": "cloud", "cloud": "robot"}
PROGRAMS = {"zenoh": ("openssl", "nft"), "wireguard": ("wg", "wg-quick", "wireguard-go", "nft")}
RULES = """
table inet fogspec {{
  chain in {{
    type filter hook input priority 0; policy drop;
    iifname != "cable" accept
    ct state established accept
    {protocol} dport {port} accept
  }}
  chain out {{
    type filter hook output priority 0; policy drop;
    oifname != "cable" accept
    ct state established accept
    {protocol} dport {port} accept
  }}
}}
"""


# As Ubuntu's AppArmor does since 25.04: wg and wg-quick read one folder and pipes, and what they write to a file is lost.
CONFINED = """\
#!/bin/bash
for one in "$@" "$(readlink "/proc/$$/fd/0")"; do
  case $one in /etc/wireguard/* | /dev/* | pipe:* | socket:*) ;; */*) echo "$0: $one: Permission denied" >&2; exit 1 ;; esac
done
case $(readlink "/proc/$$/fd/1") in /dev/* | pipe:* | socket:*) ;; *) exec >/dev/null ;; esac
exec {program} "$@"
"""
_numbers = itertools.count()


def application(link: str, name: str | None = None) -> Application:
    """A planner in the cloud behind a service, an image and a pose; every one has a name of its own."""
    spec = {
        "cloud": [{"package": "arm", "executable": "planner"}], "ros": {"distro": "jazzy"}, "infra": ["aws/us-east-1"],
        "probe": {"request": "/image", "response": "/pose"},
        "connectivity": {"link": link, "expose": {"/plan": "service", "/navigate": "action"}},
    }  # fmt: skip
    metadata = {"name": name or f"arm-{os.getpid()}-{next(_numbers)}"}
    return Application.model_validate(
        {"apiVersion": "fogspec.dev/v1alpha1", "kind": "Application", "metadata": metadata, "spec": spec}
    )


def missing(link: str) -> str | None:
    """Which program is not there, with the command that helps."""
    if os.geteuid() != 0:
        return "needs root, to lay a cable between two network namespaces: sudo make test"
    lacking = [name for name in PROGRAMS[link] if shutil.which(name) is None]
    if not lacking:
        return None
    return f"needs {', '.join(lacking)}: apt-get install openssl nftables wireguard-go wireguard-tools"


def _confined(folder: Path) -> str:
    """Return the PATH with a wg and a wg-quick that are confined, also where the latter calls the former."""
    inner = folder / "inner"
    inner.mkdir(parents=True)
    wg, quick = CONFINED.format(program=shutil.which("wg")), CONFINED.format(program=inner / "wg-quick")
    for path, text in ((folder / "wg", wg), (folder / "wg-quick", quick), (inner / "wg", wg)):
        path.write_text(text)
        path.chmod(0o755)
    shutil.copy(str(shutil.which("wg-quick")), inner)  # it puts its own folder first in PATH
    return os.pathsep.join([str(folder), os.environ["PATH"]])


class Joined:
    """Both ends of one application's link."""

    def __init__(self, app: Application, nets: dict[str, Net], folder: Path) -> None:
        self.app, self.nets, self.folder = app, nets, folder
        with_router = os.pathsep.join([str(PYTHON.parent), os.environ["PATH"]])
        self.path = _confined(folder / "confined") if link_of(app).name == "wireguard" else with_router
        self.layout = Layout.of(folder / "specs" / "x.yaml", app.metadata.name)
        for path, content in launch_files(app, self.layout).items():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        one, two = (nets[side].holder for side in ("robot", "cloud"))
        subprocess.run(["ip", "link", "add", "cable", "netns", one, "type", "veth", "peer", "name", "cable", "netns", two],
                       check=True)  # fmt: skip
        for side, net in nets.items():
            for words in (["addr", "add", f"{ADDRESS[side]}/24", "dev", "cable"], ["link", "set", "cable", "up"]):
                net.run(["ip", *words], 600).check_returncode()

    def firewall(self) -> None:
        """From now on nothing passes the cable but new connections to the link's port."""
        rules = self.folder / "rules.nft"
        rules.write_text(RULES.format(protocol=link_of(self.app).protocol, port=port_of(self.app)))
        for net in self.nets.values():
            net.run(["nft", "-f", str(rules)], 600).check_returncode()

    def keys(self, side: str, home: str | None = None) -> Path:
        """The folder of one end's keys; `home` is another computer's, for whoever is not meant to join."""
        return self.folder / (home or side) / self.app.metadata.name / side

    def words(self, side: str, verb: str, *more: str) -> list[str]:
        return ["bash", str(self.layout.link / "link.sh"), side, verb, *more]

    def script(
        self, side: str, verb: str, *more: str, said: str = "", home: str | None = None
    ) -> subprocess.CompletedProcess[str]:
        """One verb of the link's script at one end, to its end."""
        net = self.nets[side]
        links = net.environment(FOGSPEC_LINKS=str(self.folder / (home or side)), PATH=self.path)
        words = net.command(self.words(side, verb, *more))
        return subprocess.run(words, input=said, text=True, capture_output=True, timeout=600, env=links)

    def exchange(self) -> None:
        """Each end makes its key; public halves travel, and nothing else does."""
        public = {side: self.script(side, "keys").stdout for side in OTHER}
        for side, other in OTHER.items():
            taken = self.script(side, "peer", said=public[other])
            assert taken.returncode == 0, taken.stderr
        assert self.script("robot", "address", ADDRESS["cloud"]).returncode == 0

    def exchange_as(self, home: str) -> None:
        """Another computer, at the robot's place, knows all that is public; the cloud does not know its key."""
        self.script("robot", "keys", home=home)
        public = (self.keys("cloud") / "public").read_text()
        assert self.script("robot", "peer", said=public, home=home).returncode == 0
        assert self.script("robot", "address", ADDRESS["cloud"], home=home).returncode == 0

    def up(self, side: str, home: str | None = None) -> Process:
        """Start one end, as launch files and tasks do."""
        begun = self.script(side, "start", home=home)
        assert begun.returncode == 0, begun.stderr
        links = str(self.folder / (home or side))
        return self.nets[side].start(
            f"link-{home or side}", self.words(side, "up"), FOGSPEC_LINKS=links, PATH=self.path
        )

    def environment(self, side: str) -> dict[str, str]:
        """What the nodes at one end see."""
        found = link_of(self.app).end(self.app, "cloud" if side == "cloud" else "robot").environment
        return {key: value.replace("@LINK@", str(self.layout.link)) for key, value in found.items()}


def until(done, patience_s: float = 1200.0) -> bool:
    """Whether it comes true in time."""
    end = time.monotonic() + patience_s
    while time.monotonic() < end:
        if done():
            return True
        time.sleep(0.1)
    return False


@contextlib.contextmanager
def joined(folder: Path, link: str, app: Application | None = None) -> Iterator[Joined]:
    """Both ends for the length of a block."""
    nets: dict[str, Net] = {}
    app = app or application(link)
    try:
        for side in OTHER:
            (folder / "nets" / side).mkdir(parents=True, exist_ok=True)
            nets[side] = Net(folder / "nets" / side, own_memory=True)
        nets["cloud"].domain = nets["robot"].domain
        yield Joined(app, nets, folder)
    finally:
        for side, net in nets.items():
            # A tunnel's program ends with its interface, and holds the namespace as long as it runs.
            net.run(
                ["ip", "link", "delete", interface(app.metadata.name, "cloud" if side == "cloud" else "robot")], 600
            )
            net.close()
