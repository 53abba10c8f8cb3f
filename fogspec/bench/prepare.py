"""The inputs of a campaign, all checked: the plan, its tasks, and existing results."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fogspec.base import digest
from fogspec.base.clouds import LOCAL
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import OutOfDate, UsageError
from fogspec.base.layout import Layout
from fogspec.base.text import shell_command
from fogspec.bench.spending import spending
from fogspec.catalog.filters import field_against
from fogspec.catalog.machine import Machine
from fogspec.compile.agent_archive import agent_archive
from fogspec.compile.plan_files import task_file
from fogspec.plan.schema import Plan, Sample, replicate, sample_id
from fogspec.results.io import read_results
from fogspec.results.schema import Results, completed
from fogspec.results.standing import Standing, standing
from fogspec.spec import fingerprints
from fogspec.spec.loader import SourceFile
from fogspec.spec.lock_io import files_sent, lock_drift, read_pins
from fogspec.spec.lockfile import pinned, pins_of_measurement, some
from fogspec.spec.schema import Application


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
    tasks: Mapping[str, Mapping[str, Any]]
    results: Results | None
    outdated: bool
    only: bool
    todo: tuple[Sample, ...]
    not_admitted: tuple[str, ...] = ()
    read: Results | None = None
    spent_usd: Mapping[str, float] = field(default_factory=dict)
    standing: Standing = field(default_factory=Standing)

    def check_current(self) -> None:
        """Raise OutOfDate if another bench has measured since this was prepared: its samples must not be lost."""
        if read_results(self.layout) != self.read:
            raise OutOfDate(f"{self.layout.results} has changed since this bench began", "run the bench again")


def prepare(
    application: Application,
    spec_path: str | Path,
    only: Sequence[str],
    known: dict[Path, SourceFile] | None = None,
) -> Prepared:
    """Check everything that a benchmark of this application relies on.

    `only` names samples to measure, even if they are measured; without it, all that are not measured yet. `known` holds
    files that applications share, so that each is read once; what is read is added to it. Raise OutOfDate for
    a missing or stale plan or an edited task, DiagnosticError for a file that cannot be read, UsageError for a sample
    that the plan does not have.
    """
    layout = Layout.of(spec_path, application.metadata.name)
    again = shell_command("fogspec", "compile", layout.spec)
    if not layout.files.exists(layout.plan):
        raise OutOfDate(f"{layout.name} has no plan yet", again)
    plan_file = SourceFile.read(layout.plan, layout.files)
    plan = plan_file.document(Plan)
    if plan.spec.application.digest != fingerprints.planned_digest(application):
        raise OutOfDate(f"{layout.plan} is stale: {_changed(application, plan)} changed since it was compiled", again)
    pins = read_pins(layout)
    if drifted := lock_drift(pins, files_sent(application, layout) if pins else {}):
        lock = shell_command("fogspec", "lock", layout.spec)
        raise OutOfDate(f"{some(drifted)}: not what {layout.lock} pins", lock, again)
    if plan.spec.pins != pins_of_measurement(application, pins):
        raise OutOfDate(f"{layout.plan} is stale: {layout.lock} changed since it was compiled", again)
    _check_agent(layout, again, {} if known is None else known)
    _check_plan(application, plan, layout, again)
    exact = pinned(application, pins)
    tasks = {sample.id: _task(exact, plan, layout, sample, again) for sample in plan.spec.samples}
    results = read_results(layout)
    found = None if results is None else standing(results, application, plan.spec.pins)
    outdated = found is not None and not found.counts
    counting = None if outdated else results
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


def _changed(application: Application, plan: Plan) -> str:
    now = fingerprints.measured_fields(application)
    fields = [name for name, value in now.items() if plan.spec.application.field_digests.get(name) != value]
    return f"spec's {', '.join(fields)}" if fields else "hardware, infra or how machines are sampled"


def _check_agent(layout: Layout, again: str, known: dict[Path, SourceFile]) -> None:
    """Raise OutOfDate unless the agent on disk is this version's: a diff does not show its content."""
    if layout.agent not in known:
        known[layout.agent] = SourceFile.read(layout.agent, layout.files)
    file = known[layout.agent]
    if file.problem is not None:
        raise OutOfDate(f"{layout.agent}: cannot be read: {file.problem.strerror}", again)
    if file.content != agent_archive():
        raise OutOfDate(f"{layout.agent} is not the agent of this version of fogspec", again)


def _check_plan(application: Application, plan: Plan, layout: Layout, again: str) -> None:
    """Raise OutOfDate if the plan measures otherwise than the spec says, or calls a sample by another machine's name."""
    body, benchmark = plan.spec, application.spec.benchmark
    wanted = {
        "requests": benchmark.stop.requests,
        "duration": benchmark.stop.duration,
        "warmup": benchmark.warmup,
        "setup_timeout": benchmark.setup_timeout,
        "sampler": "list" if benchmark.machines else benchmark.sampler,
    }
    edited = [name for name, value in wanted.items() if getattr(body, name) != value]
    edited += [f"samples: {one.id}" for one in body.samples if one.id != sample_id(one.machine, replicate(one.id))]
    if plan.metadata.name != layout.name or edited:
        raise OutOfDate(
            f"{layout.plan} is not what the spec compiles to: {', '.join(edited) or 'metadata.name'}", again
        )


def _task(application: Application, plan: Plan, layout: Layout, sample: Sample, again: str) -> Mapping[str, Any]:
    """Return the task that the sample compiles to; raise OutOfDate, naming the key, if the one on disk is another."""
    path, compiled = layout.task(sample.id), task_file(application, plan, sample, layout)
    try:
        content = layout.files.read(path)
    except OSError as problem:
        raise OutOfDate(f"{path}: cannot be read: {problem.strerror}", again) from None
    task = read_task(compiled)
    if content != compiled:
        key = _first_difference(SourceFile(path, content), task)
        raise OutOfDate(f"{path} is not what {layout.spec} compiles to: {key}", "what is reviewed is what runs", again)
    if sample.task is None or (layout.compiled / sample.task.path, sample.task.digest) != (
        path,
        digest.of_bytes(compiled),
    ):
        raise OutOfDate(f"{layout.plan}: samples: {sample.id}: task is not {path} as it is compiled", again)
    return task


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
    field = field_against(machine, spec.hardware, spec.infra)
    # A listed machine may have any shape.
    return None if listed and field not in ("infra", "hardware.spot") else field


def _todo(plan: Plan, results: Results | None, only: Sequence[str]) -> list[Sample]:
    known = {sample.id: sample for sample in plan.spec.samples}
    if unknown := [name for name in only if name not in known]:
        raise UsageError(f"the plan has no sample {', '.join(unknown)}", f"samples: {', '.join(known)}")
    if only:
        return [known[name] for name in dict.fromkeys(only)]
    measured = completed(results)
    return [sample for sample in plan.spec.samples if sample.id not in measured]
