"""Compiling one application: from its inputs to every file that follows from them, without reading or writing any.

What compile writes is a function of its inputs: files that no longer follow are removed, and a check is a comparison.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import FogspecError, Infeasible, InvalidInput, Refused
from fogspec.base.units import dollars, format_money
from fogspec.catalog.filters import Filtered, offers_for
from fogspec.catalog.table import in_its_unit
from fogspec.compile.artifacts import Artifacts
from fogspec.compile.inputs import Inputs
from fogspec.compile.plan_files import plan_file, with_tasks
from fogspec.language.fingerprints import measured_record
from fogspec.language.lockfile import pinned, some
from fogspec.language.rules import RULES
from fogspec.language.schema import Spec
from fogspec.plan.budget import ceil_cents, cheapest_options, estimate_cost, within_budget
from fogspec.plan.design import make_plan
from fogspec.plan.reuse import plan_from_campaign, reuse_plan
from fogspec.plan.schema import Plan
from fogspec.results.schema import Results, completed, other_machines
from fogspec.results.standing import Standing, standing

if TYPE_CHECKING:
    from fogspec.compile.decision import Decision


@in_its_unit
def compile_application(inputs: Inputs, partial: bool = False) -> Artifacts:
    """Return every file that follows from the inputs, and what they say.

    Plan and tasks are of the application that is measured, whose environments all have the same.
    With `partial`, there is a manifest also if the plan was not carried out.

    Raise DiagnosticError for damaged results, InvalidInput for a listed machine that is not on offer, Infeasible if no
    machine is admissible, Refused if the plan may cost more than the budget.
    """
    exact = pinned(inputs.application, inputs.pins)
    found = standing_of(inputs)
    results, stale = usable(inputs, found)
    admissible = _admissible(inputs)
    plan, files = _planned(inputs.measured, admissible if inputs.base is None else _admissible(inputs.base), results)
    decision: Decision | None = None
    if results is not None:
        from fogspec.compile.decision import decide

        decision = decide(inputs, exact, admissible, results, plan, partial, () if found is None else found.waived)
        files |= decision.files
    return Artifacts(
        inputs=inputs,
        application=exact,
        plan=plan,
        admissible=admissible,
        results=results,
        stale=stale,
        standing=found,
        decision=decision,
        files=files,
    )


def _admissible(inputs: Inputs) -> Filtered:
    spec = inputs.application.spec
    return offers_for(inputs.catalog, spec)


def _planned(inputs: Inputs, admissible: Filtered, results: Results | None) -> tuple[Plan, dict[Path, bytes]]:
    """Return the plan of what is measured, and its files."""
    application, layout = inputs.application, inputs.layout
    exact = pinned(application, inputs.pins)
    bare = plan_for(inputs, admissible, results)
    check_budget(inputs, bare, admissible, results)
    plan, tasks = with_tasks(exact, bare, layout)
    return plan, {**inputs.agent, **tasks, layout.plan: plan_file(plan, layout)}


def try_compile(inputs: Inputs) -> Artifacts | FogspecError:
    """Return what `compile_application` does, or why it refuses; raise DiagnosticError for damaged results."""
    try:
        return compile_application(inputs)
    except FogspecError as refusal:
        return refusal


def standing_of(inputs: Inputs) -> Standing | None:
    """Return whether the results on disk still count, None without any; raise DiagnosticError for damaged ones."""
    if inputs.damaged is not None:
        raise inputs.damaged
    if inputs.refused is not None:
        raise inputs.refused
    if inputs.results is None:
        return None
    return standing(inputs.results, record_of(inputs), inputs.application.spec.benchmark.waivers)


def record_of(inputs: Inputs) -> Mapping[str, Any]:
    """Return the record of what is measured now."""
    return measured_record(inputs.application, inputs.pins, inputs.sent)


def usable(inputs: Inputs, found: Standing | None) -> tuple[Results | None, str | None]:
    """Return the results if they count, or why those on disk do not."""
    if found is None or found.counts:
        return inputs.results, None
    changed = some(list(dict.fromkeys(found.fields)))
    return None, f"{inputs.layout.results} measured something else: {changed} changed since"


def check_budget(inputs: Inputs, plan: Plan, admissible: Filtered, results: Results | None) -> None:
    """Raise Refused if what is still to be measured may cost more than the budget leaves."""
    budget = plan.spec.budget
    due = estimate_cost(plan, completed(results), results.spec.spent if results else 0.0)
    if budget is None or within_budget(plan, due):
        return

    def cost(spec: Spec) -> float | None:
        application = inputs.application.model_copy(update={"spec": spec})
        other = replace(inputs, spec=replace(inputs.spec, application=application))
        if any(found.severity == "error" for rule in RULES for found in rule(application)):
            return None
        try:
            changed = plan_for(other, _admissible(other), results)
        except (Infeasible, InvalidInput):
            return None
        return estimate_cost(changed, completed(results), due.spent_usd).total_usd

    options = cheapest_options(inputs.application, plan, due, admissible, cost)
    before = f", {dollars(due.spent_usd)} of it spent already" if due.spent_usd else ""
    parts = due.estimate
    raise Refused(
        f"{plan.metadata.name}: the plan may cost {dollars(due.total_usd)}{before}, "
        f"the budget is {dollars(budget)}: nothing was written",
        f"{len(due.todo)} samples to measure: measuring {dollars(parts.measuring)}, set-up {dollars(parts.setup)}, "
        f"start and end of the machines {dollars(parts.overhead)}, each at most",
        "ways to make it fit:",
        *(f"- {option.line()}" for option in options),
        f"- raise spec.benchmark.budget to {format_money(ceil_cents(due.total_usd))}: loses nothing",
    )


def plan_for(inputs: Inputs, admissible: Filtered, results: Results | None) -> Plan:
    """Return the plan without its tasks: of a campaign that has begun, else the one on disk if it serves, else a new one."""
    record, plan = record_of(inputs), None
    if results is not None:
        plan = campaign_plan(inputs, record, results) or _reusable_plan(inputs, record, results)
    measured = results.spec.machines if results is not None else None
    return plan or make_plan(
        inputs.application, inputs.catalog, inputs=record, admissible=admissible, measured=measured
    )


def campaign_plan(inputs: Inputs, record: Mapping[str, Any], results: Results) -> Plan | None:
    """Return the plan of an adaptive campaign that has begun: its decisions are in the results."""
    sampling = results.spec.sampling
    if sampling is None or inputs.application.spec.sampler != "adaptive":
        return None
    return plan_from_campaign(inputs.application, inputs.catalog, sampling, record)


def _reusable_plan(inputs: Inputs, record: Mapping[str, Any], results: Results) -> Plan | None:
    """Return the plan on disk if all of it is measured, it still serves, and the search space or the prices are new."""
    file = inputs.on_disk.get(inputs.layout.plan)
    if file is None:
        return None
    try:
        plan = file.document(Plan)
    except DiagnosticError:
        return None
    body, spec = plan.spec, inputs.application.spec
    searched = (spec.hardware.search_space, spec.infra, inputs.catalog.about.digest)
    if (body.hardware, body.infra, body.designed_from) == searched:
        return None
    if not {sample.id for sample in body.samples} <= completed(results) or other_machines(plan, results):
        return None
    return reuse_plan(inputs.application, plan, inputs.catalog, record)
