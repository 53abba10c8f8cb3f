"""Compiled tasks: plain SkyPilot tasks as typed values, launchable by hand, the same for every runner.

The shell scripts inside are rendered elsewhere and given as text, because rendering reads templates from disk.
"""

import json
import math
from collections.abc import Iterator, Mapping
from typing import Any

from fogspec.base import digest
from fogspec.plan import MachineRef, Sample
from fogspec.spec import Application, Node, Spec

DEPLOYMENT_IDLE_MINUTES = 30
# Places without containers and spot machines: SkyPilot refuses a task that asks for them (docs.skypilot.co, "Slurm").
BARE = ("slurm", "ssh")
AGENT_FOLDER = "~/.fogspec/agent"
ROS_APT_SOURCE = "1.1.0"  # release of ros-infrastructure/ros-apt-source that sets up the ROS 2 package source


def sample_task(
    application: Application,
    sample: Sample,
    lifetime_s: float,
    *,
    workdir: str,
    agent: str,
    setup: str | None,
    run: str,
) -> dict[str, Any]:
    """The task that measures one sample; `workdir` and `agent` are folders relative to where it is launched.

    The machine ends `lifetime_s` after its start at the latest: SkyPilot's autostop with `wait_for: none` counts
    whether or not the job still runs, so that one that hangs keeps no machine.
    """
    autostop = {"idle_minutes": math.ceil(lifetime_s / 60), "down": True, "wait_for": "none"}
    labels = {"fogspec-application": application.metadata.name, "fogspec-sample": sample.id[:63].rstrip("-")}
    return _task(application, sample.machine, autostop, labels, workdir, agent, setup, run)


def deploy_task(
    application: Application, machine: MachineRef, *, workdir: str, agent: str, setup: str | None, run: str
) -> dict[str, Any]:
    """The task that runs the cloud nodes on the chosen machine, until they end or nobody uses it."""
    autostop = {"idle_minutes": DEPLOYMENT_IDLE_MINUTES, "down": True}
    labels = {"fogspec-application": application.metadata.name}
    return _task(application, machine, autostop, labels, workdir, agent, setup, run)


def _task(
    application: Application, machine: MachineRef, autostop: Mapping[str, Any], labels: Mapping[str, str],
    workdir: str, agent: str, setup: str | None, run: str,
) -> dict[str, Any]:  # fmt: skip
    spec = application.spec
    task: dict[str, Any] = {
        "name": application.metadata.name,
        "resources": _resources(spec, machine, autostop, labels),
    }
    if _needs_files(spec):
        task["workdir"] = workdir
    if spec.secrets:
        task["secrets"] = dict.fromkeys(spec.secrets)
    task["file_mounts"] = {AGENT_FOLDER: agent}
    if setup is not None:
        task["setup"] = setup
    task["run"] = run
    return task


def _resources(
    spec: Spec, machine: MachineRef, autostop: Mapping[str, Any], labels: Mapping[str, str]
) -> dict[str, Any]:
    if machine.infra == "local":
        resources: dict[str, Any] = {"cpus": f"{machine.cpus:g}", "memory": f"{machine.memory:g}"}
    else:
        resources = {"infra": machine.infra, "instance_type": machine.instance}
    if machine.price > 0:
        # SkyPilot looks at it only when it chooses the machine itself: runners compare the price of a pinned one.
        resources["max_hourly_cost"] = math.ceil(round(machine.price * 1e4, 6)) / 1e4
    if machine.gpu is not None:
        resources["accelerators"] = f"{machine.gpu.name}:{machine.gpu.count:g}"
    bare = machine.infra.partition("/")[0] in BARE
    if machine.spot and not bare:
        resources["use_spot"] = True
    if spec.ros is not None and spec.ros.image is not None and not bare:
        resources["image_id"] = f"docker:{spec.ros.image}"
    return {**resources, "autostop": dict(autostop), "labels": dict(labels)}


def left_out(spec: Spec, machine: MachineRef) -> list[str]:
    """What a task for this machine leaves out of the spec, because SkyPilot cannot have it there."""
    cloud = machine.infra.partition("/")[0]
    if cloud not in BARE:
        return []
    image = spec.ros.image if spec.ros else None
    found = (
        [] if image is None else [f"image {image} is left out in {cloud}: ROS 2 is installed with apt, if it is absent"]
    )
    return [*found, *([f"spot is left out in {cloud}, which has none"] if machine.spot else [])]


def _needs_files(spec: Spec) -> bool:
    """Whether anything on the machine is named relative to the spec."""
    nodes = [*spec.cloud, *([spec.benchmark.workload.node] if spec.benchmark.workload.node else [])]
    workspace = spec.ros is not None and spec.ros.workspace is not None
    return workspace or any(node.cmd is not None or node.parameter_files for node in nodes)


def measured_processes(spec: Spec) -> list[list[str]]:
    """Every process of a sample: who listens, what is offloaded, and the client that sends requests, if there is one."""
    client = spec.benchmark.workload.node
    return [*_listener(spec), *(command(node) for node in [*spec.cloud, *([client] if client else [])])]


def _listener(spec: Spec) -> list[list[str]]:
    """The process that reads latencies off topics; callback probes need none."""
    probe = spec.probe
    if probe.request is None or probe.response is None:
        return []
    words = ["--request", probe.request, "--response", probe.response, "--match", probe.match or "stamp"]
    return [["python3", "-m", "fogspec_topics", *words]]


def command(node: Node) -> list[str]:
    """The argv that starts a node: `ros2 run` in launch_ros' words, or the plain process as it is."""
    environment = ["env", *(f"{key}={value}" for key, value in sorted(node.env.items()))] if node.env else []
    if node.cmd is not None:
        return [*environment, *node.cmd, *node.arguments]
    return [
        *environment,
        "ros2",
        "run",
        str(node.package),
        str(node.executable),
        *node.arguments,
        *_ros_arguments(node),
    ]


def _ros_arguments(node: Node) -> list[str]:
    found: list[str] = []
    if node.name:
        found += ["-r", f"__node:={node.name}"]
    if node.namespace:
        found += ["-r", f"__ns:={node.namespace}"]
    for path in node.parameter_files:
        found += ["--params-file", path]
    for key, value in _flat(node.parameters):
        found += ["-p", f"{key}:={parameter(value)}"]
    for source, target in sorted(node.remappings.items()):
        found += ["-r", f"{source}:={target}"]
    return ["--ros-args", *found] if found else []


def _flat(parameters: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in sorted(parameters.items()):
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def parameter(value: Any) -> str:
    """A ROS 2 parameter as the YAML that its parser reads back with the same type: 38.0 stays a double."""
    return json.dumps(value, ensure_ascii=False)


def ros_environment(spec: Spec) -> dict[str, Any]:
    """What the scripts say of ROS 2: distribution (None without ROS), workspace, packages, set-up lines."""
    ros = spec.ros
    return {
        "distro": ros.distro if ros else None,
        "workspace": ros.workspace if ros else None,
        "apt": ros.apt if ros else [],
        "setup": ros.setup if ros else [],
        "setup_digest": digest.of_value(ros.setup if ros else [])[7:19],
        "apt_source": {"version": ROS_APT_SOURCE},
    }
