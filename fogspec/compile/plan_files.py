"""Make the files of a plan: the plan, the scripts that its machines run, and the task of each sample."""

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from fogspec.base import digest, units
from fogspec.base.layout import Layout
from fogspec.base.quantities import Strict
from fogspec.base.templates import render
from fogspec.base.text import shell_command
from fogspec.base.yaml.writer import yaml_text
from fogspec.compile.tasks import (
    asks,
    left_out,
    measured_processes,
    ros_environment,
    sample_comment,
    sample_task,
    sample_work,
)
from fogspec.language.probe import absolute, name_of, probe_parts
from fogspec.language.schema import Application, Spec
from fogspec.plan.schema import Plan, Sample, TaskRef

HEARD_BY = 20  # valid requests, in which each metric should have a value
EXPECTED = 5  # requests of a scenario, so many that none of them is no chance


def with_tasks(application: Application, plan: Plan, layout: Layout) -> tuple[Plan, dict[Path, bytes]]:
    """Return the plan with a reference to each script and the digest of each sample's task, and these files by path.

    A sample on this host has no task: it needs only the scripts.
    """
    files = scripts(application, plan, layout)
    pinned = references(layout, files)
    samples = []
    for sample in plan.spec.samples:
        if sample.machine.is_local:
            samples.append(sample)
            continue
        path = layout.task(sample.id)
        files[path] = task_file(application, plan, sample, layout)
        samples.append(sample.model_copy(update={"task": digest.of_bytes(files[path])}))
    notes = list(plan.spec.notes)
    for sample in samples:
        notes += [note for note in left_out(application.spec, sample.machine) if note not in notes]
    body = plan.spec.model_copy(update={"scripts": pinned, "samples": samples, "notes": notes})
    return plan.model_copy(update={"spec": body}), files


def plan_file(plan: Plan, layout: Layout) -> bytes:
    """Return the content of the plan file."""
    return document_file(plan, layout)


def scripts(application: Application, plan: Plan, layout: Layout) -> dict[Path, bytes]:
    """Return the scripts of the plan by path: one measures, and one sets up ROS 2 where there is any."""
    ros = ros_environment(application.spec)
    measure = render(
        "measure.sh.j2",
        **ros,
        source=layout.relative(layout.spec),
        limits=_limits(application, plan),
        lifetime_s=plan.spec.commitment.lifetime_s,
        processes=measured_processes(application.spec),
    )
    return {**setup_script(application, layout), layout.measure_script: measure.encode()}


def setup_script(application: Application, layout: Layout) -> dict[Path, bytes]:
    """Return the script that installs ROS 2 and builds the workspace, by its path; none for plain processes."""
    if application.spec.ros is None:
        return {}
    text = render("setup.sh.j2", **ros_environment(application.spec), source=layout.relative(layout.spec))
    return {layout.setup_script: text.encode()}


def task_file(application: Application, plan: Plan, sample: Sample, layout: Layout) -> bytes:
    """Return the content of a sample's task file."""
    work = sample_work(application, sample, layout, {})
    task = sample_task(application, sample, plan.spec.commitment, work)
    return yaml_file(task, layout, sample_comment(sample, plan.spec.commitment))


def references(layout: Layout, files: Mapping[Path, bytes]) -> list[TaskRef]:
    """Return a reference to each file, relative to the plan."""
    return [
        TaskRef(path=path.relative_to(layout.planned).as_posix(), digest=digest.of_bytes(content))
        for path, content in files.items()
    ]


def _limits(application: Application, plan: Plan) -> list[str]:
    """Return the arguments of the agent that define its stopping rule and its secrets."""
    body, stop = plan.spec, application.spec.benchmark.stop
    words = ["--after", units.format_number(body.duration), "--warmup", str(body.warmup)]
    words += ["--startup", units.format_number(body.ready_timeout)]
    if body.requests is not None:
        words += ["--steps", str(body.requests)]
    words += ["--callback", name_of(application.spec.probe)]
    words += _expected(application.spec)
    client = application.spec.benchmark.workload.node
    if (asking := asks([*application.spec.cloud, *([client] if client else [])])) is not None:
        words += ["--asks", json.dumps(asking)]
    if (afterwards := probe_parts(application.spec).afterwards) is not None:
        words += ["--afterwards", json.dumps(afterwards)]
    if stop.precision is not None:
        words += ["--precision", units.format_number(stop.precision)]
    words += ["--statistic", application.spec.constraints.statistic]
    if scenarios := application.spec.benchmark.scenarios:
        words += ["--weights", json.dumps(scenarios, sort_keys=True)]
    return [*words, *(word for name in application.spec.secrets for word in ("--secret", name))]


def _expected(spec: Spec) -> Iterator[str]:
    """Yield the arguments that name what requests report, and in how many valid ones it must have been heard."""
    for name, metric in sorted(spec.metrics.items()):
        if metric.callback is None:  # the listener on a topic may be slow: only time tells
            yield from ("--expect", name, f"value of metric {name} on {absolute(str(metric.topic))}", "inf")
        else:
            called = "" if metric.callback == name else f" as {metric.callback}"
            yield from ("--expect", metric.callback, f"value of metric {name}{called}", str(HEARD_BY))
    for name, weight in sorted((weights := spec.benchmark.scenarios).items()):
        least = max(HEARD_BY, math.ceil(EXPECTED * sum(weights.values()) / weight))
        yield from ("--expect", f"scenario {name}", f"request of scenario {name}", str(least))


def document_file(document: Strict, layout: Layout) -> bytes:
    """Return the content of the file of a document: its kind, and of all else what has not its default."""
    kind = {name: getattr(document, name) for name in ("apiVersion", "kind")}
    return yaml_file(kind | document.model_dump(mode="json", exclude_defaults=True), layout)


def yaml_file(data: Mapping[str, Any], layout: Layout, about: str | None = None) -> bytes:
    """Return the content of a compiled file, with `about` as a comment on it."""
    return yaml_text(data, shell_command("fogspec", "compile", layout.relative(layout.spec)), about).encode()
