"""Determine which stages of an application are fresh or stale, and why, without reading or writing files.

All commands use one rule: a stage is fresh if its files on disk are what compile would write now. The manifest names the
digests of all that it was made from, so that equal bytes are the whole chain, from the spec to the pinned machine. Only what
compile cannot write is compared otherwise: records of results, with their raw timings. The fields of the spec that a stage
reads are declared in the schema (`fogspec.language.fingerprints`), so that other changes leave it fresh.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import fspath
from pathlib import Path
from typing import Any, Literal

from fogspec.base.diagnostics import Diagnostic, DiagnosticError
from fogspec.base.errors import FogspecError, OutOfDate
from fogspec.base.files import PULL
from fogspec.base.layout import Layout
from fogspec.base.text import count, restore_command, shell_command
from fogspec.base.units import dollars
from fogspec.catalog.filters import offers_for
from fogspec.catalog.table import Catalog, in_its_unit
from fogspec.check.compare import change_text, changes, changes_in_file
from fogspec.compile.artifacts import Artifacts
from fogspec.compile.compiler import plan_for, standing_of, try_compile, usable
from fogspec.compile.damage import restorable
from fogspec.compile.decision import record_of_choice, record_of_models
from fogspec.compile.inputs import Inputs, unpriced
from fogspec.compile.manifest import Manifest
from fogspec.language.fingerprints import RESULTS, TOOL
from fogspec.language.fingerprints import change_text as change_since
from fogspec.language.loader import UPGRADE, SourceFile
from fogspec.language.schema import Waiver
from fogspec.language.warned import sentence
from fogspec.model.fit import partition
from fogspec.plan.schema import SETTINGS, Plan, PlanBody
from fogspec.results.progress import unfinished
from fogspec.results.schema import completed
from fogspec.results.standing import input_changes

State = Literal["fresh", "partial", "unusable", "stale", "missing", "damaged"]
Words = tuple[str, ...]  # a verb, and its arguments
NAMED = 6
SHOWN = 3  # reasons in a sentence
MANIFEST = "DeploymentManifest"


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

    `refused` is the reason why nothing can be compiled, `fix` the command that changes it, if there is one; otherwise there are
    `artifacts`. `to_measure` counts the samples that are still to be measured. `differing` are the files that differ from what
    compile would write. `damaged` are the errors of results, a lock or a file that cannot be used, each with the command that
    restores them.
    """

    inputs: Inputs
    artifacts: Artifacts | None = None
    refused: str | None = None
    stages: tuple[Stage, ...] = ()
    differing: tuple[Path, ...] = ()
    to_measure: int | None = None
    fix: str | None = None
    damaged: tuple[Diagnostic, ...] = ()

    @property
    def layout(self) -> Layout:
        """The paths of the application's files."""
        return self.inputs.layout

    @property
    def catalog(self) -> Catalog:
        """The catalog of machines and prices."""
        return self.inputs.catalog

    @property
    def spent_usd(self) -> float | None:
        """The amount spent on measuring so far, in USD; None if the results that say it are damaged."""
        if self.inputs.results is None:
            return None if self.inputs.results_files else 0.0
        return self.inputs.results.spec.spent

    @property
    def budget_usd(self) -> float | None:
        """The budget for measuring in USD; None without one."""
        return self.inputs.application.spec.benchmark.budget

    @property
    def current(self) -> bool:
        """True if the files on disk are what compile would write."""
        return self.refused is None and not self.differing

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
    def unsettled(self) -> tuple[Stage, ...]:
        """The stages for which something is left to do."""
        return tuple(stage for stage in self.stages if not self.settled(stage))

    @property
    def problems(self) -> list[str]:
        """Why the files are not what the inputs say, each cause once, as sentences; none if they are."""
        return self.problems_of(self.unsettled)

    def problems_of(self, stages: Sequence[Stage]) -> list[str]:
        """Return what is wrong with these stages; files of a stage that is not expected are problems too."""
        if self.refused is not None:
            reasons = (text for stage in stages for text in stage.reasons if text != self.remedy)
            return [*reasons, *self._refusal]
        groups = dict[tuple[State, tuple[str, ...]], list[Stage]]()
        for stage in stages:
            groups.setdefault((stage.state, stage.reasons), []).append(stage)
        said = [_sentence(alike, reasons) for (_, reasons), alike in groups.items()]
        told = {stage.name for stage in self.unsettled}
        untold = [path for path in self.differing if stage_of(path, self.layout) not in told]
        return [*said, *_some(_other_files(untold))]

    @property
    def _refusal(self) -> list[str]:
        return [] if self.damaged else [f"cannot be compiled: {self.refused}"]

    @property
    def following(self) -> Words | None:
        """The command that brings the application further, in words; None if it is fresh, or cannot be compiled."""
        if self.artifacts is None or (self.fresh and not self.artifacts.settles):
            return None
        states = {stage.name: stage.state for stage in self.stages}
        current = all(states.get(name) == "fresh" for name in ("models", "menu"))
        more = self.to_measure or states["results"] == "partial" or (self.artifacts.settles and current)
        if states["plan"] == "fresh" and more:
            return measuring(self.artifacts)
        if self.current and states["results"] == "unusable" and self.artifacts.results is not None:
            again = ",".join(one.id for one in self.artifacts.results.spec.samples)
            return *measuring(self.artifacts), "--only", again
        return "compile", fspath(self.layout.spec)

    @property
    def remedy(self) -> str | None:
        """What makes the files what the inputs say; None if they are, or if only the user can tell."""
        if self.damaged:
            return next((one.fix for one in self.damaged if one.fix is not None), None)
        if self.artifacts is not None and self.artifacts.results is not None and self.inputs.timings:
            if any(PULL in one for one in self.inputs.timings):
                return PULL
            measure = shell_command("fogspec", "bench", self.layout.spec)
            return f"put back what was measured ({restore_command(self.layout.results)}), or measure it: {measure}"
        if self.following is None or self.artifacts is None:
            return self.fix
        steps = [self.following]
        # A plan that was compiled before the change measures nothing: to compile alone would only lead to the bench.
        if self.following[0] == "compile" and any(
            one.name == "results" and one.state == "stale" for one in self.stages
        ):
            steps += [measuring(self.artifacts), self.following]
        return " && ".join(shell_command("fogspec", *words) for words in steps)

    def require(self, refusal: str, *names: str) -> None:
        """Raise OutOfDate with the reasons and the remedy unless the stages of these names, or without any all, are fresh."""
        stages = self.stages if not names else [stage for stage in self.stages if stage.name in names]
        if self.fresh or (self.refused is None and names and all(map(self.settled, stages))):
            return
        said = self.problems_of([stage for stage in stages if not self.settled(stage)])
        raise OutOfDate(refusal, *said, *([] if self.remedy is None else [self.remedy]))

    @property
    def partial(self) -> str | None:
        """How much of the plan the manifest rests on, if that is not all of it; None without such a manifest."""
        return None if self.artifacts is None else self.artifacts.partial


