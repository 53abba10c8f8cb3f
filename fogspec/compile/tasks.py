"""What machines run, and the plain SkyPilot tasks that have it run, launchable by hand."""

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fogspec.agent.graph_variables import RMW
from fogspec.backends.protocol import (
    AGENT_FILE,
    DEPLOY_FILE,
    DEPLOYMENT_IDLE_MINUTES,
    LAUNCH_FILE,
    LINK_FOLDER,
    MEASURE_FILE,
    SETUP_FILE,
    Work,
)
from fogspec.base import digest, text, units
from fogspec.base.clouds import OwnEnd, cloud_of
from fogspec.base.layout import DEFAULT_ENVIRONMENT, Layout
from fogspec.catalog.machine import Machine
from fogspec.compile.launch_source import flat, node_launch
from fogspec.compile.links import link_of, port_of
from fogspec.language import warned as codes
from fogspec.language.graph_names import names_to_activate
from fogspec.language.launch_text import has_substitution, needs_launch
from fogspec.language.lockfile import ImageUse, registry_login
from fogspec.language.named_files import measurement_sends_files
from fogspec.language.probe import holds, module, optional, player, probe_parts
from fogspec.language.schema import UBUNTU, Application, ComposableNode, Node, Ros, Spec
from fogspec.language.warned import Warned, warned
from fogspec.plan.commitment import Commitment, engine_settings
from fogspec.plan.schema import Sample

BAG_PACKAGES = ["mcap==1.6.0", "rosbags==0.11.9"]  # from PyPI, to read bags on the measured machine
# The robot's public half, given when the task is launched: the task itself is the same for every robot.
LINK_PEER = "FOGSPEC_LINK_PEER"
# How long the deployment may run, given when it is launched: it depends on the date, and on what was spent before.
LIFETIME, ENDS = "FOGSPEC_LIFETIME_S", "FOGSPEC_ENDS"
LEAST_LIFETIME_S = 60.0  # a deployment that would end before is not started
# The sha256 of the package of ros-infrastructure/ros-apt-source that sets up ROS 2's package source on each Ubuntu, as Docker's
# official `ros` images check it.
ROS_APT_SOURCE = "1.2.0"
ROS_APT_PACKAGES = {
    "jammy": "767884cf4ed03116b9d64438930a832ed854147ae435279a7924dfdf60f94433",
    "noble": "0804d9b13db770eb87019be414cd78378835228ad5fa801fc88758596dd8f7e5",
    "resolute": "a275b9b819874e745a928e83e39c429fa4d607159285c4ef3ebcf75afa732ee3",
}


def sample_work(application: Application, sample: Sample, layout: Layout, sent: Mapping[Path, bytes]) -> Work:
    """Return what measures a sample; `sent` are the contents of the files that the machine is sent, by path."""
    spec, above = application.spec, sample.decided_above
    mounts = {**_always(spec, layout), MEASURE_FILE: layout.relative(layout.measure_script)}
    contents = {layout.relative(path): content for path, content in sent.items()}
    return Work(
        script=MEASURE_FILE,
        arguments=() if above is None else ("--decided-above", units.format_number(above)),
        setup=_setup(spec),
        mounts=mounts,
        workdir=layout.relative(layout.spec.parent) if measurement_sends_files(spec) else None,
        secrets=tuple(spec.secrets),
        digests={path: digest.of_bytes(contents[path]) for path in mounts.values() if path in contents},
    )


def deploy_work(application: Application, layout: Layout, digests: Mapping[str, str] | None = None) -> Work:
    """Return what runs the cloud nodes; `digests` are those of the files that the manifest pins."""
    spec, linked = application.spec, link_of(application).protocol is not None
    mounts = {**_always(spec, layout), DEPLOY_FILE: layout.relative(layout.deploy_script)}
    if spec.ros is not None and launched_together(spec):
        mounts[LAUNCH_FILE] = layout.relative(layout.cloud)
    if linked:
        mounts[LINK_FOLDER] = layout.relative(layout.link)
    given = [*([LIFETIME, ENDS] if has_end(spec) else []), *([LINK_PEER] if linked else [])]
    files = measurement_sends_files(spec) or spec.deployment.ready is not None
    return Work(
        script=DEPLOY_FILE,
        setup=(*_setup(spec), *(("bash", f"{LINK_FOLDER}/link.sh", "cloud", "install") if linked else ())),
        mounts=mounts,
        workdir=layout.relative(layout.spec.parent) if files else None,
        secrets=tuple(spec.secrets),
        envs=dict.fromkeys(given),
        digests=digests or {},
    )


