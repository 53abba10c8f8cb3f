"""Compiled tasks: plain SkyPilot tasks as typed values, launchable by hand, the same for every runner.

The shell scripts inside are rendered elsewhere and given as text, because rendering reads templates from disk.
"""

import json
import math
import os
from collections.abc import Iterator, Mapping
from typing import Any

from fogspec.base import digest
from fogspec.base.clouds import OwnEnd, cloud_of
from fogspec.base.layout import DEFAULT_ENVIRONMENT
from fogspec.catalog.machine import Machine
from fogspec.compile.launch_source import node_launch
from fogspec.compile.links import link_of, port_of
from fogspec.plan.commitment import Commitment, engine_settings
from fogspec.plan.schema import Sample
from fogspec.spec.launch_text import needs_launch
from fogspec.spec.lockfile import measurement_sends_files, registry_login
from fogspec.spec.probe import module, optional, player, probe_parts
from fogspec.spec.schema import Application, Node, Spec

DEPLOYMENT_IDLE_MINUTES = 30
BAG_PACKAGES = ["mcap==1.6.0", "rosbags==0.11.9"]  # from PyPI, to read bags on the measured machine
AGENT_FILE = "~/.fogspec/agent.pyz"
LAUNCH_FILE = "~/.fogspec/launch/cloud.launch.py"
LINK_FOLDER = "~/.fogspec/link"
# The robot's public half, given when the task is launched: the task itself is the same for every robot.
LINK_PEER = "FOGSPEC_LINK_PEER"
# How long the deployment may run, given when it is launched: it depends on the date, and on what was spent before.
LIFETIME, ENDS = "FOGSPEC_LIFETIME_S", "FOGSPEC_ENDS"
LEAST_LIFETIME_S = 60.0  # a deployment that would end before is not started
# The release of ros-infrastructure/ros-apt-source that sets up ROS 2's package source; by distribution, the code name of
# its Ubuntu (REP 2000) and the package's sha256, as Docker's official `ros` images check it.
ROS_APT_SOURCE = "1.2.0"
ROS_APT_PACKAGES = {
    "humble": ("jammy", "767884cf4ed03116b9d64438930a832ed854147ae435279a7924dfdf60f94433"),
    "jazzy": ("noble", "0804d9b13db770eb87019be414cd78378835228ad5fa801fc88758596dd8f7e5"),
    "lyrical": ("resolute", "a275b9b819874e745a928e83e39c429fa4d607159285c4ef3ebcf75afa732ee3"),
}


def sample_task(
    application: Application,
    sample: Sample,
    commitment: Commitment,
    *,
    workdir: str,
    agent: str,
    setup: str | None,
    run: str,
) -> dict[str, Any]:
    """Return the task that measures one sample; `workdir` and `agent` are paths relative to where it is launched.

    SkyPilot's autostop with `wait_for: none` counts the machine's lifetime whether or not the job still runs, so that one
    that hangs keeps no machine. SkyPilot arms it once the files are there, and the job begins. Where the engine has a time
    limit of its own, the task sets it as well: it counts from the machine's start, so no controller is needed for it.
    """
    autostop = {"idle_minutes": math.ceil(commitment.lifetime_s / 60), "down": True, "wait_for": "none"}
    labels = {"fogspec-application": application.metadata.name, "fogspec-sample": sample.id[:63].rstrip("-")}
    task = _task(
        application,
        sample.machine,
        autostop=autostop,
        labels=labels,
        workdir=workdir,
        agent=agent,
        setup=setup,
        run=run,
    )
    settings = engine_settings(sample.machine, commitment.lifetime_s)
    return task if settings is None else {**task, "config": settings}


