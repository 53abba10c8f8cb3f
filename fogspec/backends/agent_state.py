"""What the on-machine agent writes: the outcome of a sample, the state of a deployment.

It comes from another machine and is untrusted: it is read with limits and checked value by value.
"""

import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeGuard, get_args

from pydantic import ValidationError

from fogspec.agent.processes import exit_text
from fogspec.backends.protocol import DeploymentStatus
from fogspec.backends.skypilot.errors import plain
from fogspec.base.files import open_untrusted
from fogspec.base.quantities import BASE_UNITS
from fogspec.base.units import UnitError
from fogspec.results.packages import unpacked
from fogspec.results.ranges import CLOCK_S, TIME_S
from fogspec.results.schema import Reason, ResourceUse, ServerFacts

STATES: dict[str, Literal["starting", "ready", "ended"]] = {
    "starting": "starting",
    "ready": "ready",
    "ended": "ended",
}
OUTCOME_BYTES = 64 * 2**10
TAIL_BYTES = 2**20
LOG_BYTES = 16384
TEXT_LIMIT = 500
NODES, MOST_RESTARTS = 100, 10**9
# SkyPilot's prefix of each line of a job, and its own and Slurm's lines that a job ended, without a reason.
PREFIX = re.compile(r"^\([^()]*pid=\d+[^()]*\) ")
PLATFORM = re.compile(
    r"ERROR: Job |✓ Job finished|⚙︎ |├── |└── |srun: |slurmstepd\S*: error: .* CANCELLED AT \S+ \*\*\*$"
)
LAUNCH = "ros2 launch"
NODE_ENDED = re.compile(
    r"\[(?P<process>[^\]\[]+-\d+)\]: process has (?:died \[pid \d+, exit code (?P<code>-?\d{1,4}),|finished cleanly)"
)
STATE_LINE = re.compile(rb"=== fogspec state (\{.*\}) ===")


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """The outcome of a sample: the reason of a failure, and times in seconds; None for a value that is missing or wrong."""

    reason: Reason | None = None
    detail: str | None = None
    stopped_by: str | None = None
    setup_s: float | None = None
    waited_s: float | None = None
    duration_s: float | None = None
    server: ServerFacts | None = None
    resources: ResourceUse | None = None

    @property
    def measured_s(self) -> float | None:
        """Seconds from the end of set-up to the end."""
        if self.duration_s is None or self.setup_s is None:
            return None
        return max(0.0, self.duration_s - self.setup_s)


def read_outcome(path: Path) -> Outcome | None:
    """Return the outcome in the agent's file; None if there is no readable one.

    A time out of its range fails the sample: it tells that nothing in the file can be relied on.
    """
    try:
        with open_untrusted(path) as file:
            values = json.loads(file.read(OUTCOME_BYTES))
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(values, dict):
        return None
    reason = values.get("reason")
    try:
        times_s = {name: _time_s(name, values.get(name)) for name in ("setup_s", "waited_s", "duration_s")}
    except UnitError as wrong:
        return Outcome(reason="out_of_range", detail=f"its outcome cannot be taken: {wrong}")
    return Outcome(
        reason=reason if reason in get_args(Reason) else None,
        detail=_short(values.get("detail")),
        stopped_by=_short(values.get("stopped_by")),
        **times_s,
        server=server_facts(values.get("server")),
        resources=resource_use(values.get("resources")),
    )


def deployment_status(state: bytes, timings: bytes, address: str | None) -> DeploymentStatus:
    """Return the status from the bytes of state.json and the end of the timings; `starting` for no state."""
    values = _mapping(state)
    detail = values.get("detail")
    return DeploymentStatus(
        state=STATES.get(str(values.get("state")), "starting"),
        detail="".join(c for c in detail if c.isprintable())[:300] if isinstance(detail, str) else None,
        address=address,
        ready_s=_seconds(values.get("ready_s")),
        timings=tail(timings),
        observed=values.get("observed") is not False,
        link=_public_key(values.get("link")),
        server=server_facts(values.get("server")),
        packages=unpacked(values.get("packages")),
        restarts=_restarts(values.get("restarts")),
        clock_s=_clock_s(values.get("clock_s")),
    )


def status_in_log(log: bytes, address: str | None) -> DeploymentStatus | None:
    """Return the supervisor's last report in a log, with the requests that it lists; None if there is no report."""
    lines = STATE_LINE.findall(log)
    if not lines:
        return None
    said = _mapping(lines[-1])
    rows, opened = (rows if isinstance(rows := said.get(name), list) else [] for name in ("latest", "open"))
    records = [_record(row) for row in rows if _is_record(row)]
    records += [_start(number, row) for number, row in enumerate(opened) if _is_start(row)]
    timings = "".join(f"{json.dumps(one)}\n" for one in records).encode()
    status = deployment_status(lines[-1], timings, address)
    listed = next((line for line in reversed(lines) if b'"packages"' in line), b"")
    return with_last_line(replace(status, packages=unpacked(_mapping(listed).get("packages"))), log)


