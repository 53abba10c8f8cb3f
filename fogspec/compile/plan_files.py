"""Make the files of a plan: the plan, the task of each sample, and the tasks of substitutes that were used."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fogspec.base import digest, units
from fogspec.base.layout import Layout
from fogspec.base.templates import render
from fogspec.base.text import shell_command
from fogspec.base.yaml.writer import yaml_text
from fogspec.catalog.filters import Filtered
from fogspec.compile.tasks import left_out, measured_processes, ros_environment, sample_task
from fogspec.plan.commitment import PART_S
from fogspec.plan.schema import Part, Plan, Sample, TaskRef
from fogspec.plan.substitutes import substitutes
from fogspec.results.schema import Results
from fogspec.spec.probe import name_of, probe_parts
from fogspec.spec.schema import Application


def with_substitutes(application: Application, plan: Plan, admissible: Filtered) -> Plan:
    """Return the plan with substitutes for unavailable machines."""
    others = substitutes(application.spec, plan.spec.samples, admissible.offers)
    return plan.model_copy(update={"spec": plan.spec.model_copy(update={"substitutes": others})})


def with_tasks(application: Application, plan: Plan, layout: Layout) -> tuple[Plan, dict[Path, bytes]]:
    """Return the plan with a reference to each sample's task, and these tasks by path."""
    files: dict[Path, bytes] = {}
    samples = []
    for sample in plan.spec.samples:
        path = layout.task(sample.id)
        files[path] = task_file(application, plan, sample, layout)
        reference = TaskRef(path=path.relative_to(layout.compiled).as_posix(), digest=digest.of_bytes(files[path]))
        samples.append(sample.model_copy(update={"task": reference}))
    omitted = dict.fromkeys(note for sample in samples for note in left_out(application.spec, sample.machine))
    notes = [*plan.spec.notes, *(note for note in omitted if note not in plan.spec.notes)]
    body = plan.spec.model_copy(update={"samples": samples, "notes": notes})
    return plan.model_copy(update={"spec": body}), files


def substitute_tasks(
    application: Application, plan: Plan, layout: Layout, results: Results | None
) -> dict[Path, bytes]:
    """Return the tasks of the substitutes that were measured, by path."""
    planned = {sample.id for sample in plan.spec.samples}
    records = results.spec.samples if results is not None else []
    took = [Sample(id=one.id, machine=one.machine, reason="") for one in records if one.substitute_for in planned]
    return {layout.task(one.id): task_file(application, plan, one, layout) for one in took if one.id not in planned}


def plan_file(plan: Plan, layout: Layout) -> bytes:
    """Return the content of the plan file."""
    return _yaml(plan.model_dump(mode="json"), layout)


def task_file(application: Application, plan: Plan, sample: Sample, layout: Layout) -> bytes:
    """Return the content of a sample's task file."""
    return _yaml(sample_task_of(application, plan, sample, layout), layout)


def sample_task_of(application: Application, plan: Plan, sample: Sample, layout: Layout) -> dict[str, Any]:
    """Return the task of one sample."""
    body = plan.spec
    ros = ros_environment(application.spec)
    secrets = [word for name in application.spec.secrets for word in ("--secret", name)]
    run = render(
        "run_sample.sh.j2",
        **ros,
        limits=[
            *_limits(application, plan, sample),
            *(["--part-limit", f"{PART_S:g}"] if sample.parts else []),
            *secrets,
        ],
        parts=[_part(one) for one in sample.parts],
        lifetime_s=body.commitment.lifetime_s,
        processes=measured_processes(application.spec),
    )
    return sample_task(
        application,
        sample,
        body.commitment,
        workdir=layout.relative(layout.spec.parent),
        agent=layout.relative(layout.agent),
        setup=_setup_script(ros),
        run=run,
    )


def _part(one: Part) -> str:
    """Return a part as the agent takes it: its name, vCPUs and bytes of memory."""
    return f"{one.part}:{int(one.machine.cpus)}:{int(one.machine.memory * 2**30)}"


def _setup_script(ros: Mapping[str, Any]) -> str | None:
    """Return the script that installs ROS 2 and builds the workspace; None for plain processes."""
    return None if ros["distro"] is None else render("setup_ros2.sh.j2", **ros)


def _limits(application: Application, plan: Plan, sample: Sample) -> list[str]:
    """Return the arguments of the agent that define its stopping rule."""
    body, stop = plan.spec, application.spec.benchmark.stop
    words = ["--after", units.format_number(body.duration), "--warmup", str(body.warmup)]
    words += ["--startup", units.format_number(body.setup_timeout)]
    if body.requests is not None:
        words += ["--steps", str(body.requests)]
    words += ["--callback", name_of(application.spec.probe)]
    if (afterwards := probe_parts(application.spec).afterwards) is not None:
        words += ["--afterwards", json.dumps(afterwards)]
    if stop.precision is not None:
        words += ["--precision", units.format_number(stop.precision)]
    if sample.decided_above is not None:
        words += ["--decided-above", units.format_number(sample.decided_above)]
    if stop.precision is not None or sample.decided_above is not None:
        words += ["--statistic", application.spec.constraints.statistic]
    return words


def _yaml(data: Mapping[str, Any], layout: Layout) -> bytes:
    source = layout.relative(layout.spec)
    return yaml_text(data, shell_command("fogspec", "compile", source), source).encode()