def deploy_task(
    application: Application,
    machine: Machine,
    *,
    workdir: str,
    agent: str,
    setup: str | None,
    run: str,
    launch: str | None = None,
    link: str | None = None,
) -> dict[str, Any]:
    """Return the task that runs the cloud nodes on the chosen machine, until they end or it is unused.

    `launch` is the cloud's launch file and `link` the folder of the link's configuration, where there are such.
    """
    autostop = {"idle_minutes": DEPLOYMENT_IDLE_MINUTES, "down": True}
    labels = {"fogspec-application": application.metadata.name}
    if application.environment != DEFAULT_ENVIRONMENT:
        labels["fogspec-environment"] = application.environment
    task = _task(
        application,
        machine,
        autostop=autostop,
        labels=labels,
        workdir=workdir,
        agent=agent,
        setup=setup,
        run=run,
    )
    if application.spec.deployment.ready is not None:
        task = {**{key: task[key] for key in ("name", "resources")}, "workdir": workdir, **task}
    settings = engine_settings(machine, None)
    if settings is not None:
        task["config"] = settings
    if launch is not None:
        task["file_mounts"][LAUNCH_FILE] = launch
    given = [LIFETIME, ENDS] if has_end(application.spec) else []
    if link is not None:
        given.append(LINK_PEER)
        task["file_mounts"][LINK_FOLDER] = link
        if link_of(application).protocol == "tcp" and cloud_of(machine.infra).containers:
            task["resources"]["ports"] = [port_of(application)]
    return {**task, "envs": dict.fromkeys(given)} if given else task


def has_end(spec: Spec) -> bool:
    """Return whether the deployment ends by itself."""
    return spec.deployment.until is not None or spec.deployment.max_spend is not None


def _task(
    application: Application,
    machine: Machine,
    *,
    autostop: Mapping[str, Any],
    labels: Mapping[str, str],
    workdir: str,
    agent: str,
    setup: str | None,
    run: str,
) -> dict[str, Any]:
    spec = application.spec
    task: dict[str, Any] = {
        "name": application.metadata.name,
        "resources": _resources(spec, machine, autostop, labels),
        # By default SkyPilot gives a managed job the credentials of its API server, with which it could start machines.
        "api_server_access": False,
    }
    if measurement_sends_files(spec):
        task["workdir"] = workdir
    if spec.secrets:
        task["secrets"] = dict.fromkeys(spec.secrets)
    task["file_mounts"] = {AGENT_FILE: agent}
    if setup is not None:
        task["setup"] = setup
    task["run"] = run
    return task


def _resources(spec: Spec, machine: Machine, autostop: Mapping[str, Any], labels: Mapping[str, str]) -> dict[str, Any]:
    cloud = cloud_of(machine.infra)
    resources: dict[str, Any] = {"infra": machine.infra} if cloud.on_skypilot else {}
    if cloud.instance_types:
        resources["instance_type"] = machine.instance
    else:
        resources |= {"cpus": f"{machine.cpus:g}", "memory": f"{machine.memory:g}"}
    if machine.price > 0:
        # SkyPilot looks at it only when it chooses the machine itself: runners compare the price of a pinned one.
        resources["max_hourly_cost"] = math.ceil(round(machine.price * 1e4, 6)) / 1e4
    if machine.gpu is not None:
        resources["accelerators"] = machine.gpu.key
    if machine.spot and cloud.containers:
        resources["use_spot"] = True
    if spec.ros is not None and spec.ros.image is not None and cloud.on_skypilot and cloud.containers:
        resources["image_id"] = f"docker:{spec.ros.image}"
    return {**resources, "autostop": dict(autostop), "labels": dict(labels)}


def left_out(spec: Spec, machine: Machine) -> list[str]:
    """Return what a task for this machine leaves out of the spec, because there is no such thing there."""
    cloud, image = cloud_of(machine.infra), spec.ros.image if spec.ros else None
    if not cloud.on_skypilot:
        return [f"image {image} is left out on this host: its own ROS 2 is used"] if image else []
    if cloud.own_end is OwnEnd.POD_DEADLINE and image and (login := registry_login(spec)):
        return [f"{', '.join(login)}: not used in {cloud.name}, where the cluster's imagePullSecrets pull {image}"]
    if cloud.containers:
        return []
    found = []
    if image:
        found.append(f"image {image} is left out in {cloud.name}: ROS 2 is installed with apt, if it is absent")
    if machine.spot:
        found.append(f"spot is left out in {cloud.name}, which has none")
    return found


def login_of_machines(spec: Spec) -> list[str]:
    """Return the secrets with which machines pull the image; none where no place has machines that log in to a registry."""
    clouds = [cloud_of(place) for place in spec.infra]
    log_in = [one for one in clouds if one.on_skypilot and one.containers and one.own_end is not OwnEnd.POD_DEADLINE]
    return registry_login(spec) if log_in else []