def look(inputs: Inputs, base: str | None = None) -> Status:
    """Return the status of an application, also of one whose results or lock are damaged; `base` may have them undamaged."""
    try:
        if inputs.measured.unread is None:
            return status(inputs, try_compile(inputs))
        from fogspec.check.recorded import try_recorded

        return status(inputs, try_recorded(inputs))
    except DiagnosticError as problems:
        damaged = (problems if base is None else restorable(problems, inputs.layout, base)).diagnostics
        reasons = (*map(located, damaged), *dict.fromkeys(one.fix for one in damaged if one.fix is not None))
        path = Path(damaged[0].span.path)
        ours = inputs.layout
        name = "lock" if path == ours.lock else "results" if path.is_relative_to(ours.results) else "files"
        stage = Stage(name, path, "damaged", tuple(_some(reasons)))
        return Status(inputs=inputs, refused=f"{path} is damaged", stages=(stage,), damaged=damaged)


def _sentence(stages: Sequence[Stage], reasons: Sequence[str]) -> str:
    """Return such as `models and menu are stale: …`; one stage alone with its file."""
    *others, last = stages
    why = f": {'; '.join(reasons[:SHOWN])}" if reasons else ""
    if not others:
        place = "" if str(last.path) in why else f"{last.path}: "
        return f"{place}{last.words}{why}"
    return f"{', '.join(one.name for one in others)} and {last.name} are {last.state}{why}"


