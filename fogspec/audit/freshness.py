"""Which stage of an application is fresh, which is stale, and why, field by field. Nothing is written.

What is on disk is compared with what compile would write now: a stage is fresh when what it depends on is what it was
made from, whatever else of the spec has changed.
"""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from fogspec.audit.compare import change_text, changes, changes_in_file
from fogspec.base import digest
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import FogspecError
from fogspec.base.layout import Layout
from fogspec.base.units import dollars
from fogspec.catalog.table import Catalog
from fogspec.compile.compiler import Artifacts, compile_application
from fogspec.plan.reuse import covers
from fogspec.plan.schema import Plan, PlanBody, TaskRef
from fogspec.results.io import read_results
from fogspec.results.schema import Results, completed
from fogspec.spec import fingerprints
from fogspec.spec.loader import read_document
from fogspec.spec.lock_io import lock_drift, read_pins
from fogspec.spec.lockfile import pins_of_measurement
from fogspec.spec.schema import Application

State = Literal["fresh", "partial", "stale", "missing"]
NAMED = 6


@dataclass(frozen=True, slots=True)
class Stage:
    """One stage: its file, its state, and why; `notes` say what changed and does not matter to it."""

    name: str
    path: Path
    state: State
    reasons: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Status:
    """All stages of an application; `refused` says why nothing can be compiled now, `to_measure` what costs money."""

    layout: Layout
    stages: tuple[Stage, ...]
    spent_usd: float
    budget_usd: float | None
    to_measure: int | None
    refused: str | None = None

    @property
    def fresh(self) -> bool:
        """Whether every stage is."""
        return self.refused is None and all(stage.state == "fresh" for stage in self.stages)


def status(application: Application, spec_path: str, catalog: Catalog) -> Status:
    """How things stand with one application; raises DiagnosticError for results that were edited."""
    layout = Layout.of(spec_path, application.metadata.name)
    results = read_results(layout)
    spent = results.spec.spent if results else 0.0
    budget = application.spec.benchmark.budget
    try:
        compiled = compile_application(application, spec_path, catalog)
    except FogspecError as refused:
        return Status(layout, (), spent, budget, None, refused.message)
    plan = _plan(application, layout, compiled)
    measured = _results(application, layout, compiled, results)
    left = len({sample.id for sample in compiled.plan.spec.samples} - completed(compiled.results))
    derived = [_derived(name, path, compiled, measured) for name, path in _after(layout, compiled)]
    return Status(layout, (plan, measured, *derived), spent, budget, left)


def _after(layout: Layout, compiled: Artifacts) -> Iterator[tuple[str, Path]]:
    yield "models", layout.models
    yield "menu", layout.menu
    if compiled.chosen is None or compiled.chosen.manifest is not None or layout.manifest.is_file():
        yield "manifest", layout.manifest


def _plan(application: Application, layout: Layout, compiled: Artifacts) -> Stage:
    if not layout.plan.is_file():
        return Stage("plan", layout.plan, "missing", (f"fogspec compile {layout.spec}",))
    try:
        old = read_document(layout.plan, Plan)
    except DiagnosticError as problems:
        return Stage("plan", layout.plan, "stale", (problems.diagnostics[0].message,))
    was, now = old.spec, compiled.plan.spec
    reasons = [*changed_reads(was.application.field_digests, application), *_changed_pins(was.pins, now.pins)]
    reasons += [f"{name} is not what the lock says" for name in lock_drift(application, layout, read_pins(layout))]
    other_catalog = was.catalog.digest != now.catalog.digest
    if _samples(was, other_catalog) != _samples(now, other_catalog):
        for name in ("hardware", "infra", "sampler", "requests", "duration", "warmup", "setup_timeout"):
            before, after = (body.model_dump(mode="json")[name] for body in (was, now))
            where = "spec." if name in ("hardware", "infra") else "spec.benchmark."
            reasons += map(change_text, changes(before, after, f"{where}{name}"))
        picked = "from the new catalog other machines are picked" if other_catalog else "it is not what compile writes"
        reasons = reasons or [picked]
    reasons = reasons or [f"{path} is not what was compiled" for path in _edited(layout, was)][:NAMED]
    notes = []
    if other_catalog:
        notes.append(
            f"new catalog, re-estimated: at most {dollars(was.estimate.total)} before, {dollars(now.estimate.total)} now"
        )
    if was.budget != now.budget:
        notes.append("spec.benchmark.budget changed, and is enough")
    if not reasons and (was.hardware, was.infra) != (application.spec.hardware, application.spec.infra):
        notes.append("picked for a larger search box, which holds the spec's")
    return Stage("plan", layout.plan, "stale" if reasons else "fresh", tuple(reasons), tuple(notes))


