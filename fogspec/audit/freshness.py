"""Determine which stages of an application are fresh or stale, and why, without reading or writing files.

All commands use one rule: a stage is fresh if its files on disk are what compile would write now. The fields of the spec
that a stage reads are declared in the schema (`fogspec.spec.fingerprints`), so that other changes leave it fresh.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from fogspec.audit.compare import change_text, changes, changes_in_file
from fogspec.base.diagnostics import Diagnostic, DiagnosticError
from fogspec.base.errors import FogspecError
from fogspec.base.layout import Layout
from fogspec.base.text import count, shell_command
from fogspec.base.units import dollars
from fogspec.compile.artifacts import Artifacts
from fogspec.compile.compiler import try_compile
from fogspec.compile.damage import restorable
from fogspec.compile.inputs import Inputs
from fogspec.plan.schema import Plan, PlanBody, TaskRef
from fogspec.results.progress import unfinished
from fogspec.results.schema import completed
from fogspec.results.standing import change_text as change_since
from fogspec.spec import fingerprints
from fogspec.spec.lockfile import differing, listed
from fogspec.spec.schema import Application

State = Literal["fresh", "partial", "stale", "missing", "damaged"]
NAMED = 6
LOCKED = "{} is locked to something else"


@dataclass(frozen=True, slots=True)
class Stage:
    """A stage with its file, state and reasons; `notes` list changes that do not affect the state."""

    name: str
    path: Path
    state: State
    reasons: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """The state as a sentence: `results are stale`."""
        return f"{self.name} {'are' if self.name in ('results', 'models') else 'is'} {self.state}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Status:
    """All stages of an application.

    `refused` is the reason why nothing can be compiled; otherwise there are `artifacts`. `to_measure` counts the samples
    that are still to be measured. `differing` are the files that differ from what compile would write. `damaged` are the
    errors of results or of a lock that cannot be used, each with the command that restores them.
    """

    inputs: Inputs
    artifacts: Artifacts | None = None
    refused: str | None = None
    stages: tuple[Stage, ...] = ()
    differing: tuple[Path, ...] = ()
    to_measure: int | None = None
    damaged: tuple[Diagnostic, ...] = ()

    @property
    def layout(self) -> Layout:
        """The paths of the application's files."""
        return self.inputs.layout

    @property
    def spent_usd(self) -> float | None:
        """The amount spent on measuring so far, in USD; None if the results that say it are damaged."""
        if self.inputs.results is None:
            return None if self.inputs.results_file else 0.0
        return self.inputs.results.spec.spent

    @property
    def budget_usd(self) -> float | None:
        """The budget for measuring in USD; None without one."""
        return self.inputs.application.spec.benchmark.budget

    @property
    def current(self) -> bool:
        """True if the files on disk are what compile would write, and the files next to the spec match the lock."""
        return self.refused is None and not self.differing and not self.inputs.drifted

    @property
    def fresh(self) -> bool:
        """True if the files are current and every stage is, so that nothing is left to do before `apply`.

        Results of a part of the plan are enough for a manifest that says so (`compile --partial`).
        """
        return self.current and all(map(self.settled, self.stages))

    def settled(self, stage: Stage) -> bool:
        """Return whether nothing is left to do for a stage."""
        return stage.state == "fresh" or (stage.state == "partial" and self.partial is not None)

    @property
    def partial(self) -> str | None:
        """How much of the plan the manifest rests on, if that is not all of it; None without such a manifest."""
        decision = None if self.artifacts is None else self.artifacts.decision
        if decision is None or decision.manifest is None or decision.unfinished is None:
            return None
        return decision.unfinished.state


def look(inputs: Inputs, base: str | None = None) -> Status:
    """Return the status of an application, also of one whose results or lock are damaged; `base` may have them undamaged."""
    try:
        return status(inputs, try_compile(inputs))
    except DiagnosticError as problems:
        damaged = (problems if base is None else restorable(problems, inputs.layout, base)).diagnostics
        reasons = (*map(located, damaged), *dict.fromkeys(one.fix for one in damaged if one.fix is not None))
        path = Path(damaged[0].span.path)
        name = "lock" if path == inputs.layout.lock else "results"
        stage = Stage(name, path, "damaged", tuple(_some(reasons)))
        return Status(inputs=inputs, refused=f"{path} is damaged", stages=(stage,), damaged=damaged)