def measuring(compiled: Artifacts) -> Words:
    """Return the command that measures the plan; without prices there would be no choice, so first the one that has them."""
    if (missing := unpriced(compiled.inputs.spec, compiled.catalog)) is not None:
        return missing[2]
    return "bench", fspath(compiled.layout.spec), *compiled.plan.runner_options


def located(one: Diagnostic) -> str:
    """Return what is wrong with a file, with its place."""
    return f"{one.span.path}:{one.span.line}:{one.span.column}: {one.message}"


@in_its_unit
def status(inputs: Inputs, compiled: Artifacts | FogspecError) -> Status:
    """Return the status of an application from its inputs and their compilation, or the error that refused it."""
    if isinstance(compiled, FogspecError):
        fix = next((hint for hint in compiled.hints if hint.startswith("fogspec ")), None)
        return Status(inputs=inputs, refused=compiled.message, fix=fix)
    differing = compiled.compare()
    chosen, measured = (
        _changed(inputs, inputs.layout.manifest, "evidence", record_of_choice(inputs)),
        _results(compiled),
    )
    fitted = _changed(inputs, inputs.layout.models, "spec", record_of_models(inputs))
    upgrade = next((change_since(one) for one in chosen if one.change == TOOL), None)
    left = len({sample.id for sample in compiled.plan.spec.samples} - completed(compiled.results))
    return Status(
        inputs=inputs,
        artifacts=compiled,
        stages=(
            _plan(compiled, differing, upgrade),
            measured,
            *_derived(compiled, differing, measured, fitted, chosen),
        ),
        differing=tuple(differing),
        to_measure=left,
    )


def stage_of(path: Path, layout: Layout) -> str:
    """Return the stage that writes a file."""
    if path in (layout.plan, layout.agent, layout.setup_script, layout.measure_script) or path.parent == layout.tasks:
        return "plan"
    if path == layout.models:
        return "models"
    return "menu" if path == layout.menu else "manifest"


def _plan(compiled: Artifacts, differing: Sequence[Path], upgrade: str | None) -> Stage:
    """Return the plan's stage; `upgrade` is the cause if another version of fogspec made the files."""
    inputs, path = compiled.inputs, compiled.layout.plan
    file = inputs.on_disk.get(path)
    if file is None:
        return Stage("plan", path, "missing", (shell_command("fogspec", "compile", inputs.layout.spec),))
    mine = [one for one in differing if stage_of(one, inputs.layout) == "plan"]
    if not mine:
        return Stage("plan", path, "fresh", (), tuple(filter(None, [inputs.prices_kept])))
    if mine == [inputs.layout.agent] and upgrade is not None:
        return Stage("plan", path, "stale", (upgrade,))
    try:
        reasons = _plan_reasons(compiled, file.document(Plan).spec)
    except DiagnosticError as problems:
        reasons = [located(problems.diagnostics[0])]
    if not reasons:
        fields = _field_changes(file, compiled.files[path]) if path in mine else []
        reasons = [*fields, *_other_files([one for one in mine if one != path])[:NAMED]]
    return Stage("plan", path, "stale", tuple(reasons))