def with_last_line(status: DeploymentStatus, log: bytes) -> DeploymentStatus:
    """Return the status with the nodes' last line, which tells why they ended."""
    if status.state != "ended" or not status.detail or (line := last_line(log)) is None:
        return status
    if status.detail.startswith(f"{LAUNCH} ") and (first := _ended_first(log)) is not None:
        return replace(status, detail=first[:300])
    # The detail begins with the name of the node that ended, which stands in front of its lines, too.
    name, _, text = line.removeprefix("[").partition("] ")
    line = text if line[:1] == "[" and status.detail.startswith(f"{name} ") and text else line
    return replace(status, detail=f"{status.detail}: {line}"[:300])


def _ended_first(log: bytes) -> str | None:
    """Return which of the nodes that launch had started ended first, how, and its last line; None if launch does not say."""
    lines = printed(log[-LOG_BYTES:])
    for number, text in enumerate(lines):
        if (found := NODE_ENDED.search(text)) is not None:
            mark = f"[{found['process']}] "
            last = next((line.partition(mark)[2] for line in reversed(lines[:number]) if line.startswith(mark)), "")
            how = f"{found['process'].rpartition('-')[0]} {exit_text(int(found['code'] or 0))}"
            return f"{how}: {last}" if last else how
    return None


def last_line(log: bytes) -> str | None:
    """Return the last line that the nodes printed that is not blank, cut at 300 characters."""
    return next((text.strip()[:300] for text in reversed(printed(log[-LOG_BYTES:])) if text.strip()), None)


def printed(log: bytes) -> list[str]:
    """Return the lines that the nodes printed, without the supervisor's and SkyPilot's own lines."""
    lines = (PREFIX.sub("", plain(line)).rstrip() for line in log.decode("utf-8", "replace").splitlines())
    return [text for text in lines if "=== fogspec state " not in text and not PLATFORM.match(text.lstrip())]


def tail(timings: bytes) -> bytes:
    """Return the last whole lines."""
    if len(timings) <= TAIL_BYTES:
        return timings
    cut = timings[-TAIL_BYTES:]
    return cut[cut.find(b"\n") + 1 :]


def server_facts(value: object) -> ServerFacts | None:
    """Return a machine's facts about its server, without facts that are impossible; None without its CPU."""
    if not isinstance(value, dict):
        return None
    facts = {name: _tidy(value[name]) for name in ServerFacts.model_fields if value.get(name) is not None}
    try:
        return ServerFacts.model_validate(facts, strict=True)
    except ValidationError as problem:
        wrong = {error["loc"][0] for error in problem.errors()}
    try:
        return ServerFacts.model_validate({name: one for name, one in facts.items() if name not in wrong}, strict=True)
    except ValidationError:
        return None


def resource_use(value: object) -> ResourceUse | None:
    """Return what a sample used, quantities as numbers in base units or as text; None if any of it is impossible."""
    try:
        return ResourceUse.model_validate(value, strict=True, context=BASE_UNITS) if isinstance(value, dict) else None
    except ValidationError:
        return None


def _tidy(value: object) -> object:
    return "".join(c for c in value if c.isprintable())[:120] if isinstance(value, str) else value


def _is_record(row: object) -> TypeGuard[list[Any]]:
    return isinstance(row, list) and len(row) in (4, 5) and isinstance(row[1], (int, float))


def _record(row: list[Any]) -> dict[str, Any]:
    one = {"name": str(row[0]), "latency_s": row[1], "ok": row[2] is True, "scenario": row[3]}
    end_s = _clock_s(row[4]) if len(row) == 5 else None
    return one if end_s is None else {**one, "start_s": end_s - row[1]}


def _is_start(row: object) -> TypeGuard[list[Any]]:
    return isinstance(row, list) and len(row) == 2 and _clock_s(row[1]) is not None


def _start(number: int, row: list[Any]) -> dict[str, Any]:
    # Its number among all of its process is not in the log: each is an account of its own.
    return {"open": str(row[0]), "process": f"open {number}", "number": 1, "start_s": row[1]}


def _clock_s(value: object) -> float | None:
    number = isinstance(value, (int, float)) and not isinstance(value, bool) and CLOCK_S.holds(value)
    return float(value) if number else None  # type: ignore[arg-type]


def _restarts(value: object) -> dict[str, int]:
    """Return the counts of the first `NODES` nodes, by printable names."""
    found = {}
    for name, count in list(value.items())[:NODES] if isinstance(value, dict) else ():
        if isinstance(count, int) and not isinstance(count, bool) and 0 <= count <= MOST_RESTARTS:
            found["".join(c for c in str(name) if c.isprintable())[:100]] = count
    return found


def _public_key(value: object) -> str | None:
    """Return one line that can be handed to the robot, which checks it again."""
    return value if isinstance(value, str) and re.fullmatch(r"[A-Za-z0-9+/=]{1,4096}", value) else None


def _time_s(name: str, value: object) -> float | None:
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return None
    try:
        return float(TIME_S.check(value))
    except UnitError as wrong:
        raise UnitError(f"{name} {wrong}") from None


def _seconds(value: object) -> float | None:
    return float(value) if isinstance(value, (int, float)) and TIME_S.holds(value) else None


def _short(value: object) -> str | None:
    return value[:TEXT_LIMIT] if isinstance(value, str) else None


def _mapping(text: bytes) -> dict[str, Any]:
    try:
        found = json.loads(text[:65536])
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}
