"""Summarize a compilation: the derived files, their content, and the next command."""

import textwrap
from typing import TYPE_CHECKING, Any

from fogspec.base import units
from fogspec.base.console import columns
from fogspec.base.text import count, line, paragraph, shell_command
from fogspec.base.units import dollars
from fogspec.catalog.table import in_its_unit
from fogspec.choice.menu import menu_data, metric_text, shown_miss, why_open
from fogspec.compile.artifacts import Artifacts
from fogspec.compile.inputs import unpriced
from fogspec.language.warned import is_decisive, sentence
from fogspec.plan.commitment import unattended
from fogspec.report.facts import card, how, latency_of, machine_of, measured_of, meeting
from fogspec.results.standing import ways_to_keep

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fogspec.choice.menu import Entry, Menu, MetricValue
    from fogspec.compile.decision import Decision
    from fogspec.language.schema import Application

NOTES = 3
WIDEST, KEY = 80, 10  # columns of a line, and of the keys before its text


@in_its_unit
def summary(compiled: Artifacts, following: "Sequence[str]" = (), verbose: bool = False) -> str:
    """Return the summary of a compiled application as text, the choice first; `following` are lines about what comes next.

    What was derived on the way is listed if nothing is measured yet or if it is `verbose`; otherwise it is counted.
    """
    layout, decision, results = compiled.layout, compiled.decision, compiled.results
    if decision is None or results is None:
        return paragraph([layout.name, *_derived(compiled), *_unmeasured(compiled), *following])
    warnings = decision.menu.spec.warnings
    lines = [
        layout.name,
        *_outcome(compiled, decision),
        _row("measured", "", measured_of(compiled)),
        _row("menu", "", meeting(decision.menu)),
        _row("prices", "", _catalog_text(compiled)),
    ]
    if verbose:
        written = [layout.models, layout.menu, layout.picture, layout.manifest, layout.deploy]
        files = [str(path) for path in written if path in compiled.files]
        further = [*_derived(compiled), _row("results", "", str(layout.results)), _row("files", "", ", ".join(files))]
        return paragraph([*lines, *warning_lines(warnings, len(warnings)), *further, *following])
    named = warning_lines(warnings)
    hidden = len(_notes(compiled)) + len(warnings) - len(named)
    again = shell_command("fogspec", "compile", layout.argument, "-v")
    more = [f"  {count(hidden, 'note')} on models, plan and prices: {again}"] if hidden else []
    return paragraph([*lines, *named, *more, *following])


def warning_lines(warnings: "Sequence[Mapping[str, Any]]", most: int | None = None) -> list[str]:
    """Return the lines of the warnings that bear on the decision, or of the first `most` of all."""
    shown = [one for one in warnings if is_decisive(one)][:NOTES] if most is None else warnings[:most]
    return [f"{'!' if is_decisive(one) else ' '} warning: {sentence(one)}" for one in shown]


def _catalog_text(compiled: Artifacts) -> str:
    catalog = compiled.plan.spec.catalog
    return f"{catalog.source}, {catalog.date}" if catalog.date else catalog.source


def _notes(compiled: Artifacts) -> list[str]:
    """Return what there is to say of catalog and plan, besides what they are."""
    missing = unpriced(compiled.inputs.spec, compiled.catalog)
    checked = compiled.inputs.catalog.about.checked if missing is None else None
    texts = (checked, compiled.admissible.left_out_line())
    return [*(text for text in texts if text), *map(sentence, compiled.plan.spec.notes)]


