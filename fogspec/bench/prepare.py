"""The inputs of a campaign, all checked: the plan, its tasks, and existing results."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from fogspec.base import digest
from fogspec.base.clouds import LOCAL
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import OutOfDate, UsageError
from fogspec.base.layout import Layout
from fogspec.base.text import shell_command
from fogspec.bench.spending import spending
from fogspec.bench.types import SampleTask
from fogspec.catalog.filters import field_against
from fogspec.catalog.machine import Machine
from fogspec.check.audit import sample_changes
from fogspec.compile.agent_archive import agent_archive
from fogspec.compile.inputs import Inputs
from fogspec.compile.plan_files import references, scripts, task_file
from fogspec.compile.tasks import sample_work
from fogspec.language.fingerprints import differing_rows, measured_record
from fogspec.language.loader import SourceFile
from fogspec.language.lockfile import pinned, some
from fogspec.language.schema import Application
from fogspec.plan.reuse import settings_changed
from fogspec.plan.schema import Plan, Sample, replicate, sample_id
from fogspec.results.io import read_results
from fogspec.results.schema import Results, completed, free_failures, other_machines
from fogspec.results.standing import Standing, standing


@dataclass(frozen=True, slots=True, kw_only=True)
class Prepared:
    """The samples to measure, `todo`, with their reviewed tasks.

    `results` are those that still count; `outdated` tells that the file on disk measured something else, `standing` what
    changed since; `only`
    that the user named the samples. `not_admitted` are sentences on samples of the plan that the spec does not admit,
    which are not measured. `read` are the results as they were on disk. `spent_usd` is the cost of measuring the
    application so far by runner, also before it changed.
    """

    application: Application
    layout: Layout
    plan: Plan
    plan_digest: str
    tasks: Mapping[str, SampleTask]
    results: Results | None
    outdated: bool
    only: bool
    todo: tuple[Sample, ...]
    not_admitted: tuple[str, ...] = ()
    read: Results | None = None
    spent_usd: Mapping[str, float] = field(default_factory=dict)
    standing: Standing = field(default_factory=Standing)

    def measuring(self, sample: Sample, inputs: Inputs) -> "Prepared":
        """Return what measures this sample alone, which may be one that the plan does not have."""
        tasks, exact = dict(self.tasks), pinned(self.application, inputs.pins)
        if sample.id not in tasks:
            sent = {**inputs.agent, **scripts(exact, self.plan, self.layout)}
            tasks[sample.id] = sample_task(exact, self.plan, sample, self.layout, sent)
        return replace(self, todo=(sample,), tasks=tasks, only=True)

    def check_current(self) -> None:
        """Raise OutOfDate if another bench has measured since this was prepared: its samples must not be lost."""
        if read_results(self.layout) != self.read:
            raise OutOfDate(f"{self.layout.results} has changed since this bench began", "run the bench again")


def prepare(inputs: Inputs, only: Sequence[str]) -> Prepared:
    """Check everything that a benchmark of this application relies on.

    `only` names samples to measure, even if they are measured; without it, all that are not measured yet. Raise OutOfDate for
    a missing or stale plan or an edited task, DiagnosticError for a file that cannot be read, UsageError for a sample
    that the plan does not have.
    """
    application, layout, pins = inputs.application, inputs.layout, inputs.pins
    again = shell_command("fogspec", "compile", layout.spec)
    if inputs.damaged is not None:
        raise inputs.damaged
    plan_file = inputs.on_disk.get(layout.plan)
    if plan_file is None:
        raise OutOfDate(f"{layout.name} has no plan yet: {layout.plan} is missing", again)
    plan = plan_file.document(Plan)
    record = measured_record(application, pins, inputs.sent)
    if changed := differing_rows(plan.spec.inputs, record):
        raise OutOfDate(f"{layout.plan} is stale: {some(changed)} changed since it was compiled", again)
    agent = inputs.content(layout.agent)
    if agent is None:
        raise OutOfDate(f"{layout.agent}: is missing, or cannot be read", again)
    if agent != agent_archive():
        raise OutOfDate(f"{layout.agent} is not the agent of this version of fogspec", again)
    _check_plan(application, plan, layout, again)
    if samples := sample_changes(inputs, plan):
        raise OutOfDate(f"{layout.plan} is stale: {'; '.join(samples)}", again)
    exact = pinned(application, pins)
    sent = {**inputs.agent, **_scripts(exact, plan, inputs, again)}
    tasks = {sample.id: _task(exact, plan, inputs, sample, sent, again) for sample in plan.spec.samples}
    results = inputs.results
    found = None if results is None else standing(results, record, application.spec.benchmark.waivers)
    outdated = found is not None and not found.counts
    counting = None if outdated else results
    if counting is not None and (names := other_machines(plan, counting)):
        raise OutOfDate(f"{layout.plan}: {some(names)}: another machine was measured under that name", again)
    wanted = _todo(plan, counting, only)
    against = {one.id: field for one in wanted if (field := against_spec(application, one.machine)) is not None}
    return Prepared(
        application=application,
        layout=layout,
        plan=plan,
        plan_digest=digest.of_bytes(plan_file.content),
        tasks=tasks,
        results=counting,
        outdated=outdated,
        standing=found or Standing(),
        only=bool(only),
        todo=tuple(one for one in wanted if one.id not in against),
        not_admitted=tuple(
            f"{name} is not measured: spec.{field} does not admit it" for name, field in against.items()
        ),
        read=results,
        spent_usd=spending(layout, results),
    )


def _check_plan(application: Application, plan: Plan, layout: Layout, again: str) -> None:
    """Raise OutOfDate if the plan measures otherwise than the spec says, or calls a sample by another machine's name."""
    edited = settings_changed(application, plan)
    edited += [f"samples: {one.id}" for one in plan.spec.samples if not _names(one)]
    if plan.metadata.name != layout.name or edited:
        raise OutOfDate(
            f"{layout.plan} is not what the spec compiles to: {', '.join(edited) or 'metadata.name'}", again
        )


