"""The paper's interface in a standard launch file: nodes that run in the cloud, on the machine that the manifest pins.

FogROS2-Config (ICRA 2024, section IV) writes `SkyLaunchDescription([nodes], constraint={...})`. There the constructor
sampled, launched and waited. Here the machine is chosen and approved before; on the robot the entity starts the link to
it and gives the robot's nodes the link's environment. The nodes given to it are not started on the robot.
"""

import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from launch import LaunchDescriptionEntity
from launch.actions import ExecuteProcess, LogInfo, SetEnvironmentVariable

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


class SkyLaunchDescription(LaunchDescriptionEntity):  # type: ignore[misc]
    """Nodes that run in the cloud; put it first into the LaunchDescription, before the robot's own nodes.

    `constraint` is the paper's; `fogspec init --from-launch` makes a spec of it, and the spec decides. `manifest` is
    the path of compiled/NAME/manifest.yaml; without it FOGSPEC_MANIFEST, else the manifest in a folder `compiled`
    beside or above the launch file whose cloud nodes are these. Raises ValueError when there is none, or when it
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
        unknown = sorted(others.keys() - set(ELSEWHERE))
        if unknown:
            raise TypeError(f"SkyLaunchDescription takes no {', '.join(unknown)}")
        self.cloud_nodes = tuple(nodes)
        self.constraint = dict(constraint or {})
        caller = Path(sys._getframe(1).f_code.co_filename)
        self.pinned: Pinned = pinned_for(self.cloud_nodes, manifest, caller)

    def describe(self) -> str:
        """In one line, for `ros2 launch --print-description`."""
        return f"SkyLaunchDescription({self.pinned.line()})"

    def visit(self, context: Any) -> list[Any]:
        """Nothing for the cloud's nodes; the link and its environment, where the spec has one."""
        found: list[Any] = [LogInfo(msg=self.pinned.line())]
        found += [SetEnvironmentVariable(key, value) for key, value in self.pinned.environment.items()]
        if self.pinned.link is not None:
            # Fast, and needed before the robot's nodes start: they announce the addresses that are there.
            subprocess.run(["bash", str(self.pinned.link), "robot", "start"], check=True)
            command = ["bash", str(self.pinned.link), "robot", "up"]
            found.append(ExecuteProcess(cmd=command, output="screen", respawn=True, respawn_delay=2.0))
        return found
