"""A robot: a network of its own, joined to the cluster's by one cable, through which nothing passes but the link's port."""

import json
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

from tests.ros.namespaces import ROOT, Net
from tests.slurm.site import Site
from tests.tools import network

NODES = ROOT / "tests" / "ros" / "nodes"
LINKED = """\
  robot:
    - cmd: [python3, ask.py]
  ros: {distro: jazzy}
  connectivity: {link: zenoh, expose: {/plan: service}}
"""
# While it is measured it works by itself; where the link is, it waits for requests, as a planner does.
PLANNER = """\
import os
import time

import fogspec_probe

cpus = int(os.environ["SLURM_JOB_CPUS_PER_NODE_PACK_GROUP_0"])


def plan():
    fogspec_probe.start("work")
    time.sleep(0.02 + 0.4 / cpus)
    fogspec_probe.stop("work")


if "RMW_IMPLEMENTATION" not in os.environ:
TELLS
    while True:
        plan()

from over_zenoh import key, session


def answer(query):
    plan()
    query.reply(query.key_expr, b"planned")


with session() as here:
    kept = here.declare_queryable(key("plan"), answer)
    while True:
        time.sleep(1)
"""
ASK = """\
import json
import time

from over_zenoh import asked, session

REQUESTS = 20

with session() as here:
    while asked(here, "plan", 2.0) != [b"planned"]:
        time.sleep(0.2)
    took = []
    for _ in range(REQUESTS):
        begun = time.perf_counter()
        assert asked(here, "plan", 5.0) == [b"planned"]
        took.append(time.perf_counter() - begun)
print(json.dumps(took), flush=True)
"""
RULES = """
table inet fogspec {{
  chain in {{ type filter hook input priority 0; policy drop; iifname != "{cable}" accept; ct state established accept; }}
  chain out {{
    type filter hook output priority 0; policy drop;
    oifname != "{cable}" accept
    ct state established accept
    tcp dport {port} accept
  }}
}}
"""


def write(site: Site, spec: str, tells: str) -> None:
    """Add the robot, its link and their nodes to a spec that was written.

    `tells` is what the planner does first where it is measured.
    """
    path = site.project / spec
    path.write_text(path.read_text().replace("  probe:", f"{LINKED}  probe:"))
    shutil.copy(NODES / "over_zenoh.py", path.parent)
    (path.parent / "work.py").write_text(PLANNER.replace("TELLS\n", textwrap.indent(tells, "    ")))
    (path.parent / "ask.py").write_text(ASK)


class Robot:
    """It has its own keys, and files that a person copies to it."""

    def __init__(self, folder: Path, site: Site, port: int = 7448) -> None:
        folder.mkdir(parents=True)
        self.links, self.site = folder / "links", site
        self.net = Net(folder, own_memory=True)
        network.attach(self.net.holder, "robot", network.ROBOT)
        (folder / "rules.nft").write_text(RULES.format(cable=network.CABLE, port=port))
        self.net.run(["nft", "-f", str(folder / "rules.nft")], 600).check_returncode()

    def make_keys(self, name: str) -> None:
        """On the robot; the public half goes to where `apply` runs."""
        words = ["bash", str(self.site.project / "compiled" / name / "link" / "link.sh"), "robot", "keys"]
        self.net.run(words, 120, FOGSPEC_LINKS=str(self.links)).check_returncode()
        mine = self.site.links(name)
        mine.mkdir(parents=True)
        shutil.copy(self.links / name / "robot" / "public", mine)

    def take(self, name: str) -> None:
        """What `apply` says is to be copied to the robot."""
        for file in ("peer", "address"):
            shutil.copy(self.site.links(name) / file, self.links / name / "robot")
        peer = (self.site.links(name) / "peer").read_text()
        script = self.site.project / "compiled" / name / "link" / "link.sh"
        words = self.net.command(["bash", str(script), "robot", "peer"])
        environment = self.net.environment(FOGSPEC_LINKS=str(self.links))
        subprocess.run(words, input=peer, text=True, check=True, capture_output=True, env=environment)

    def plays(self, name: str) -> list[float]:
        """Start its generated launch file; round trips of its requests in seconds."""
        played = self._run("tests.ros.playing", str(self.site.project / "compiled" / name / "robot.launch.py"))
        assert played.returncode == 0, played.stdout + played.stderr
        took: list[float] = json.loads(next(line for line in played.stdout.splitlines() if line.startswith("[")))
        return took

    def _run(self, module: str, *words: str) -> "subprocess.CompletedProcess[str]":
        there = ["sh", "-c", 'cd "$1" && shift && exec "$@"', "sh", str(self.site.project)]
        environment = {"FOGSPEC_LINKS": str(self.links), "PYTHONPATH": str(ROOT)}
        return self.net.run([*there, sys.executable, "-m", module, *words], 120, **environment)
