"""Judge an application whose price list is not here, by the digest and the rows that plan, menu and manifest carry.

In CI there are no lists of SkyPilot's, and another version of fogspec bundles another list. What follows from the spec, the
files that are sent and the results is regenerated: plan, tasks, models, and the files that are deployed. Which machine is best
at which price is not judged again: menu and manifest stand if all that they name is what it was.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel

from fogspec.agent import PROTOCOL
from fogspec.base import digest
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import FogspecError, Refused
from fogspec.base.text import shell_command
from fogspec.base.units import dollars
from fogspec.catalog.filters import offers_for, price_now
from fogspec.catalog.table import in_its_unit
from fogspec.choice.menu import Menu
from fogspec.compile.artifacts import Artifacts
from fogspec.compile.bundle import references
from fogspec.compile.compiler import campaign_plan, record_of, standing_of, usable
from fogspec.compile.decision import record_of_choice
from fogspec.compile.deploy_files import deployment_files
from fogspec.compile.inputs import Inputs
from fogspec.compile.links import link_of
from fogspec.compile.manifest import Manifest, pinned_to
from fogspec.compile.plan_files import document_file, plan_file, with_tasks
from fogspec.language.lockfile import pinned, sent_files
from fogspec.language.schema import Application
from fogspec.model.fit import Models, fit
from fogspec.plan.budget import estimate_cost, within_budget
from fogspec.plan.reuse import kept_plan, picks_changed
from fogspec.plan.schema import Plan, digest_without_budget
from fogspec.results.progress import unfinished
from fogspec.results.schema import Results, completed

D = TypeVar("D", bound=BaseModel)


def try_recorded(inputs: Inputs) -> Artifacts | FogspecError:
    """Return what follows without the price list, or why nothing does; raise DiagnosticError for damaged results."""
    try:
        return _recorded(inputs)
    except FogspecError as refusal:
        return refusal


@in_its_unit
def _recorded(inputs: Inputs) -> Artifacts:
    exact, layout = pinned(inputs.application, inputs.pins), inputs.layout
    found = standing_of(inputs)
    results, stale = usable(inputs, found)
    plan, files = _plan(inputs.measured, results)
    accepted, menu = None, None
    if results is not None:
        models = fit(exact, results, inputs.library_digest)
        known = _document(inputs, layout.models, Models)
        shift, predictions = ({}, {}) if known is None else (known.spec.shift, known.spec.predictions)
        files[layout.models] = document_file(models.document(shift, predictions), layout)
        menu = _document(inputs, layout.menu, Menu)
        files |= _chosen(inputs, exact, plan, files[layout.models], menu)
        left = unfinished(inputs.measured.application, plan, results)
        accepted = left.state if left is not None and layout.manifest in files else None
    return Artifacts(
        inputs=inputs,
        application=exact,
        plan=plan,
        admissible=offers_for(inputs.catalog, exact.spec),
        results=results,
        stale=stale,
        standing=found,
        decision=None,
        files=files,
        accepted=accepted,
        recorded_menu=menu,
    )


def _plan(inputs: Inputs, results: Results | None) -> tuple[Plan, dict[Path, bytes]]:
    """Return the plan on disk with what is measured now, and its files; raise Refused if its machines must be picked again."""
    application, layout = inputs.application, inputs.layout
    kept, record, plan = inputs.on_disk[layout.plan].document(Plan), record_of(inputs), None
    if results is not None:
        plan = campaign_plan(inputs, record, results)
    if plan is None:
        whole = {one.id for one in kept.spec.samples} <= completed(results)
        if changed := picks_changed(application, kept, whole):
            again = shell_command("fogspec", "compile", layout.spec, "--catalog", kept.spec.catalog.origin)
            raise Refused(
                f"{', '.join(changed)} changed, and the prices that machines are picked by are not here: {inputs.unread}",
                again,
            )
        plan = kept_plan(application, kept, inputs.catalog, record)
    due = estimate_cost(plan, completed(results), results.spec.spent if results else 0.0)
    if plan.spec.budget is not None and not within_budget(plan, due):
        raise Refused(f"the plan may cost {dollars(due.total_usd)}, the budget is {dollars(plan.spec.budget)}")
    plan, tasks = with_tasks(pinned(application, inputs.pins), plan, layout)
    return plan, {**inputs.agent, **tasks, layout.plan: plan_file(plan, layout)}


def _chosen(
    inputs: Inputs, application: Application, plan: Plan, models: bytes, menu: Menu | None
) -> Mapping[Path, bytes]:
    """Return menu, charts and manifest as they are on disk, and what it deploys, regenerated; nothing if it does not hold."""
    layout, manifest = inputs.layout, _document(inputs, inputs.layout.manifest, Manifest)
    kept = {
        path: content
        for path in (layout.menu, layout.picture, layout.latencies, layout.metric_picture, layout.manifest)
        if (content := inputs.content(path)) is not None
    }
    if menu is None or manifest is None:
        return kept if menu is not None and menu.spec.balanced is None and layout.manifest not in kept else {}
    machines = [manifest.spec.machine, *(one.machine for one in manifest.spec.fallbacks)]
    deployed = deployment_files(application, layout, machines, inputs.agent)
    environment = link_of(application).end(application, "robot").environment
    named, pins = {one.path: one.digest for one in references(manifest)}, manifest.pins
    # What other prices would change is the approved machine, which is the menu's and costs what the plan says.
    holds = (
        menu.spec.balanced is not None
        and menu.spec.balanced.machine == machines[0]
        and all(price_now(one, inputs.catalog) == one.price for one in machines)
        and named == {layout.beside_manifest(path): digest.of_bytes(content) for path, content in deployed.items()}
        and manifest.evidence.inputs == record_of_choice(inputs)
        and pins.plan == digest_without_budget(plan)
        and pins.agent_protocol == PROTOCOL
        and pins.models == digest.of_bytes(models)
        and pins.sent == sent_files(application, inputs.sent)
        and manifest.spec == pinned_to(application, machines[0], manifest.spec.fallbacks, environment)
    )
    return {**kept, **deployed} if holds else {}


def _document(inputs: Inputs, path: Path, kind: type[D]) -> D | None:
    """Return a document on disk; None for one that is missing or damaged, which differs from what follows."""
    file = inputs.on_disk.get(path)
    try:
        return None if file is None else file.document(kind)
    except DiagnosticError:
        return None