def _names(one: Sample) -> bool:
    """Return whether the id of a sample is one that its machine has."""
    return one.id in {sample_id(one.machine, replicate(one.id), apart=apart) for apart in (False, True)}


def _scripts(application: Application, plan: Plan, inputs: Inputs, again: str) -> dict[Path, bytes]:
    """Return the scripts that the plan compiles to; raise OutOfDate if those on disk or their digests are others."""
    layout, found = inputs.layout, scripts(application, plan, inputs.layout)
    for path, compiled in found.items():
        content = inputs.content(path)
        if content is None:
            raise OutOfDate(f"{path}: is missing, or cannot be read", again)
        if content != compiled:
            changed = _first_line(content, compiled)
            raise OutOfDate(
                f"{path} is not what {layout.spec} compiles to: line {changed}", "what is reviewed is what runs", again
            )
    if plan.spec.scripts != references(layout, found):
        raise OutOfDate(f"{layout.plan}: spec.scripts are not the scripts as they are compiled", again)
    return found


def _first_line(content: bytes, compiled: bytes) -> int:
    """Return the number of the first line that differs."""
    pairs = itertools.zip_longest(content.split(b"\n"), compiled.split(b"\n"))
    return next(number for number, (one, other) in enumerate(pairs, 1) if one != other)


def _task(
    application: Application, plan: Plan, inputs: Inputs, sample: Sample, sent: Mapping[Path, bytes], again: str
) -> SampleTask:
    """Return what the sample compiles to; raise OutOfDate, naming the key, if the task on disk is another."""
    layout = inputs.layout
    if sample.machine.is_local:
        return sample_task(application, plan, sample, layout, sent)
    path, compiled = layout.task(sample.id), task_file(application, plan, sample, layout)
    content, task = inputs.content(path), read_task(compiled)
    if content is None:
        raise OutOfDate(f"{path}: is missing, or cannot be read", again)
    if content != compiled:
        key = _first_difference(SourceFile(path, content), task)
        raise OutOfDate(f"{path} is not what {layout.spec} compiles to: {key}", "what is reviewed is what runs", again)
    if sample.task != digest.of_bytes(compiled):
        raise OutOfDate(f"{layout.plan}: samples: {sample.id}: task is not {path} as it is compiled", again)
    return SampleTask(sample_work(application, sample, layout, sent), task)


def sample_task(
    application: Application, plan: Plan, sample: Sample, layout: Layout, sent: Mapping[Path, bytes]
) -> SampleTask:
    """Return what a sample compiles to, on this host without a task; `sent` are the files that it is sent, by path."""
    local = sample.machine.is_local
    task = {} if local else read_task(task_file(application, plan, sample, layout))
    return SampleTask(sample_work(application, sample, layout, sent), task)


def _first_difference(file: SourceFile, compiled: Mapping[str, Any]) -> str:
    """Return the first key that differs, or that it is damaged."""
    try:
        found = file.plain()
    except DiagnosticError as damaged:
        return damaged.diagnostics[0].message
    return next(_differences(found, compiled), "its comments or layout differ")


def _differences(found: Any, wanted: Any, at: str = "") -> Iterator[str]:
    if isinstance(found, Mapping) and isinstance(wanted, Mapping):
        for key in [*wanted, *(key for key in found if key not in wanted)]:
            yield from _differences(found.get(key), wanted.get(key), f"{at}.{key}" if at else str(key))
    elif found != wanted:
        how = "is missing" if found is None else "was added" if wanted is None else "differs"
        yield f"{at} {how}" if at else "it is not a task"


def read_task(content: bytes) -> Mapping[str, Any]:
    """Return the parsed task."""
    from ruamel.yaml import YAML

    task: Mapping[str, Any] = YAML(typ="safe", pure=True).load(content)
    return task


def against_spec(application: Application, machine: Machine) -> str | None:
    """Return the field of the spec that does not admit a machine of the plan, however it came there; None without one."""
    spec = application.spec
    if listed := spec.benchmark.machines:
        name = f"{LOCAL}/{machine.instance}" if machine.is_local else machine.instance
        if name not in listed or machine.is_local:
            return None if name in listed else "benchmark.machines"
    return field_against(machine, spec.hardware, spec.infra)


def _todo(plan: Plan, results: Results | None, only: Sequence[str]) -> list[Sample]:
    known = {sample.id: sample for sample in plan.spec.samples}
    if unknown := [name for name in only if name not in known]:
        raise UsageError(f"the plan has no sample {', '.join(unknown)}", f"samples: {', '.join(known)}")
    if only:
        return [known[name] for name in dict.fromkeys(only)]
    measured = completed(results) - free_failures(results)
    return [sample for sample in plan.spec.samples if sample.id not in measured]
