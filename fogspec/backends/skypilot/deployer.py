"""Deployments on machines of any infra that SkyPilot knows: one cluster of one machine a launch, named like it.

What the nodes do is read from the end of the job's log, which works on every infra and opens no port.
"""

import contextlib
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fogspec.backends import agent_state
from fogspec.backends.naming import is_machine_of
from fogspec.backends.protocol import DeploymentStatus, Launch, LaunchRefused, Unreachable
from fogspec.backends.skypilot import secrets_file
from fogspec.backends.skypilot.client import Call, Client
from fogspec.backends.skypilot.errors import FORGOTTEN, CloudProblem
from fogspec.base.errors import CloudError

LABEL = "fogspec-application"
ASK_S = 240.0  # the first question may have to start an API server
DOWN_S = 900.0
TAIL_LINES, MANY_LINES = 2000, 200_000
TAIL_BYTES = 256 * 2**20
OVER = ("SUCCEEDED", "FAILED", "FAILED_SETUP", "FAILED_DRIVER", "CANCELLED")


class SkyPilotDeployer:
    """Keeps the reviewed task running on a machine of its own."""

    name = "skypilot"
    poll_s = 5.0

    def __init__(self, client: Client | None = None) -> None:
        self._client = client or Client()
        self._jobs: dict[str, int] = {}

    def start(self, launch: Launch) -> None:
        """Ask for the machine; whether it can be had is said by `look`."""
        try:
            secrets_file.check(launch.task)
            self._ask("launch", task=launch.task, name=launch.name, root=str(launch.root.absolute()))
        except CloudProblem as problem:
            raise LaunchRefused(problem.reason, problem.detail, again=problem.again) from None
        except CloudError as failed:
            raise LaunchRefused("setup", failed.message) from None

    def look(self, launch: Launch) -> DeploymentStatus:
        """From the launch to the job, and what the job's log says last."""
        job = self._jobs.get(launch.name)
        if job is None:
            found = self._launched(launch.name)
            if isinstance(found, DeploymentStatus):
                return found
            job = self._jobs[launch.name] = found
        try:
            status, said = self._heard(launch.name, job)
        except CloudProblem as problem:
            if problem.gone:
                return DeploymentStatus("gone", problem.detail)
            raise Unreachable(problem.detail) from None
        if status is None:
            return DeploymentStatus("ended", "its machine knows no such job")
        if status not in (*OVER, "RUNNING"):
            return DeploymentStatus("starting", f"the job is {status.lower()}")
        if status in OVER:
            return DeploymentStatus(
                "ended", said.detail if said is not None and said.detail else f"the job ended as {status}"
            )
        return said or DeploymentStatus("starting", "the nodes have not said anything yet")

    def end(self, launch: Launch) -> None:
        """Take its machine down; raises Unreachable until its cloud says that it is gone."""
        try:
            self._client.ask("end", DOWN_S, name=launch.name)
        except (CloudProblem, CloudError) as problem:
            raise Unreachable(str(problem)) from None
        self._jobs.pop(launch.name, None)

    def names(self, application: str, state: Path) -> Sequence[str]:
        """Machines that bear the application's label, or whose launch goes on under its name."""
        try:
            labels = {one["name"]: (one.get("labels") or {}).get(LABEL) for one in self._ask("clusters")}
            known = [name for name, label in labels.items() if label == application or is_machine_of(name, application)]
            return sorted({*known, *(name for name in self._ask("waiting") if is_machine_of(name, application))})
        except (CloudProblem, CloudError) as problem:
            raise Unreachable(str(problem)) from None

    def _launched(self, name: str) -> int | DeploymentStatus:
        """The job's number once the machine is up; raises LaunchRefused when it could not be had."""
        try:
            found = self._ask("find", name=name)
            if found is None:
                return DeploymentStatus("gone", FORGOTTEN)
            value = found if "job" in found else self._ask("launched", request=found["request"], name=name)
        except CloudProblem as problem:
            if problem.gone:
                return DeploymentStatus("gone", problem.detail)
            raise LaunchRefused(problem.reason, problem.detail, again=problem.again) from None
        return DeploymentStatus("starting", "its machine is being started") if value is None else int(value["job"])

    def _heard(self, name: str, job: int) -> tuple[str | None, DeploymentStatus | None]:
        """The job's state and what its log says last; all that it takes is asked at once, for each answer takes seconds."""
        with tempfile.TemporaryDirectory(prefix="fogspec-") as folder:
            log = self._log(name, job, TAIL_LINES, Path(folder))
            known, clusters = self._client.begin("jobs", name=name), self._client.begin("clusters", names=[name])
            rows: Sequence[Mapping[str, Any]] = self._answer(known)
            status = next((str(row["status"]) for row in rows if row["job"] == job), None)
            address = next((row.get("ip") for row in self._answer(clusters) if row["name"] == name), None)
            said = agent_state.told(self._read(log, Path(folder)), address)
            if said is None and status in (*OVER, "RUNNING"):
                # Nodes that say much push what their keeper says out of the last lines.
                said = agent_state.told(
                    self._read(self._log(name, job, MANY_LINES, Path(folder)), Path(folder)), address
                )
        return status, said

    def _log(self, name: str, job: int, lines: int, folder: Path) -> Call:
        path = str(folder / "tail.log")
        return self._client.begin("log", name=name, job=job, path=path, limit=TAIL_BYTES, tail=lines)

    def _read(self, log: Call, folder: Path) -> bytes:
        """The lines that were asked for; none where they cannot be had just now."""
        with contextlib.suppress(Unreachable):
            self._answer(log)
        path = folder / "tail.log"
        return path.read_bytes() if path.is_file() else b""

    def _answer(self, call: Call) -> Any:
        if not call.wait(ASK_S):
            raise Unreachable(f"SkyPilot has not answered within {ASK_S:g} s")
        return call.value()

    def _ask(self, op: str, **words: Any) -> Any:
        return self._client.ask(op, ASK_S, **words)