def _derived(compiled: Artifacts) -> list[str]:
    """Return the lines on catalog, plan and tasks."""
    layout, body = compiled.layout, compiled.plan.spec
    missing = unpriced(compiled.inputs.spec, compiled.catalog)
    if missing is None:
        admitted = count(len(compiled.admissible.offers), "admissible machine")
        lines = [_row("catalog", _catalog_text(compiled), admitted)]
    else:
        lines = [_row("catalog", "", missing[0]), _row("", "", missing[1])]
    notes, of_plan = _notes(compiled), len(body.notes)
    lines += [_row("", "", text) for text in notes[: len(notes) - of_plan]]
    lines.append(_row("plan", str(layout.plan), _plan_text(compiled)))
    lines += [_row("", "", text) for text in notes[len(notes) - of_plan :][:NOTES]]
    if of_plan > NOTES:
        lines.append(_row("", "", f"more notes in the plan: {of_plan - NOTES}"))
    if tasks := sum(not sample.machine.is_local for sample in body.samples):
        lines.append(_row("tasks", f"{layout.tasks}/", f"{count(tasks, 'SkyPilot task')}, one per machine"))
    return lines


@in_its_unit
def result(compiled: Artifacts) -> str:
    """Return only what came out, as text: the choice, or why there is none."""
    name, decision = compiled.layout.name, compiled.decision
    if decision is None:
        return line(f"{name}: {f'stale: {compiled.stale}' if compiled.stale else 'not measured yet'}")
    return paragraph([name, *_outcome(compiled, decision)])


def _outcome(compiled: Artifacts, decision: "Decision") -> list[str]:
    """Return the lines about the choice and the manifest."""
    left, entry = decision.unfinished, decision.menu.spec.balanced
    if entry is None:
        return [*infeasible_text(decision.menu), *_kept(compiled)]
    card = choice_card(decision.menu, compiled.application)
    if decision.manifest is None:
        return [*card, *(_kept(compiled) or ["  no manifest: the plan was not carried out"])]
    return [*card, *([] if left is None else [_row("manifest", "", f"partial: {left.state}")])]


def _kept(compiled: Artifacts) -> list[str]:
    """Return that the manifest is stale, if one is on disk and none follows."""
    path = str(compiled.layout.manifest)
    words = "stale: it stays, and apply refuses it, until there is a new one"
    return [_row("manifest", path, words)] if compiled.kept else []


def rows(facts: "Sequence[tuple[str, str]]") -> list[str]:
    """Return facts as lines within the terminal and `WIDEST`, each with its key, a repeated one only once."""
    lines, before = list[str](), ""
    for key, text in facts:
        head = "" if key == before else key
        wrapped = textwrap.wrap(line(text), min(columns(), WIDEST) - KEY - 2, break_on_hyphens=False) or [""]
        lines += [f"  {head if not at else '':<{KEY}}{one}".rstrip() for at, one in enumerate(wrapped)]
        before = key
    return lines


def _row(name: str, what: str, words: str) -> str:
    return f"  {name:<9} {what}: {words}" if what else f"  {name:<9} {words}"


def _plan_text(compiled: Artifacts) -> str:
    body = compiled.plan.spec
    estimate = body.estimate
    samples = count(len(body.samples), "sample")
    if compiled.plan.runner_options:
        here = f"{samples} on this host, free, at most {units.shown_duration(body.duration * len(body.samples))} of measuring"
        return f"{here}, then the machines that the model selects" if compiled.selects_more else here
    budget = "" if body.budget is None else f", of a budget of {dollars(body.budget)}"
    wall = f"{units.shown_duration(estimate.wall)} if all run at once"
    total = dollars(estimate.total)
    if compiled.selects_more:
        most = "no budget" if body.budget is None else f"at most {dollars(compiled.most_usd)}, the budget"
        these = f"measuring the {samples} costs {units.money(estimate.measuring)}, at most {total} with set-up"
        return f"{samples}, then the machines that the model selects: {most}; {these}; {wall}"
    return f"{samples}; measuring costs {units.money(estimate.measuring)}, at most {total} with set-up{budget}; {wall}"


