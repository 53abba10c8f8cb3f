"""The file in which secrets travel to a machine: only its owner may read it, and it is removed here after the launch.

SkyPilot's own `secrets` puts the values on command lines, of ssh on this host and of the job on the machine, which every user
of either can read, and into the API server's database (0.14.1: `_exec_code_on_head`, `SlurmCodeGen.add_task`).
"""

import os
import shlex
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

from fogspec.backends.skypilot.errors import CloudProblem

# Its path on the machine, where the task's scripts read it.
THERE = "~/.fogspec/secrets"
# Variables that SkyPilot itself reads: credentials of a private registry (docs.skypilot.co, "Using Private Docker Registries").
SKYPILOTS = "SKYPILOT_"


def values(names: Iterable[str]) -> dict[str, str]:
    """Return the values from the environment; raise CloudProblem for a name that is not set."""
    wanted = sorted(names)
    if missing := [one for one in wanted if one not in os.environ]:
        raise CloudProblem("setup", f"the environment does not have {', '.join(missing)}")
    return {one: os.environ[one] for one in wanted}


def check(task: Mapping[str, object]) -> None:
    """Raise CloudProblem for a secret of the task that is not in the environment, before anything is requested."""
    secrets = task.get("secrets")
    if isinstance(secrets, Mapping):
        values(secrets)


def write(name: str, secrets: Mapping[str, str]) -> Path:
    """Write the secrets as lines of shell; return the file."""
    forget(name)
    path = place(name)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with open(descriptor, "wb") as file:
        file.writelines(os.fsencode(f"export {one}={shlex.quote(value)}\n") for one, value in secrets.items())
    return path


def forget(name: str) -> None:
    """Remove the file."""
    place(name).unlink(missing_ok=True)


def place(name: str) -> Path:
    """Return the path of the file for a machine's launch; in memory if the system has such a directory."""
    return Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir(), f"{name}.secrets")
