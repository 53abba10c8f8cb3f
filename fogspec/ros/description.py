"""The paper's interface in a standard launch file: nodes that run in the cloud, on the machine that the manifest pins.

FogROS2-Config (ICRA 2024, section IV) writes `SkyLaunchDescription(nodes, ...constraints)`. There the constructor sampled,
launched and waited, and the object did not have to be returned. Here the machine is chosen and approved before; on the robot
the entity starts the link to it and gives the robot's nodes the link's environment, whether it is part of the
LaunchDescription or only built by the launch file. The nodes given to it are not started on the robot.
"""

import asyncio
import atexit
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from launch import LaunchDescriptionEntity
from launch.actions import ExecuteProcess, LogInfo, SetEnvironmentVariable
from launch.logging import get_logger

from fogspec.ros.manifest import Pinned, pinned_for

# What FogROS2's class takes besides: all of this is in the spec, and the manifest is what a person approved.
ELSEWHERE = (
    "mode",
    "ami",
    "workdir",
    "containers",
    "accelerators",
    "num_replicas",
    "additional_setup_commands",
    "additional_run_commands",
)
# Constraints as keywords: `max_latency`, `min_cpu`, `alpha`, `num_steps`.
CONSTRAINT = re.compile(r"((min|max)_?\w+|alpha|latency|time|cost|(num_?)?steps|gpus?|machine_?types?|constraints)")
RESPAWN_DELAY_S = 2.0


class SkyLaunchDescription(LaunchDescriptionEntity):  # type: ignore[misc]
    """Nodes that run in the cloud; the robot's own nodes are in the LaunchDescription.

    `constraint` is the paper's, or keywords; `fogspec init --from-launch` makes a spec of it, and the spec decides.
    `manifest` is the path of compiled/NAME/manifest.yaml; without it FOGSPEC_MANIFEST, else the manifest in a folder
    `compiled` beside or above the launch file whose cloud nodes are these. Raises ValueError when there is none, or when it
    deploys other nodes; TypeError for a keyword that neither FogROS2 nor fogspec has.
    """

    def __init__(
        self,
        nodes: Iterable[Any] = (),
        constraint: Mapping[str, Any] | None = None,
        *,
        manifest: str | Path | None = None,
        **others: Any,
    ) -> None:
        super().__init__()
        bare = {name: value for name, value in others.items() if CONSTRAINT.fullmatch(name)}
        if unknown := sorted(others.keys() - set(ELSEWHERE) - bare.keys()):
            raise TypeError(
                f"SkyLaunchDescription takes no {', '.join(unknown)}; what it does take is in the spec: "
                "fogspec init --from-launch FILE"
            )
        self.cloud_nodes = tuple(nodes)
        self.constraint = {**(constraint or {}), **(bare.pop("constraints", None) or {}), **bare}
        caller = Path(sys._getframe(1).f_code.co_filename)
        self.pinned: Pinned = pinned_for(self.cloud_nodes, manifest, caller)
        self.visited = False
        self._await_visit()

    def describe(self) -> str:
        """In one line, for `ros2 launch --print-description`."""
        return f"SkyLaunchDescription({self.pinned.line()})"

    def visit(self, context: Any) -> list[Any]:
        """Nothing for the cloud's nodes; the link and its environment, where the spec has one."""
        self.visited = True
        found: list[Any] = [LogInfo(msg=self.pinned.line())]
        found += [SetEnvironmentVariable(key, value) for key, value in self.pinned.environment.items()]
        if self.pinned.link is not None:
            # Fast, and needed before the robot's nodes start: they announce the addresses that are there.
            subprocess.run(_link(self.pinned.link, "start"), check=True)
            found.append(
                ExecuteProcess(
                    cmd=_link(self.pinned.link, "up"), output="screen", respawn=True, respawn_delay=RESPAWN_DELAY_S
                )
            )
        return found

    def _await_visit(self) -> None:
        """Arrange to do what `visit` does if this is built by a launch file that is launched, and not part of what it returns.

        A launch file is read, and all that it returns is visited, in one step of the launch's event loop: its next step knows.
        Processes start in later steps, with the environment as it is now. Outside of a launch, nothing is done.
        """
        try:
            loop = asyncio.get_running_loop()
        except RuntimeError:
            return
        os.environ.update(self.pinned.environment)
        loop.call_soon(self._unless_visited)

    def _unless_visited(self) -> None:
        if self.visited:
            return
        log = get_logger("fogspec")
        log.info(self.pinned.line())
        if self.pinned.link is None:
            return
        try:
            subprocess.run(_link(self.pinned.link, "start"), check=True)
        except (OSError, subprocess.CalledProcessError) as problem:
            log.error(f"the link does not start, so the robot's nodes are ended: {problem}")
            os.kill(os.getpid(), signal.SIGINT)
            return
        self._keeping = asyncio.get_running_loop().create_task(_keep_up(self.pinned.link))


def _link(script: Path, verb: str) -> list[str]:
    return ["bash", str(script), "robot", verb]


async def _keep_up(script: Path) -> None:
    """Run the link, and again when it ends, until the launch ends."""
    while True:
        process = await asyncio.create_subprocess_exec(*_link(script, "up"))

        def end(process: asyncio.subprocess.Process = process) -> None:
            if process.returncode is None:
                os.kill(process.pid, signal.SIGTERM)

        atexit.register(end)
        try:
            await process.wait()
        finally:
            atexit.unregister(end)
            end()
        await asyncio.sleep(RESPAWN_DELAY_S)
