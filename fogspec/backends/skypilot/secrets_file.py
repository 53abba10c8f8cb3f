"""Secrets on their way to a machine: in a file that only its owner may read, gone from here once it is there.

SkyPilot's own `secrets` puts the values on command lines, ssh's on this host and the job's on the machine, for every user of
either to see, and into the API server's database (0.14.1: `_exec_code_on_head`, `SlurmCodeGen.add_task`).
"""

import os
import shlex
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

from fogspec.backends.skypilot.errors import CloudProblem

# Where the task's scripts look for it.
THERE = "~/.fogspec/secrets"
# What SkyPilot itself reads: the credentials of a private registry (docs.skypilot.co, "Using Private Docker Registries").
SKYPILOTS = "SKYPILOT_"


def values(names: Iterable[str]) -> dict[str, str]:
    """The environment's values; raises CloudProblem for a name that it does not have."""
    wanted = sorted(names)
    if missing := [one for one in wanted if one not in os.environ]:
        raise CloudProblem("setup", f"the environment does not have {', '.join(missing)}")
    return {one: os.environ[one] for one in wanted}


def check(task: Mapping[str, object]) -> None:
    """Raise CloudProblem for a secret of the task that the environment does not have: before anything is asked for."""
    secrets = task.get("secrets")
    if isinstance(secrets, Mapping):
        values(secrets)


def write(name: str, secrets: Mapping[str, str]) -> Path:
    """Write them as lines for a shell."""
    forget(name)
    path = place(name)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
    with open(descriptor, "w", encoding="utf-8", errors="surrogateescape") as file:
        file.writelines(f"export {one}={shlex.quote(value)}\n" for one, value in secrets.items())
    return path


def forget(name: str) -> None:
    """Remove it."""
    place(name).unlink(missing_ok=True)


def place(name: str) -> Path:
    """The file of a machine's launch; in memory where the system has a place for that."""
    return Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir(), f"{name}.secrets")