def _plan_reasons(compiled: Artifacts, was: PlanBody) -> list[str]:
    """Return why the plan on disk differs from a compiled one; reasons to measure again come first."""
    now = compiled.plan.spec
    reasons = _some(list(map(change_since, input_changes(was.inputs, now.inputs))))
    other_catalog = was.catalog.digest != now.catalog.digest
    if _samples(was, other_catalog) != _samples(now, other_catalog):
        before, after = was.model_dump(mode="json"), now.model_dump(mode="json")
        fields = {"hardware": "hardware", "infra": "infra", "sampler": "benchmark.sampler"}
        fields |= {name: f"benchmark.{path}" for name, path in SETTINGS.items()}
        for name, path in fields.items():
            reasons += map(change_text, changes(before[name], after[name], f"spec.{path}"))
        picked = ["from the new catalog other machines are picked"] if other_catalog else _other_samples(was, now)
        reasons = reasons or picked
    if other_catalog:
        before_usd, now_usd = dollars(was.estimate.total), dollars(now.estimate.total)
        reasons.append(
            "new catalog; the costs of measuring stay"
            if before_usd == now_usd
            else f"new catalog, re-estimated: at most {before_usd} before, {now_usd} now"
        )
    if was.budget != now.budget:
        reasons.append("spec.benchmark.budget changed, and is enough")
    return reasons


def _other_samples(was: PlanBody, now: PlanBody) -> list[str]:
    """Return the samples that a plan lacks, and those that it should not have."""
    before, after = ({sample.id: sample for sample in body.samples} for body in (was, now))
    lacks = ", ".join(name for name in after if name not in before)
    more = ", ".join(name for name in before if name not in after)
    return [f"spec.samples: without {lacks}"] * bool(lacks) + [f"spec.samples: {more} should not be there"] * bool(more)


def sample_changes(inputs: Inputs, plan: Plan) -> list[str]:
    """Return how the samples of a plan on disk differ from those that the inputs give, as sentences.

    They are not judged by another catalog than the plan's, nor once a campaign has begun that selects its machines: its
    samples are facts of its results.
    """
    if inputs.refused is not None or plan.spec.catalog.digest != inputs.catalog.about.digest:
        return []
    results = usable(inputs, standing_of(inputs))[0]
    if results is not None and results.spec.sampling is not None:
        return []
    spec = inputs.application.spec
    admissible = offers_for(inputs.catalog, spec)
    return _other_samples(plan.spec, plan_for(inputs, admissible, results).spec)


def _samples(body: PlanBody, other_catalog: bool) -> dict[str, str | None]:
    """Return the samples and their tasks; no tasks for another catalog, whose prices are no reason to measure again."""
    return {sample.id: None if other_catalog else sample.task for sample in body.samples}


def _results(compiled: Artifacts) -> Stage:
    inputs, path = compiled.inputs, compiled.layout.results
    if inputs.results is None:
        return Stage("results", path, "missing", (f"{count(len(compiled.plan.spec.samples), 'sample')} to measure",))
    if compiled.results is None:
        return Stage("results", path, "stale", tuple(_some(compiled.standing.reasons if compiled.standing else [])))
    if inputs.timings:
        return Stage("results", path, "stale", tuple(_some(inputs.timings)))
    waived = compiled.standing.waived if compiled.standing else ()
    notes = (*(f"waived: {change_since(one)}: {one.reason}" for one in waived), *unused_waivers(compiled))
    left = unfinished(inputs.measured.application, compiled.plan, compiled.results)
    if left is not None:
        return Stage("results", path, "partial", (sentence(left.warning),), notes)
    known, rejected = partition(compiled.results.spec.samples, compiled.application.spec.constraints.statistic)
    if not known:
        why = [sentence(one.why) for one in rejected]
        return Stage("results", path, "unusable", tuple(_some(why)), notes)
    return Stage("results", path, "fresh", (), notes)


def unused_waivers(compiled: Artifacts) -> list[str]:
    """Return a sentence for each waiver of the spec that no results need."""
    needed = compiled.standing.waived if compiled.standing else ()
    every = compiled.inputs.application.spec.benchmark.waivers
    return [f"spec.benchmark.waivers: {one.change} is not needed any more" for one in every if one not in needed]


