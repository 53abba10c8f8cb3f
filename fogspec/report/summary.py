"""Summarize a compilation: the derived files, their content, and the next command."""

from typing import TYPE_CHECKING, Any

from fogspec.base import units
from fogspec.base.text import paragraph, shell_command
from fogspec.base.units import dollars
from fogspec.compile.artifacts import Artifacts
from fogspec.plan.commitment import unattended
from fogspec.plan.design import max_cost_usd
from fogspec.results.schema import own_records

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fogspec.choice.menu import Entry, Menu, MetricValue
    from fogspec.choice.payoff import Payoff

NOTES = 3


def summary(compiled: Artifacts) -> str:
    """Return the summary of a compiled application as text."""
    layout, body = compiled.layout, compiled.plan.spec
    catalog = body.catalog
    from_ = f"{catalog.source}, {catalog.date}" if catalog.date else catalog.source
    lines = [layout.name, _row("catalog", from_, f"{len(compiled.admissible.offers)} admissible machines")]
    if compiled.inputs.catalog.about.checked is not None:
        lines.append(_row("", "", compiled.inputs.catalog.about.checked))
    if left_out := compiled.admissible.left_out_line():
        lines.append(_row("", "", left_out))
    lines.append(_row("plan", str(layout.plan), _plan_text(compiled)))
    lines += [_row("", "", note) for note in body.notes[:NOTES]]
    if len(body.notes) > NOTES:
        lines.append(_row("", "", f"more notes in the plan: {len(body.notes) - NOTES}"))
    lines.append(_row("tasks", f"{layout.tasks}/", f"{len(body.samples)} SkyPilot tasks, one a machine"))
    decision, results = compiled.decision, compiled.results
    if decision is None or results is None:
        return paragraph([*lines, *_unmeasured(compiled)])
    own = own_records(results.spec.samples)
    usable, all_of = sum(one.nested_in is None for one in decision.models.spec.observations), len(own)
    parts = len(results.spec.samples) - len(own)
    beside = f", beside {parts} measured on parts of these machines" if parts else ""
    spent = dollars(results.spec.spent)
    lines.append(_row("results", str(layout.results), f"{usable} of {all_of} samples count{beside}; {spent} spent"))
    lines.append(_row("models", str(layout.models), f"{len(decision.models.spec.models)} fitted"))
    beside = f" and {layout.picture.name}" if layout.picture in compiled.files else ""
    lines.append(_row("menu", f"{layout.menu}{beside}", _menu_text(decision.menu)))
    lines += [f"  warning: {text}" for text in decision.menu.spec.warnings]
    entry = decision.menu.spec.balanced
    if decision.manifest is None or entry is None:
        return paragraph([*lines, *infeasible_text(decision.menu)])
    lines.append(_row("manifest", str(layout.manifest), f"with {layout.deploy.name}"))
    lines.append(_row("choice", entry_text(entry), decision.menu.spec.objective))
    return paragraph(
        [*lines, f"next: review {layout.manifest}; {shell_command('fogspec', 'explain', layout.spec)} says why"]
    )


def _row(name: str, what: str, words: str) -> str:
    return f"  {name:<9} {what}: {words}" if what else f"  {name:<9} {words}"


def _plan_text(compiled: Artifacts) -> str:
    body = compiled.plan.spec
    estimate = body.estimate
    count = f"{len(body.samples)} samples"
    if estimate.total == 0:
        return f"{count} on this host, free, at most {units.format_duration(body.duration * len(body.samples))} of measuring"
    budget = "" if body.budget is None else f" of a budget of {dollars(body.budget)}"
    wall = f"{units.format_duration(estimate.wall)} if all run at once"
    cents = f"{estimate.measuring * 100:.3f}".rstrip("0").rstrip(".")
    total = dollars(estimate.total)
    return f"{count}; measuring costs {cents} cents, with set-up, start and end at most {total}{budget}; {wall}"


