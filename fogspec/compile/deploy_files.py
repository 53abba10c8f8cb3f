"""Make the files of a deployment: tasks for the chosen machine and its fallbacks, and files for robot and machine.

The manifest pins all of them by digest, so that only approved files are deployed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from fogspec.base import digest
from fogspec.base.layout import Layout
from fogspec.base.templates import render
from fogspec.catalog.machine import Machine
from fogspec.choice.choose import Choice
from fogspec.choice.shortlist import fallback_rows
from fogspec.compile.launch_files import launch_files, link_of_machine, robot_launch
from fogspec.compile.links import link_of
from fogspec.compile.plan_files import setup_script, yaml_file
from fogspec.compile.tasks import (
    asks,
    deploy_comment,
    deploy_task,
    deploy_work,
    deployed_processes,
    has_end,
    listener,
    ros_environment,
)
from fogspec.language.schema import Application
from fogspec.plan.schema import TaskRef


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
    rows = fallback_rows(choice, application.spec.deployment.fallbacks)
    files |= deployment_files(application, layout, [choice.offers.machine(row) for row in (chosen, *rows)], sent)
    robot = reference(layout, layout.robot, files[layout.robot]) if layout.robot in files else None
    return Deployable(
        task=reference(layout, layout.deploy, files[layout.deploy]),
        robot_launch=robot,
        robot_environment=link_of(application).end(application, "robot").environment,
        files=[reference(layout, path, content) for path, content in sorted(_sent(application, layout, sent).items())],
        fallbacks={
            row: reference(layout, layout.fallback(number), files[layout.fallback(number)])
            for number, row in enumerate(rows, 1)
        },
    )


def deployment_files(
    application: Application, layout: Layout, machines: Sequence[Machine], sent: Mapping[Path, bytes]
) -> dict[Path, bytes]:
    """Return all files that deploy the first of these machines, and the tasks of the others, its fallbacks."""
    files = {}
    for number, machine in enumerate(machines):
        path, reason = (layout.fallback(number), f"fallback {number}") if number else (layout.deploy, "the choice")
        files[path] = _task(application, layout, machine, reason)
    files |= _sent(application, layout, sent)
    text = robot_launch(application, layout)
    return files if text is None else {**files, layout.robot: text}


def reference(layout: Layout, path: Path, content: bytes) -> TaskRef:
    """Return a reference to a file, relative to the manifest."""
    return TaskRef(path=layout.beside_manifest(path), digest=digest.of_bytes(content))


def _sent(application: Application, layout: Layout, sent: Mapping[Path, bytes]) -> dict[Path, bytes]:
    return {**sent, **_scripts(application, layout), **launch_files(application, layout)}


def _scripts(application: Application, layout: Layout) -> dict[Path, bytes]:
    """Return the scripts that the machine runs, by path."""
    spec = application.spec
    text = render(
        "deploy.sh.j2",
        **ros_environment(spec),
        source=layout.relative(layout.spec),
        processes=deployed_processes(application),
        listeners=listener(spec),
        asks=asks(spec.cloud),
        link=link_of_machine(application),
        ready=spec.deployment.ready,
        ends=has_end(spec),
    )
    return {**setup_script(application, layout), layout.deploy_script: text.encode()}


def _task(application: Application, layout: Layout, machine: Machine, reason: str) -> bytes:
    task = deploy_task(application, machine, deploy_work(application, layout))
    return yaml_file(task, layout, deploy_comment(application.spec, machine, reason))