def _setup(spec: Spec) -> tuple[str, ...]:
    """Return the command that sets up ROS 2 and then runs the words behind it; none for plain processes."""
    return () if spec.ros is None else ("bash", SETUP_FILE)


def _always(spec: Spec, layout: Layout) -> dict[str, str]:
    """Return the files that every machine is sent, by their paths there."""
    setup = {} if spec.ros is None else {SETUP_FILE: layout.relative(layout.setup_script)}
    return {AGENT_FILE: layout.relative(layout.agent), **setup}


def sample_task(application: Application, sample: Sample, commitment: Commitment, work: Work) -> dict[str, Any]:
    """Return the SkyPilot task that measures one sample.

    SkyPilot's autostop with `wait_for: none` counts the machine's lifetime whether or not the job still runs, so that one
    that hangs keeps no machine. SkyPilot arms it once the files are there, and the job begins. Where the engine has a time
    limit of its own, the task sets it as well: it counts from the machine's start, so no controller is needed for it.
    """
    autostop = {"idle_minutes": math.ceil(commitment.lifetime_s / 60), "down": True, "wait_for": "none"}
    labels = {"fogspec-application": application.metadata.name, "fogspec-sample": sample.id[:63].rstrip("-")}
    task = _task(application, sample.machine, autostop, labels, work)
    settings = engine_settings(sample.machine, commitment.lifetime_s)
    return task if settings is None else {**task, "config": settings}


def sample_comment(sample: Sample, commitment: Commitment) -> str:
    """Return which machine measures a sample and why, its price, its longest time and the most that it may cost."""
    machine = sample.machine
    most = units.shown_duration(commitment.paid_s)
    cost = f"{machine.price_words}, at most {most}, at most {units.dollars(commitment.usd(machine))}"
    free = f"No price, at most {most}"
    return f"{machine.instance} on {machine.infra}: {sample.reason}. {cost if machine.price else free}."


def deploy_comment(spec: Spec, machine: Machine, reason: str) -> str:
    """Return which machine is deployed and why, its price, its longest time and the most that it may cost."""
    until, most = spec.deployment.until, spec.deployment.budget
    words = [machine.price_words if machine.price else "no price"]
    words.append("until fogspec down" if until is None else f"until {until}")
    words += [] if most is None else [f"at most {units.dollars(most)}"]
    return f"{machine.instance} on {machine.infra}: {reason}. {', '.join(words)}."


def deploy_task(application: Application, machine: Machine, work: Work) -> dict[str, Any]:
    """Return the SkyPilot task that runs the cloud nodes on the chosen machine, until they end or it is unused."""
    autostop = {"idle_minutes": DEPLOYMENT_IDLE_MINUTES, "down": True}
    labels = {"fogspec-application": application.metadata.name}
    if application.environment != DEFAULT_ENVIRONMENT:
        labels["fogspec-environment"] = application.environment
    task = _task(application, machine, autostop, labels, work)
    settings = engine_settings(machine, None)
    if settings is not None:
        task["config"] = settings
    if LINK_FOLDER in work.mounts and link_of(application).protocol == "tcp" and cloud_of(machine.infra).opens_ports:
        task["resources"]["ports"] = [port_of(application)]
    return {**task, "envs": dict(work.envs)} if work.envs else task


def has_end(spec: Spec) -> bool:
    """Return whether the deployment ends by itself."""
    return spec.deployment.until is not None or spec.deployment.budget is not None


def _task(
    application: Application, machine: Machine, autostop: Mapping[str, Any], labels: Mapping[str, str], work: Work
) -> dict[str, Any]:
    task: dict[str, Any] = {
        "name": application.metadata.name,
        "resources": _resources(application.spec, machine, autostop, labels),
        # By default SkyPilot gives a managed job the credentials of its API server, with which it could start machines.
        "api_server_access": False,
    }
    if work.workdir is not None:
        task["workdir"] = work.workdir
    if work.secrets:
        task["secrets"] = dict.fromkeys(work.secrets)
    task["file_mounts"] = dict(work.mounts)
    if work.setup:
        task["setup"] = " ".join(work.setup)
    task["run"] = " ".join(["exec", "bash", work.script, *map(text.shell, work.arguments)])
    return task


