"""Make the files of a deployment: tasks for the chosen machine and its fallbacks, and files for robot and machine.

The manifest pins all of them by digest, so that only approved files are deployed.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fogspec.base import digest
from fogspec.base.layout import Layout
from fogspec.base.templates import render
from fogspec.base.text import shell_command
from fogspec.base.yaml.writer import yaml_text
from fogspec.choice.choose import Choice
from fogspec.choice.shortlist import fallback_rows
from fogspec.compile.launch_files import launch_files, link_of_machine, robot_launch
from fogspec.compile.links import link_of
from fogspec.compile.tasks import deploy_task, deployed_processes, has_end, launched_together, listener, ros_environment
from fogspec.plan.schema import TaskRef
from fogspec.spec.schema import Application


@dataclass(frozen=True, slots=True)
class Deployable:
    """References to the files of a deployment, relative to the manifest; `fallbacks` by the rows of their machines."""

    task: TaskRef
    robot_launch: TaskRef | None
    robot_environment: Mapping[str, str]
    files: list[TaskRef]
    fallbacks: Mapping[int, TaskRef]


def deployable(
    application: Application,
    layout: Layout,
    choice: Choice,
    *,
    chosen: int,
    sent: Mapping[Path, bytes],
    files: dict[Path, bytes],
) -> Deployable:
    """Add the files that deploy the machine in row `chosen` to `files`; `sent` are copied to every machine."""
    files[layout.deploy] = _task(application, layout, choice, chosen)
    rows = fallback_rows(choice, application.spec.deployment.fallbacks)
    for number, row in enumerate(rows, 1):
        files[layout.fallback(number)] = _task(application, layout, choice, row)
    sent = {**sent, **launch_files(application, layout)}
    files |= sent
    robot, text = None, robot_launch(application, layout)
    if text is not None:
        files[layout.robot] = text
        robot = reference(layout, layout.robot, text)
    return Deployable(
        task=reference(layout, layout.deploy, files[layout.deploy]),
        robot_launch=robot,
        robot_environment=link_of(application).end(application, "robot").environment,
        files=[reference(layout, path, content) for path, content in sorted(sent.items())],
        fallbacks={
            row: reference(layout, layout.fallback(number), files[layout.fallback(number)])
            for number, row in enumerate(rows, 1)
        },
    )


def reference(layout: Layout, path: Path, content: bytes) -> TaskRef:
    """Return a reference to a file, relative to the manifest."""
    return TaskRef(path=layout.beside_manifest(path), digest=digest.of_bytes(content))


def _task(application: Application, layout: Layout, choice: Choice, row: int) -> bytes:
    spec = application.spec
    ros: dict[str, Any] = ros_environment(spec)
    link = link_of_machine(application)
    run = render(
        "run_deploy.sh.j2",
        **ros,
        processes=deployed_processes(application),
        listeners=listener(spec),
        link=link,
        ready=spec.deployment.ready,
        ends=has_end(spec),
    )
    parts = [] if ros["distro"] is None else [render("setup_ros2.sh.j2", **ros)]
    parts += [render("setup_link.sh.j2", **link)] if link else []
    task = deploy_task(
        application,
        choice.offers.machine(row),
        workdir=layout.relative(layout.spec.parent),
        agent=layout.relative(layout.agent),
        setup="\n".join(parts) or None,
        run=run,
        launch=layout.relative(layout.cloud) if spec.ros and launched_together(spec) else None,
        link=layout.relative(layout.link) if link else None,
    )
    again = shell_command("fogspec", "compile", layout.relative(layout.spec))
    return yaml_text(task, again, layout.source).encode()
