"""A project on the AWS account: its files, fogspec's command line with that SkyPilot, and what EC2 says is left and owed."""

import os
import re
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, ClassVar

from fogspec.backends.registry import owner_of
from fogspec.base.layout import Layout
from tests.slurm import site
from tests.tools.aws import engine, shapes

WORK = """\
import json
import time

import fogspec_probe

cpus = json.load(open("/run/instance.json"))["cpus"]
while True:
    fogspec_probe.start("work")
    time.sleep(0.02 + 0.4 / cpus)
    fogspec_probe.stop("work")
"""
LEAST_S = 60.0  # EC2 bills a second at a time, and at least a minute: aws.amazon.com/ec2/pricing/on-demand


@dataclass(frozen=True, slots=True)
class Instance:
    """What EC2 says of one, and what it bills for it."""

    id: str
    name: str
    type: str
    state: str
    spot: bool
    lived_s: float
    usd: float


@dataclass
class AwsSite(site.Site):
    """`cluster` is the account's folder; `before` are the instances that were there before this project was, and their names.

    Others may use the account at the same time: instances whose names do not begin with `prefix` are theirs.
    """

    before: Mapping[str, str] = field(default_factory=dict)
    prefix: str = "fogspec-"
    patience_s: ClassVar[float] = 1500.0

    def __post_init__(self) -> None:
        self.before = {one.id: one.name for one in self.instances()}

    def machine(self, name: str, instance: str = "") -> str:
        """What the names of an application's machines begin with, or of those that measure one instance type."""
        prefix = owner_of(Layout.of(self.spec(name), name)).prefix
        return f"{prefix}aws-{shapes.REGION}-{instance.replace('.', '-')}" if instance else prefix

    def write(self, name: str, machines: list[str], steps: int = 20, work: str = WORK) -> str:
        """A spec, whose path is returned, and its workload."""
        path = super().write(name, machines, steps, work)
        self.edit(path, "slurm/fogtest", f"aws/{shapes.REGION}")
        self.edit(path, "ready_timeout: 3min", "ready_timeout: 20min")  # however busy this machine is
        return path

    def edit(self, path: str, old: str, new: str) -> None:
        """Change a file of the project."""
        text = (self.project / path).read_text()
        assert old in text
        (self.project / path).write_text(text.replace(old, new))

    @property
    def at(self) -> tuple[str, ...]:
        """The prices are those that SkyPilot has, as for any user."""
        return ()

    def instances(self) -> list[Instance]:
        """Those of this project, with what is owed for them until now, in the order of their launch."""
        found = [one for page in engine.client().describe_instances()["Reservations"] for one in page["Instances"]]
        found.sort(key=lambda one: one["LaunchTime"])
        own = [one for one in map(_instance, found) if one.id not in self.before]
        return [one for one in own if one.name.startswith(self.prefix)]

    def jobs(self, spare: str | None = None) -> list[str]:
        """Names of the machines that EC2 has, without those that begin with `spare`."""
        names = [one.name for one in self.instances() if one.state not in ("terminated", "shutting-down")]
        return [name for name in names if spare is None or not name.startswith(spare)]

    def cancel(self, prefix: str) -> None:
        """End machines behind SkyPilot's back, as somebody at the console does."""
        gone = [one.id for one in self.instances() if one.name.startswith(prefix) and one.state == "running"]
        if gone:
            engine.client().terminate_instances(InstanceIds=gone)

    def bill(self) -> float:
        """What EC2 bills for this project, in dollars."""
        return sum(one.usd for one in self.instances())

    def _running(self, spare: str | None) -> list[str]:
        return self.jobs(spare)

    def _known(self) -> list[str]:
        others = set(self.before.values())
        return [one for one in engine.clusters(self.cluster) if one.startswith(self.prefix) and one not in others]

    def _env(self) -> dict[str, str]:
        return engine.environment(self.cluster) | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


def _instance(one: dict[str, Any]) -> Instance:
    tags = {tag["Key"]: tag["Value"] for tag in one.get("Tags", ())}
    # SkyPilot adds its user's hash to the cluster's name, and says which of its machines this is.
    name = re.sub("-[0-9a-f]{8}$", "", tags.get("ray-cluster-name", tags.get("Name", "")))
    stamp = re.search(r"\((.*) UTC\)", one.get("StateTransitionReason", ""))
    over = datetime.strptime(stamp[1], "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC) if stamp else datetime.now(UTC)
    lived_s = (over - one["LaunchTime"]).total_seconds()
    shape = shapes.BY_NAME[one["InstanceType"]]
    spot = one.get("InstanceLifecycle") == "spot"
    price = shape.spot_price if spot else shape.price
    state = one["State"]["Name"]
    return Instance(one["InstanceId"], name, shape.name, state, spot, lived_s, max(lived_s, LEAST_S) * price / 3600)


def until(true: Callable[[], Any], patience_s: float = 1200.0) -> Any:
    """What it says once it says something."""
    end = time.monotonic() + patience_s
    while not (found := true()):
        assert time.monotonic() < end
        time.sleep(1)
    return found