def _samples(body: PlanBody, other_catalog: bool) -> dict[str, TaskRef | None]:
    """Samples and their tasks; under another catalog tasks differ in their prices, which is no reason to measure again."""
    return {sample.id: None if other_catalog else sample.task for sample in body.samples}


def _edited(layout: Layout, body: PlanBody) -> Iterator[str]:
    """Tasks that are missing or not what the plan says."""
    for task in filter(None, (sample.task for sample in body.samples)):
        path = layout.compiled / task.path
        if not os.path.isfile(path) or digest.of_bytes(path.read_bytes()) != task.digest:
            yield task.path


def changed_reads(before: Mapping[str, str] | None, application: Application) -> list[str]:
    """Which fields of the spec that measuring reads changed since these digests were taken."""
    now = fingerprints.measured_fields(application)
    named = {
        "workload": "benchmark.workload",
        "warmup": "benchmark.warmup",
        "min_success_rate": "benchmark.min_success_rate",
    }
    return [f"spec.{named.get(name, name)} changed" for name, one in now.items() if (before or {}).get(name) != one]


def _changed_pins(before: Mapping[str, str] | None, now: Mapping[str, str]) -> list[str]:
    names = sorted((before or {}).keys() | now.keys())
    return [f"{name} is locked to something else" for name in names if (before or {}).get(name) != now.get(name)]


def _results(application: Application, layout: Layout, compiled: Artifacts, results: Results | None) -> Stage:
    samples = {sample.id for sample in compiled.plan.spec.samples}
    if results is None:
        return Stage("results", layout.results, "missing", (f"{len(samples)} samples to measure",))
    if compiled.results is None:
        pins = pins_of_measurement(application, read_pins(layout))
        others = [f"{name} is locked to something else" for name in fingerprints.changed_pins(results.spec.pins, pins)]
        reasons = others
        if results.spec.application != fingerprints.measured_digest(application):
            fields = changed_reads(results.spec.field_digests, application) if results.spec.field_digests else []
            reasons = [*fields, *others] or ["they measured something else"]
        return Stage("results", layout.results, "stale", tuple(reasons))
    left = samples - completed(results)
    unlocked = () if results.spec.pins or not compiled.plan.spec.pins else ("measured before anything was locked",)
    if left:
        why = f"{len(left)} of {len(samples)} samples to measure: {', '.join(sorted(left)[:NAMED])}"
        return Stage("results", layout.results, "partial", (why,), unlocked)
    sampling = compiled.results.spec.sampling if compiled.plan.spec.sampler == "adaptive" else None
    if sampling is not None and sampling.stop_reason is None:
        return Stage("results", layout.results, "partial", ("the next machines are to be asked for",), unlocked)
    if sampling is not None and not covers(application, sampling):
        why = "the search box has grown since machines were asked for"
        return Stage("results", layout.results, "partial", (why,), unlocked)
    return Stage("results", layout.results, "fresh", (), unlocked)


def _derived(name: str, path: Path, compiled: Artifacts, measured: Stage) -> Stage:
    if not path.is_file():
        return Stage(name, path, "missing", (f"results are {measured.state}",) if measured.state != "fresh" else ())
    if measured.state != "fresh":
        return Stage(name, path, "stale", (f"results are {measured.state}",))
    now = compiled.files.get(path)
    if now is None:
        return Stage(name, path, "stale", ("it no longer follows from the results",))
    if path.read_bytes() == now:
        return Stage(name, path, "fresh")
    return Stage(name, path, "stale", tuple(_what_differs(path, now)))


def _what_differs(path: Path, now: bytes) -> list[str]:
    """The fields that differ; digests only where nothing else does."""
    told = list(map(change_text, changes_in_file(path, now)))
    more = [f"and {len(told) - NAMED} more fields"] if len(told) > NAMED else []
    return [*told[:NAMED], *more] or ["its text was edited"]