def located(one: Diagnostic) -> str:
    """Return what is wrong with a file, with its place."""
    return f"{one.span.path}:{one.span.line}:{one.span.column}: {one.message}"


def status(inputs: Inputs, compiled: Artifacts | FogspecError) -> Status:
    """Return the status of an application from its inputs and their compilation, or the error that refused it."""
    if isinstance(compiled, FogspecError):
        return Status(inputs=inputs, refused=compiled.message)
    differing = compiled.compare()
    measured = _results(compiled)
    left = len({sample.id for sample in compiled.plan.spec.samples} - completed(compiled.results))
    return Status(
        inputs=inputs,
        artifacts=compiled,
        stages=(_plan(compiled, differing), measured, *_derived(compiled, differing, measured)),
        differing=tuple(differing),
        to_measure=left,
    )


def stage_of(path: Path, layout: Layout) -> str:
    """Return the stage that writes a file."""
    if path in (layout.plan, layout.agent) or path.parent in (layout.tasks, layout.former_agent):
        return "plan"
    if path == layout.models:
        return "models"
    return "menu" if path in (layout.menu, layout.picture, layout.latencies, layout.metric_picture) else "manifest"


def _plan(compiled: Artifacts, differing: Sequence[Path]) -> Stage:
    inputs, path = compiled.inputs, compiled.layout.plan
    file = inputs.on_disk.get(path)
    if file is None:
        return Stage("plan", path, "missing", (shell_command("fogspec", "compile", inputs.layout.spec),))
    drifted = listed(inputs.drifted, "{} is not what the lock says", NAMED)
    mine = [one for one in differing if stage_of(one, inputs.layout) == "plan"]
    if not mine:
        return Stage("plan", path, "stale" if drifted else "fresh", tuple(drifted))
    try:
        was = file.document(Plan).spec
    except DiagnosticError as problems:
        return Stage("plan", path, "stale", (problems.diagnostics[0].message,))
    return Stage("plan", path, "stale", tuple(_plan_reasons(compiled, was, drifted) or _other_files(mine)[:NAMED]))


def _plan_reasons(compiled: Artifacts, was: PlanBody, drifted: Sequence[str]) -> list[str]:
    """Return why the plan on disk differs from a compiled one; reasons to measure again come first."""
    now, application = compiled.plan.spec, compiled.inputs.measured.application
    reasons = [*changed_reads(was.application.field_digests, application), *_changed_pins(was.pins, now.pins), *drifted]
    other_catalog = was.catalog.digest != now.catalog.digest
    if _samples(was, other_catalog) != _samples(now, other_catalog):
        before, after = was.model_dump(mode="json"), now.model_dump(mode="json")
        for name in ("hardware", "infra", "sampler", "requests", "duration", "warmup", "setup_timeout"):
            where = "spec." if name in ("hardware", "infra") else "spec.benchmark."
            reasons += map(change_text, changes(before[name], after[name], f"{where}{name}"))
        picked = "from the new catalog other machines are picked" if other_catalog else "it is not what compile writes"
        reasons = reasons or [picked]
    if other_catalog:
        before_usd, now_usd = dollars(was.estimate.total), dollars(now.estimate.total)
        reasons.append(
            "new catalog; the costs of measuring stay"
            if before_usd == now_usd
            else f"new catalog, re-estimated: at most {before_usd} before, {now_usd} now"
        )
    if was.budget != now.budget:
        reasons.append("spec.benchmark.budget changed, and is enough")
    if not reasons and (was.hardware, was.infra) != (application.spec.hardware, application.spec.infra):
        reasons.append("picked for a larger search box, which holds the spec's")
    return reasons