def _resources(spec: Spec, machine: Machine, autostop: Mapping[str, Any], labels: Mapping[str, str]) -> dict[str, Any]:
    cloud = cloud_of(machine.infra)
    resources: dict[str, Any] = {"infra": machine.infra} if cloud.on_skypilot else {}
    if cloud.instance_types:
        resources["instance_type"] = machine.instance
    else:
        resources |= {"cpus": f"{machine.cpus:g}", "memory": f"{machine.memory:g}"}
    if cloud.disk_gib is not None:
        resources["disk_size"] = cloud.disk_gib
    if machine.price > 0:
        # SkyPilot looks at it only when it chooses the machine itself: runners compare the price of a pinned one.
        resources["max_hourly_cost"] = math.ceil(round(machine.price * 1e4, 6)) / 1e4
    if machine.gpu is not None:
        resources["accelerators"] = machine.gpu.key
    if machine.spot and cloud.own_end is not OwnEnd.JOB_TIME_LIMIT:
        resources["use_spot"] = True
    if spec.ros is not None and spec.ros.image is not None and cloud.on_skypilot and cloud.containers:
        resources["image_id"] = f"docker:{spec.ros.image}"
    return {**resources, "autostop": dict(autostop), "labels": dict(labels)}


def left_out(spec: Spec, machine: Machine) -> list[Warned]:
    """Return what a task for this machine leaves out of the spec, because there is no such thing there."""
    cloud, image = cloud_of(machine.infra), spec.ros.image if spec.ros else None
    if not cloud.on_skypilot:
        return [warned(codes.left_out, what="image", cloud=cloud.name, image=image)] if image else []
    if cloud.own_end is OwnEnd.POD_DEADLINE and image and (login := registry_login(spec)):
        return [warned(codes.left_out, what="login", cloud=cloud.name, image=image, secrets=login)]
    found = []
    if image and not cloud.containers:
        found.append(warned(codes.left_out, what="image", cloud=cloud.name, image=image))
    if machine.spot and cloud.own_end is OwnEnd.JOB_TIME_LIMIT:
        found.append(warned(codes.left_out, what="spot", cloud=cloud.name))
    return found


def image_use(spec: Spec, measures: bool) -> ImageUse:
    """Return what machines that measure, or serve, need of their image.

    Secrets are those with which they pull it; none where no place has machines that log in to a registry.
    """
    clouds = [one for one in map(cloud_of, spec.infra) if one.on_skypilot and one.containers]
    log_in = [one for one in clouds if one.own_end is not OwnEnd.POD_DEADLINE]
    variable = next((one.user_variable for one in clouds if one.user_variable), None)
    part = "benchmark" if measures else "deployment"
    return ImageUse(
        architectures=spec.hardware.arch,
        secrets=[*(registry_login(spec) if log_in else []), *(one for one in spec.secrets if one == variable)],
        user_variable=variable,
        timeout=f"spec.{part}.ready_timeout",
        timeout_s=getattr(spec, part).ready_timeout if clouds else math.inf,
    )


def measured_processes(spec: Spec) -> list[list[str] | dict[str, Any]]:
    """Return every process of a sample: listeners, cloud nodes, and the client unless a node is the client."""
    client, inside = spec.benchmark.workload.node, probe_parts(spec).inside
    nodes = [{"argv": [*inside, *command(node)], "name": label(node)} for node in spec.cloud]
    clients: list[dict[str, Any]] = [{"argv": command(client), "name": label(client)}] if client else []
    if holds(spec):
        held = [{**one, "held": True} for one in (*clients, *({"argv": argv} for argv in player(spec)))]
        return [*listener(spec), *nodes, *activates(spec.cloud), *held]
    return [*listener(spec), *nodes, *activates(spec.cloud), *clients, *player(spec)]


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
        again, delay_s = node.launch.respawn, node.launch.respawn_delay
        if again:
            kept["respawn"] = "always" if again is True else again
            found.append({**kept, **({"respawn_delay": delay_s} if delay_s else {})})
        elif spec.ros is None:
            found.append(kept)
    found += [{"argv": argv, "name": "activate", "respawn": "always"} for argv in activates(spec.cloud)]
    return found


