"""What the agent's program `watch` saw of a robot, read from its file and checked."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from fogspec.base.errors import InvalidInput
from fogspec.base.files import read_file

MOST_BYTES = 128 << 20
Names = Annotated[list[str], Field(max_length=10_000)]


@dataclass(frozen=True, kw_only=True)
class Timed:
    """Requests that were seen, with the latencies of those that ended."""

    latencies_s: tuple[float, ...]

    @property
    def p50_s(self) -> float:
        """Median of the latencies."""
        return statistics.median(self.latencies_s)

    @property
    def p95_s(self) -> float:
        """Their 95% quantile."""
        return sorted(self.latencies_s)[math.ceil(0.95 * len(self.latencies_s)) - 1]


class Part(BaseModel):
    """Keys of later versions of the agent are ignored."""

    model_config = ConfigDict(extra="ignore", frozen=True)


class Process(Part):
    """How a node's process was started, and what it used while the robot was watched."""

    argv: list[str] = []
    package: str | None = None
    executable: str | None = None
    remappings: dict[str, str] = {}
    arguments: list[str] = []
    parameter_files: list[str] = []
    shared: bool = False
    cpu_s: float = Field(0.0, ge=0)
    memory_bytes: float | None = Field(None, ge=0)


class Node(Part):
    """A node, its parameters, and its process if it runs on the computer that watched.

    `late`: it appeared while the robot was watched; `gone`: it ended.
    """

    parameters: dict[str, Any] = {}
    process: Process | None = None
    gone: bool = False
    late: bool = False


class Topic(Part):
    """A topic; `messages` are [sent, header stamp or None, bytes], times in ns, and may be fewer than `count`.

    `sent` is how many were published while it was watched, by their sequence numbers; 0 if these are not known.
    """

    types: list[str] = []
    publishers: Names = []
    subscribers: Names = []
    latched: bool = False
    has_header: bool | None = None
    watched: bool = False
    problem: str | None = None
    count: int = Field(0, ge=0)
    bytes: int = Field(0, ge=0)
    sent: int = Field(0, ge=0)
    messages: list[tuple[int, int | None, int]] = []
    dropped: bool = False

    @property
    def sent_per_heard(self) -> float:
        """Return how many messages were sent for one that reached the watcher, at least 1."""
        return self.sent / self.count if 0 < self.count < self.sent <= 100 * self.count else 1.0


class Offer(Part):
    """A service or an action; `goals` are [accepted, ended, how] and `calls` [begun, ended], times in ns.

    `introspected`: some node publishes the events of its calls.
    """

    type: str
    servers: Names = []
    callers: Names = []
    goals: list[tuple[int, int | None, str | None]] = []
    introspected: bool = False
    calls: list[tuple[int, int]] = []


class Overhead(Part):
    """What watching took: cores, and bytes received."""

    cpu: float = 0.0
    bytes: int = 0


class Computer(Part):
    """The computer that watched, which is the robot's unless it watched from another one."""

    cpu: str | None = None
    arch: str | None = None
    vcpus: float | None = Field(None, gt=0)
    memory_gib: float | None = Field(None, gt=0)


class Observed(Part):
    """A robot as it was seen for `seconds`."""

    version: int
    distro: str | None = None
    domain: str = "0"
    seconds: float = Field(ge=0)
    machine: Computer = Computer()
    nodes: dict[str, Node]
    topics: dict[str, Topic]
    services: dict[str, Offer] = {}
    actions: dict[str, Offer] = {}
    overhead: Overhead = Overhead()


def read_observed(path: Path) -> Observed:
    """Return the observations in a file; raise InvalidInput for any other file, and for a robot without nodes."""
    fix = "write it on the robot: python3 compiled/agent.pyz watch --out FILE"
    try:
        content = read_file(path, MOST_BYTES)
    except OSError as problem:
        raise InvalidInput(f"{path}: {(problem.strerror or str(problem)).lower()}", fix) from None
    try:
        seen = Observed.model_validate_json(content)
    except ValidationError as wrong:
        first = wrong.errors(include_url=False)[0]
        at = ".".join(map(str, first["loc"])) or "the file"
        raise InvalidInput(f"{path}: not observations of a robot: {at}: {first['msg']}", fix) from None
    if seen.version != 1:
        raise InvalidInput(f"{path}: version {seen.version} is of another fogspec, this one reads 1", fix)
    if not seen.nodes:
        raise InvalidInput(
            f"no node of a robot is visible in ROS_DOMAIN_ID {seen.domain}",
            "start the robot's nodes first",
            "use the robot's ROS_DOMAIN_ID and RMW_IMPLEMENTATION, and source its workspace",
        )
    return seen


def heard(topic: Topic) -> Sequence[tuple[int, int | None, int]]:
    """Return a topic's messages in the order in which they were sent."""
    return sorted(topic.messages, key=lambda one: one[0])