def measured_processes(spec: Spec) -> list[list[str]]:
    """Return every process of a sample: listeners, cloud nodes, and the client unless a node is the client."""
    client, inside = spec.benchmark.workload.node, probe_parts(spec).inside
    nodes = [[*inside, *command(node)] for node in spec.cloud]
    return [*listener(spec), *nodes, *([command(client)] if client else []), *player(spec)]


def deployed_processes(application: Application) -> list[list[str] | dict[str, Any]]:
    """Return every process of a deployment for the supervisor: the link's end, and the nodes.

    Where there is ROS 2, `ros2 launch` starts the nodes that end all others when they end. Each node with `respawn` is a
    process of its own, which the supervisor starts again.
    """
    found: list[list[str] | dict[str, Any]] = []
    if link_of(application).protocol is not None:
        found.append(_found("${FOGSPEC_LINK:-$HOME/.fogspec/link}/link.sh", "exec bash", "cloud up"))
    # What serves people must not depend on what watches it.
    inside, spec = probe_parts(application.spec).inside, application.spec
    if spec.ros is not None and launched_together(spec):
        launch = _found("${FOGSPEC_LAUNCH:-$HOME/.fogspec/launch}/cloud.launch.py", "exec ros2 launch", "")
        found.append(optional(inside, launch))
    for node in spec.cloud:
        argv = optional(inside, command(node))
        kept: dict[str, Any] = {"argv": argv, "name": label(node)}
        if node.respawn:
            kept["respawn"] = "always" if node.respawn is True else node.respawn
            found.append({**kept, **({"respawn_delay": node.respawn_delay} if node.respawn_delay else {})})
        elif spec.ros is None:
            found.append(kept)
    return found


def label(node: Node) -> str:
    """Return the name of a cloud node for people: in front of what it prints, and where its restarts are counted."""
    words = [str(node.name or node.executable)]
    if node.cmd is not None:  # a script is named with its interpreter, a program without its options
        words = [os.path.basename(node.cmd[0]), *(word for word in node.cmd[1:2] if not word.startswith("-"))]
    return "".join(c for c in " ".join(words) if c.isprintable())[:60] or "node"


def launched_together(spec: Spec) -> list[Node]:
    """Return the cloud nodes that one launch file starts: those that are not started again when they end."""
    return [node for node in spec.cloud if not node.respawn]


def _found(path: str, program: str, words: str) -> list[str]:
    """Return a program that is given a path which only the machine's own shell can tell."""
    return ["sh", "-c", f'{program} "{path}" {words}'.strip()]


def listener(spec: Spec) -> list[list[str]]:
    """Return the processes that listen to the graph beside the nodes."""
    return [list(argv) for argv in probe_parts(spec).beside]


def command(node: Node) -> list[str]:
    """Return the argv that starts a node: `ros2 run` in launch_ros' words, or the plain process as it is."""
    environment = ["env", *(f"{key}={value}" for key, value in sorted(node.env.items()))] if node.env else []
    if needs_launch(node):
        # It is on the command line, so that no further file is sent; the agent has launch itself play it.
        return list(module("launch", node_launch(node)))
    if node.cmd is not None:
        return [*environment, *node.cmd, *node.arguments]
    return [
        *environment,
        "ros2",
        "run",
        *(["--prefix", node.prefix] if node.prefix else []),
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
    """Return a ROS 2 parameter as the YAML that its parser reads back with the same type: 38.0 stays a double."""
    return json.dumps(value, ensure_ascii=False)


def ros_environment(spec: Spec) -> dict[str, Any]:
    """Return the values of the scripts' templates: ROS 2 distribution (None without), workspace, packages, secrets."""
    ros = spec.ros
    return {
        "distro": ros.distro if ros else None,
        "workspace": ros.workspace if ros else None,
        "apt": ros.apt if ros else [],
        "setup": ros.setup if ros else [],
        "setup_digest": digest.shorten(digest.of_value(ros.setup if ros else [])),
        "apt_source": dict(zip(("codename", "sha256"), ROS_APT_PACKAGES[ros.distro], strict=True)) if ros else {},
        "apt_source_version": ROS_APT_SOURCE,
        "compiler": bool(probe_parts(spec).inside),
        "secrets": spec.secrets,
        "login": registry_login(spec),
        "packages": BAG_PACKAGES if spec.probe.bag or spec.benchmark.workload.bag else [],
    }