def _samples(body: PlanBody, other_catalog: bool) -> dict[str, TaskRef | None]:
    """Return the samples and their tasks; no tasks for another catalog, whose prices are no reason to measure again."""
    return {sample.id: None if other_catalog else sample.task for sample in body.samples}


def changed_reads(before: Mapping[str, str] | None, application: Application) -> list[str]:
    """Return the spec fields read by measuring that changed since these digests were computed."""
    now = fingerprints.measured_fields(application)
    changed = (name for name, value in now.items() if (before or {}).get(name) != value)
    return [f"{fingerprints.field_of_measured(name)} changed" for name in changed]


def _changed_pins(before: Mapping[str, str] | None, now: Mapping[str, str]) -> list[str]:
    return listed(differing(before or {}, now), LOCKED, NAMED)


def _results(compiled: Artifacts) -> Stage:
    inputs, path = compiled.inputs, compiled.layout.results
    if inputs.results is None:
        return Stage("results", path, "missing", (f"{count(len(compiled.plan.spec.samples), 'sample')} to measure",))
    if compiled.results is None:
        return Stage("results", path, "stale", tuple(_some(compiled.standing.reasons if compiled.standing else [])))
    if inputs.timings:
        return Stage("results", path, "stale", tuple(_some(inputs.timings)))
    body = compiled.results.spec
    unlocked = () if body.pins or not compiled.plan.spec.pins else ("measured before anything was locked",)
    waived = compiled.standing.waived if compiled.standing else ()
    unlocked = (*unlocked, *(f"waived: {change_since(one)}: {one.reason}" for one in waived), *unused_waivers(compiled))
    left = unfinished(inputs.measured.application, compiled.plan, compiled.results)
    if left is not None:
        return Stage("results", path, "partial", (f"{left.state}; {left.why}",), unlocked)
    return Stage("results", path, "fresh", (), unlocked)


def unused_waivers(compiled: Artifacts) -> list[str]:
    """Return a sentence for each waiver of the spec that no results need."""
    needed = compiled.standing.waived if compiled.standing else ()
    every = compiled.inputs.application.spec.benchmark.waivers
    return [f"spec.benchmark.waivers: {one.change} is not needed any more" for one in every if one not in needed]


def _some(reasons: Sequence[str]) -> list[str]:
    left = len(reasons) - NAMED
    return [*reasons[:NAMED], *([f"and {left} more"] if left > 0 else [])]


def _derived(compiled: Artifacts, differing: Sequence[Path], measured: Stage) -> Iterator[Stage]:
    """Yield the stages that depend on the results."""
    layout = compiled.layout
    paths = {"models": layout.models, "menu": layout.menu, "manifest": layout.manifest}
    for name, path in paths.items():
        infeasible = compiled.decision is not None and compiled.decision.choice.chosen is None
        if name != "manifest" or not infeasible or path in compiled.inputs.on_disk:
            mine = [one for one in differing if stage_of(one, layout) == name]
            yield _derived_stage(compiled, name, path, mine, measured)


def _derived_stage(compiled: Artifacts, name: str, path: Path, differing: Sequence[Path], measured: Stage) -> Stage:
    file, now = compiled.inputs.on_disk.get(path), compiled.files.get(path)
    why = () if measured.state == "fresh" else (f"results are {measured.state}",)
    if file is None:
        return Stage(name, path, "missing", why)
    if now is None:
        return Stage(name, path, "stale", why or ("it no longer follows from the results",))
    if not differing:
        return Stage(name, path, "fresh", (), why)
    reasons = _other_files([one for one in differing if one != path])[:NAMED]
    if path in differing:
        changed = list(map(change_text, changes_in_file(file, now)))
        more = [f"and {len(changed) - NAMED} more fields"] if len(changed) > NAMED else []
        reasons = [*changed[:NAMED], *more] or ["its text was edited"]
    return Stage(name, path, "stale", tuple(reasons), why)


def _other_files(paths: Sequence[Path]) -> list[str]:
    return [f"{path} is not what was compiled" for path in paths]