def _unmeasured(compiled: Artifacts) -> list[str]:
    body = compiled.plan.spec
    if compiled.stale:
        keep = ways_to_keep(compiled.standing, compiled.layout.spec) if compiled.standing else []
        return [f"  stale: {compiled.stale}", *_kept(compiled), *(f"  {text}" for text in keep)]
    machines = [sample.machine for sample in body.samples]
    beware = [_row("", "", text) for text in unattended(machines, body.commitment, compiled.layout.name)]
    return [*beware, "  not measured yet: models, menu and manifest follow once it is"]


def entry_text(entry: "Entry") -> str:
    """Format a menu entry: the machine, its price, latency with interval, and cost."""
    gpu = f" with {entry.gpu.label}" if entry.gpu else ""
    return (
        f"{entry.name}{gpu} in {entry.infra}, {entry.price_words} "
        f"({units.shown_month(entry.usd_per_month)}): {latency_of(entry)} {how(entry)}, "
        f"{metrics_text(entry.metrics)}{units.shown_cost(entry.cost)}"
    )


def choice_card(menu: "Menu", application: "Application") -> list[str]:
    """Return the choice as a card of lines: the machine, then latency, cost and metrics, each against its limit."""
    if menu.spec.balanced is None:
        return []
    rows = card(menu, application).rows
    lines = [
        f"{name:<8} {text:<31} {limit:<13} {room}" if limit else f"{name:<8} {text}" for name, text, limit, room in rows
    ]
    return [_row("choice", "", machine_of(menu.spec.balanced)), *(_row("", "", text.rstrip()) for text in lines)]


def metrics_text(metrics: "Mapping[str, MetricValue]") -> str:
    """Format the metrics of a machine with a comma behind each; empty without one."""
    return "".join(f"{metric_text(name, one)}, " for name, one in metrics.items())


def billing_text(menu: "Menu") -> str:
    """Return the billing, and when the machine is up if it is not always."""
    body = menu.spec
    return f"{body.billing} billing" + (f", {body.usage}" if body.usage else "")


def infeasible_text(menu: "Menu") -> list[str]:
    """Return the lines that explain why no machine meets the limits."""
    body = menu.spec
    if not body.admissible:
        return ["  no machine of the catalog is admissible: the catalog's line above says what was left out"]
    if not body.predicted:
        return ["  nothing is measured: no sample counts, or each admissible machine failed"]
    said, *known = why_open(menu) or ["no machine meets the limits"]
    facts = [("", text) for text in known]
    reachable = body.open is not None and body.open.cause != "too slow"
    for miss in () if reachable else body.missed:
        beside = " that meets the other limits" if miss.alone and len(body.limits) > 1 else ""
        bound, needs = shown_miss(miss)
        best = f"the best{beside}, {miss.instance} in {miss.infra}, needs {needs}"
        facts.append(("missed", f"{miss.limit}: limit {bound}; {best}"))
    if (nearest := body.of("nearest")) is not None:
        facts.append(("nearest", entry_text(nearest)))
        facts += [("nearest", sentence(one)) for one in ([] if reachable else nearest.why_not)]
    return [f"  {said}", *rows(facts)]


def as_dict(compiled: Artifacts) -> dict[str, Any]:
    """Return the summary as a dict for JSON."""
    layout, body = compiled.layout, compiled.plan.spec
    chosen = compiled.decision
    return {
        "name": layout.name,
        "files": sorted(str(path) for path in compiled.files),
        "removed": sorted(str(path) for path in compiled.removed),
        "left_out": dict(compiled.admissible.left_out),
        "samples": len(body.samples),
        "estimate_usd": {
            "measuring": body.estimate.measuring,
            "setup": body.estimate.setup,
            "overhead": body.estimate.overhead,
            "total": body.estimate.total,
            "at_most": compiled.most_usd,
        },
        "budget_usd": body.budget,
        "stale": compiled.stale,
        "kept": sorted(str(path) for path in compiled.kept),
        "partial": None if chosen is None or chosen.unfinished is None else chosen.unfinished.state,
        "menu": None if chosen is None else menu_data(chosen.menu),
        "manifest": None if chosen is None or chosen.manifest is None else str(layout.manifest),
    }
