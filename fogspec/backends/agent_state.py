"""What the on-machine keeper says of a deployment, as far as it can be believed: it came from another machine."""

import json
import re
from dataclasses import replace
from typing import Any, Literal, TypeGuard

from fogspec.backends.protocol import DeploymentStatus
from fogspec.backends.skypilot.errors import plain

STATES: dict[str, Literal["starting", "ready", "ended"]] = {
    "starting": "starting", "ready": "ready", "ended": "ended"
}  # fmt: skip
TAIL_BYTES = 2**20
WORDS_BYTES = 16384
# What SkyPilot puts before each line of a job, and says of the job's end itself.
PREFIX = re.compile(r"^\([^()]*pid=\d+[^()]*\) ")
PLATFORM = ("ERROR: Job ", "✓ Job finished", "⚙︎ ", "├── ", "└── ", "srun: ")
TOLD = re.compile(rb"=== fogspec state (\{.*\}) ===")


def deployment_status(said: bytes, timings: bytes, address: str | None) -> DeploymentStatus:
    """From the bytes of state.json and the end of the timings; nothing said is `starting`."""
    facts = _facts(said)
    seconds, detail = facts.get("ready_s"), facts.get("detail")
    return DeploymentStatus(
        state=STATES.get(str(facts.get("state")), "starting"),
        detail="".join(c for c in detail if c.isprintable())[:300] if isinstance(detail, str) else None,
        address=address,
        ready_s=float(seconds) if isinstance(seconds, (int, float)) and 0 <= seconds < 1e9 else None,
        timings=tail(timings), observed=facts.get("observed") is not False, link=_public(facts.get("link")),
    )  # fmt: skip


def told(log: bytes, address: str | None) -> DeploymentStatus | None:
    """The last thing that the keeper says in a log, with the requests that it tells of; None where it says nothing."""
    lines = TOLD.findall(log)
    if not lines:
        return None
    rows = _facts(lines[-1]).get("latest")
    records = [_record(row) for row in rows if _sound(row)] if isinstance(rows, list) else []
    return with_words(
        deployment_status(lines[-1], "".join(f"{json.dumps(one)}\n" for one in records).encode(), address), log
    )


def with_words(said: DeploymentStatus, log: bytes) -> DeploymentStatus:
    """What the nodes printed last is why they ended."""
    if said.state != "ended" or not said.detail or (words := last_words(log)) is None:
        return said
    return replace(said, detail=f"{said.detail}: {words}"[:300])


def last_words(log: bytes) -> str | None:
    """The last line that nodes have printed; what is said of them is not theirs."""
    for line in reversed(log[-WORDS_BYTES:].decode("utf-8", "replace").splitlines()):
        words = PREFIX.sub("", plain(line)).strip()
        if words and "=== fogspec state " not in words and not words.startswith(PLATFORM):
            return words[:300]
    return None


def _sound(row: object) -> TypeGuard[list[Any]]:
    return isinstance(row, list) and len(row) == 4 and isinstance(row[1], (int, float))


def _record(row: list[Any]) -> dict[str, Any]:
    return {"name": str(row[0]), "latency_s": row[1], "ok": row[2] is True, "scenario": row[3]}


def _public(said: object) -> str | None:
    """One line that can be handed to the robot, which checks it again."""
    return said if isinstance(said, str) and re.fullmatch(r"[A-Za-z0-9+/=]{1,4096}", said) else None


def tail(timings: bytes) -> bytes:
    """The last whole lines."""
    if len(timings) <= TAIL_BYTES:
        return timings
    cut = timings[-TAIL_BYTES:]
    return cut[cut.find(b"\n") + 1 :]


def _facts(said: bytes) -> dict[str, Any]:
    try:
        found = json.loads(said[:65536])
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}