def payoff(compiled: Artifacts) -> "Payoff | None":
    """Return what the benchmark will spend and save; None without a volume, and after it was measured."""
    if compiled.application.spec.benchmark.volume is None or compiled.decision is not None:
        return None
    from fogspec.choice.payoff import expected_payoff

    offers = compiled.admissible.offers
    usd = max_cost_usd(compiled.application.spec, offers.price_usd_per_hour)
    return expected_payoff(compiled.application, offers, usd, compiled.inputs.library)


def _unmeasured(compiled: Artifacts) -> list[str]:
    command = compiled.plan.bench_command(compiled.layout.spec)
    expected = payoff(compiled)
    worth = [] if expected is None else [_row("worth", "", expected.line())]
    return [*worth, *_next(compiled, command)]


def _next(compiled: Artifacts, command: str) -> list[str]:
    if compiled.stale:
        return [f"  stale: {compiled.stale}", f"next: {command}"]
    body = compiled.plan.spec
    machines = [sample.machine for sample in body.samples]
    beware = [_row("", "", text) for text in unattended(machines, body.commitment, compiled.layout.name)]
    return [*beware, "  not measured yet: models, menu and manifest follow once it is", f"next: {command}"]


def _menu_text(menu: "Menu") -> str:
    body = menu.spec
    return f"{body.meet} of {body.predicted} machines meet the limits"


def entry_text(entry: "Entry") -> str:
    """Format a menu entry: the machine, its price, latency with interval, and cost."""
    interval = ""
    if entry.interval is not None:
        low, high = (units.format_duration(end) for end in entry.interval)
        interval = f" [{low}, {high}]"
    gpu = f" with {entry.gpu.label}" if entry.gpu else ""
    how = entry.how if entry.measured or entry.nested_in else ", ".join(filter(None, ("predicted", entry.how)))
    spot = " spot" if entry.spot else ""
    return (
        f"{entry.instance}{spot}{gpu} in {entry.infra}, {units.format_price(entry.price)} ({entry.month}): "
        f"{units.format_duration(entry.latency)}{interval} {how}, {metrics_text(entry.metrics)}{units.format_cost(entry.cost)}"
    )


def metrics_text(metrics: "Mapping[str, MetricValue]") -> str:
    """Format the metrics of a machine with a comma behind each; empty without one."""
    from fogspec.choice.menu import metric_text

    return "".join(f"{metric_text(name, one)}, " for name, one in metrics.items())


def billing_text(menu: "Menu") -> str:
    """Return the billing, and when the machine is up if it is not always."""
    body = menu.spec
    return f"{body.billing} billing" + (f", {body.usage}" if body.usage else "")


def infeasible_text(menu: "Menu") -> list[str]:
    """Return the lines that explain why no machine meets the limits."""
    body = menu.spec
    if not body.predicted:
        return ["  nothing can be said of any machine: no sample counts, or each admissible machine failed"]
    lines = ["  no machine meets the limits:"]
    for miss in body.missed:
        beside = "of those that meet the other limits, " if miss.alone and len(body.limits) > 1 else ""
        lines.append(
            f"  {miss.limit}: limit {miss.bound} is infeasible: {beside}the best machine, {miss.instance} in {miss.infra}, "
            f"needs {miss.nearest_value}, {miss.factor:.3g} times the limit"
        )
    if body.nearest is not None:
        lines.append(f"  nearest on all limits: {entry_text(body.nearest)}; {body.nearest.why_not}")
    return lines


def as_dict(compiled: Artifacts) -> dict[str, Any]:
    """Return the summary as a dict for JSON."""
    layout, body = compiled.layout, compiled.plan.spec
    chosen, expected = compiled.decision, payoff(compiled)
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
        },
        "budget_usd": body.budget,
        "payoff_usd": None if expected is None else {"spends": expected.spends_usd, "saves": expected.saves_usd},
        "stale": compiled.stale,
        "menu": None if chosen is None else chosen.menu.spec.model_dump(mode="json"),
        "manifest": None if chosen is None or chosen.manifest is None else str(layout.manifest),
    }