def label(node: Node) -> str:
    """Return the name of a cloud node for people: in front of what it prints, and where its restarts are counted."""
    words = [str(node.name or node.executable)]
    if node.cmd is not None:  # a script is named with its interpreter, a program without its options
        words = [os.path.basename(node.cmd[0]), *(word for word in node.cmd[1:2] if not word.startswith("-"))]
    return "".join(c for c in " ".join(words) if c.isprintable())[:60] or "node"


def launched_together(spec: Spec) -> list[Node]:
    """Return the cloud nodes that one launch file starts: those that are not started again when they end."""
    return [node for node in spec.cloud if not node.launch.respawn]


def _found(path: str, program: str, words: str) -> list[str]:
    """Return a program that is given a path which only the machine's own shell can tell."""
    return ["sh", "-c", f'{program} "{path}" {words}'.strip()]


def listener(spec: Spec) -> list[list[str]]:
    """Return the processes that listen to the graph beside the nodes."""
    return [list(argv) for argv in probe_parts(spec).beside]


def asks(nodes: Sequence[Node]) -> list[str] | None:
    """Return the command that asks nodes whether they declare the parameters that the spec sets; None if it sets none.

    A node whose name the spec does not say is found by package and executable of its process; those of a parameter file, which
    may be for other nodes, are not asked about.
    """
    found: list[str] = []
    for node in nodes:
        parts: list[Node | ComposableNode] = [node, *node.composable_node_descriptions]
        for one in parts:
            names = [name for name, _ in flat(one.parameters)]
            texts = [one.name or "", one.namespace or ""]
            known = one.name and not any(map(has_substitution, texts))
            process = f"{node.package}/{node.executable}"
            named = f"/{texts[1].strip('/')}/{one.name}" if texts[1].strip("/") else one.name
            found += ["--of", str(named) if known else process, *names] if names else []
    return [*module("declared", *found)] if found else None


def activates(nodes: Sequence[Node]) -> list[list[str]]:
    """Return the process that activates managed nodes, if the spec wants that of any."""
    names = names_to_activate(nodes)
    return [list(module("activate", *(word for name in names for word in ("--of", name))))] if names else []


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
        *(["--prefix", node.launch.prefix] if node.launch.prefix else []),
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
    for key, value in flat(node.parameters):
        found += ["-p", f"{key}:={parameter(value)}"]
    for (
        source,
        target,
    ) in node.remappings.items():  # in their order: the first that matches a name is the one that counts
        found += ["-r", f"{source}:={target}"]
    return ["--ros-args", *found] if found else []


def parameter(value: Any) -> str:
    """Return a ROS 2 parameter as the YAML that its parser reads back with the same type: 38.0 stays a double."""
    return json.dumps(value, ensure_ascii=False)


def _middleware(ros: Ros) -> list[str]:
    """Return the Debian package of the middleware that all nodes have, if the spec names it."""
    return [f"ros-{ros.distro}-{ros.env[RMW].replace('_', '-')}"] if RMW in ros.env else []


def ros_environment(spec: Spec) -> dict[str, Any]:
    """Return the values of the scripts' templates: ROS 2 and its image (None without), workspace, packages, secrets."""
    ros = spec.ros
    return {
        "distro": ros.distro if ros else None,
        "image": ros.image if ros else None,
        "workspace": ros.workspace if ros else None,
        "apt": [*ros.apt, *_middleware(ros)] if ros else [],
        "graph": ros.env if ros else {},
        "setup": ros.setup if ros else [],
        "setup_digest": digest.shorten(digest.of_value(ros.setup if ros else [])),
        "apt_source": {"codename": UBUNTU[ros.distro], "sha256": ROS_APT_PACKAGES[UBUNTU[ros.distro]]} if ros else {},
        "apt_source_version": ROS_APT_SOURCE,
        "compiler": bool(probe_parts(spec).inside),
        "secrets": spec.secrets,
        "login": registry_login(spec),
        "packages": BAG_PACKAGES if spec.probe.bag or spec.benchmark.workload.bag else [],
    }
