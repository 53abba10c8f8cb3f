"""Make the launch files of both sides and the configuration of the link between them, which the manifest pins."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from fogspec.base.layout import Layout
from fogspec.base.templates import render
from fogspec.compile import launch_source
from fogspec.compile.links import link_of, port_of
from fogspec.compile.links.sros2_policy import policy
from fogspec.compile.links.wireguard import interface
from fogspec.compile.links.zenoh import common_name
from fogspec.compile.tasks import label, launched_together
from fogspec.language.graph_names import names_to_activate
from fogspec.language.schema import Application, Node

SIDES: tuple[Literal["cloud", "robot"], ...] = ("cloud", "robot")


def launch_files(application: Application, layout: Layout) -> dict[Path, bytes]:
    """Return the files sent to the machine besides the agent: the cloud launch file and the link directory."""
    files: dict[Path, str] = {}
    if application.spec.ros is not None and (nodes := launched_together(application.spec)):
        files[layout.cloud] = render(
            "cloud.launch.py.j2", **_words(application, layout, nodes, logged=True), together=True
        )
    if link_of(application).protocol is not None:
        files[layout.link / "link.sh"] = link_script(application, layout)
        for side in SIDES:
            end = link_of(application).end(application, side)
            files |= {layout.link / name: text for name, text in end.files.items()}
    if application.spec.connectivity.sros2:
        files[layout.link / "policy.xml"] = policy(application)
    return {path: text.encode() for path, text in files.items()}


def robot_launch(application: Application, layout: Layout) -> bytes | None:
    """Return the robot's launch file with its nodes and its end of the link; None if there is neither."""
    link, spec = link_of(application), application.spec
    if not spec.robot and link.protocol is None:
        return None
    environment = link.end(application, "robot").environment
    words = _words(application, layout, spec.robot)
    activated = names_to_activate(spec.robot)
    needed = {
        "ExecuteProcess": words["has_processes"] or link.protocol or activated,
        "OpaqueFunction": link.protocol,
        "SetEnvironmentVariable": environment,
    }
    text = render(
        "robot.launch.py.j2",
        **words,
        link=link.protocol is not None,
        environment=environment,
        activated=[word for name in activated for word in ("--of", name)],
        together=False,
        actions=[name for name, wanted in needed.items() if wanted],
        spec_folder=Path(os.path.relpath(layout.spec.parent, layout.compiled)).as_posix(),
        agent=Path(os.path.relpath(layout.agent, layout.compiled)).as_posix(),
    )
    return text.encode()


def link_script(application: Application, layout: Layout) -> str:
    """Return the script that makes keys, imports the peer's public key and runs the link, identical at both ends."""
    name = application.name
    return render(
        "link.sh.j2",
        kind=link_of(application).name,
        packages=packages(application),
        name=name,
        source=layout.relative(layout.spec),
        port=port_of(application),
        common_name={side: common_name(name, side) for side in SIDES},
        interface={side: interface(name, side) for side in SIDES},
    )


def packages(application: Application) -> list[str]:
    """Return the Ubuntu packages that the link is made of."""
    distro = application.spec.ros.distro if application.spec.ros else ""
    return [name.replace("DISTRO", distro) for name in link_of(application).packages]


def link_of_machine(application: Application) -> dict[str, Any] | None:
    """Return the template values for the cloud end of the link; None without a link."""
    link = link_of(application)
    return None if link.protocol is None else {"environment": dict(link.end(application, "cloud").environment)}


def _words(application: Application, layout: Layout, nodes: Sequence[Node], logged: bool = False) -> dict[str, Any]:
    """Return the template values for nodes; with `logged` launch names them as `fogspec logs --node` does."""
    # Launch's own name of a ROS node without a name is its executable.
    labels = [label(node) if node.name or node.cmd else None for node in nodes if logged]
    return {
        "source": layout.relative(layout.spec),
        "name": application.name,
        **launch_source.words(nodes, labels),
    }