def _some(reasons: Sequence[str]) -> list[str]:
    left = len(reasons) - NAMED
    return [*reasons[:NAMED], *([f"and {left} more"] if left > 0 else [])]


def _derived(
    compiled: Artifacts, differing: Sequence[Path], measured: Stage, fitted: Sequence[Waiver], chosen: Sequence[Waiver]
) -> Iterator[Stage]:
    """Yield the stages that depend on the results; `fitted` and `chosen` are the inputs that changed since they were made."""
    layout = compiled.layout
    stages = (
        ("models", layout.models, fitted or chosen),
        ("menu", layout.menu, chosen),
        ("manifest", layout.manifest, chosen),
    )
    for name, path, causes in stages:
        if name != "manifest" or not compiled.infeasible or path in compiled.inputs.on_disk:
            mine = [one for one in differing if stage_of(one, layout) == name]
            yield _derived_stage(compiled, name, path, mine, measured, tuple(_some(list(map(change_since, causes)))))


def _derived_stage(
    compiled: Artifacts, name: str, path: Path, differing: Sequence[Path], measured: Stage, causes: tuple[str, ...]
) -> Stage:
    file, now = compiled.inputs.on_disk.get(path), compiled.files.get(path)
    why = () if measured.state == "fresh" else (f"results are {measured.state}",)
    if file is None:
        return Stage(name, path, "missing", why)
    if now is None:
        return Stage(name, path, "stale", causes or why or ("it no longer follows from the results",))
    if not differing:
        return Stage(name, path, "fresh", (), (*why, *(compiled.chart_warnings if name == "menu" else ())))
    if causes:
        return Stage(name, path, "stale", causes, why)
    reasons = _other_files([one for one in differing if one != path])[:NAMED]
    return Stage(name, path, "stale", (*(_field_changes(file, now) if path in differing else ()), *reasons), why)


def _field_changes(file: SourceFile, now: bytes) -> list[str]:
    """Return the fields of a compiled file on disk that differ, or what makes it unreadable."""
    if file.content.replace(b"\r\n", b"\n") == now:
        return ["its line ends differ, and nothing else: git's core.autocrlf"]
    try:
        document = file.plain()
    except DiagnosticError as damaged:
        return list(map(located, damaged.diagnostics[:NAMED]))
    if not isinstance(document, Mapping):
        return [f"{file.name}: it has no mapping"]
    if newer := _written_by_newer(file, document):
        return newer
    changed = list(map(change_text, changes_in_file(file, now)))
    more = [f"and {len(changed) - NAMED} more fields"] if len(changed) > NAMED else []
    return [*changed[:NAMED], *more] or ["its text was edited"]


def _written_by_newer(file: SourceFile, document: Mapping[str, Any]) -> list[str]:
    """Return the fields of a manifest that only a newer version of fogspec knows."""
    if document.get("kind") == MANIFEST:
        try:
            file.document(Manifest)
        except DiagnosticError as problems:
            return [located(one) for one in problems.diagnostics if one.fix == UPGRADE][:NAMED]
    return []


def _changed(inputs: Inputs, path: Path, part: str, now: Mapping[str, Any]) -> list[Waiver]:
    """Return the inputs that changed since a file with a record in this part was made; none for one that cannot be read.

    Results that are gone or damaged are reported by their own stage.
    """
    file = inputs.on_disk.get(path)
    try:
        found: Any = None if file is None else file.plain()
    except DiagnosticError:
        return []
    for name in (part, "inputs"):
        found = found.get(name) if isinstance(found, Mapping) else None
    changed = input_changes(found, now) if isinstance(found, Mapping) else []
    return [one for one in changed if inputs.results is not None or one.change != RESULTS]


def _other_files(paths: Sequence[Path]) -> list[str]:
    return [f"{path} is not what was compiled" for path in paths]
