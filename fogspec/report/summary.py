"""Summarize a compilation: the derived files, their content, and the next command."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from fogspec.base import units
from fogspec.base.text import count, line, paragraph
from fogspec.base.units import dollars
from fogspec.choice.menu import menu_data, metric_text, shown_miss
from fogspec.choice.rule import latency_limit_s
from fogspec.compile.artifacts import Artifacts
from fogspec.compile.inputs import unpriced
from fogspec.plan.commitment import unattended
from fogspec.plan.design import max_cost_usd
from fogspec.results.schema import own_records
from fogspec.results.standing import ways_to_keep

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fogspec.choice.menu import Entry, Menu, MetricValue
    from fogspec.choice.payoff import Payoff
    from fogspec.compile.decision import Decision
    from fogspec.spec.schema import Application

NOTES = 3


def summary(compiled: Artifacts, following: "Sequence[str]" = ()) -> str:
    """Return the summary of a compiled application as text; `following` are lines about what comes next."""
    layout, body = compiled.layout, compiled.plan.spec
    catalog = body.catalog
    from_ = f"{catalog.source}, {catalog.date}" if catalog.date else catalog.source
    missing = unpriced(compiled.inputs.spec, compiled.catalog)
    if missing is None:
        lines = [layout.name, _row("catalog", from_, count(len(compiled.admissible.offers), "admissible machine"))]
    else:
        lines = [layout.name, _row("catalog", "", missing[0]), _row("", "", missing[1])]
    if compiled.inputs.catalog.about.checked is not None and missing is None:
        lines.append(_row("", "", compiled.inputs.catalog.about.checked))
    if left_out := compiled.admissible.left_out_line():
        lines.append(_row("", "", left_out))
    lines.append(_row("plan", str(layout.plan), _plan_text(compiled)))
    lines += [_row("", "", note) for note in body.notes[:NOTES]]
    if len(body.notes) > NOTES:
        lines.append(_row("", "", f"more notes in the plan: {len(body.notes) - NOTES}"))
    lines.append(_row("tasks", f"{layout.tasks}/", f"{count(len(body.samples), 'SkyPilot task')}, one per machine"))
    decision, results = compiled.decision, compiled.results
    if decision is None or results is None:
        return paragraph([*lines, *_unmeasured(compiled), *following])
    own = own_records(results.spec.samples)
    left = decision.unfinished
    usable = sum(one.nested_in is None for one in decision.models.spec.observations)
    all_of = len({one.id for one in own} | set(() if left is None else left.missing))
    parts = len(results.spec.samples) - len(own)
    beside = f", beside {parts} measured on parts of these machines" if parts else ""
    spent = dollars(results.spec.spent)
    counted = f"{usable} of {all_of} {'' if left is None else 'planned '}samples count"
    lines.append(_row("results", str(layout.results), f"{counted}{beside}; {spent} spent"))
    lines.append(_row("models", str(layout.models), f"{len(decision.models.spec.models)} fitted"))
    beside = f" and {layout.picture.name}" if layout.picture in compiled.files else ""
    lines.append(_row("menu", f"{layout.menu}{beside}", _menu_text(decision.menu)))
    lines += [f"  warning: {text}" for text in decision.menu.spec.warnings]
    return paragraph([*lines, *_outcome(compiled, decision), *following])


def result(compiled: Artifacts) -> str:
    """Return only what came out, as text: the choice, or why there is none."""
    name, decision = compiled.layout.name, compiled.decision
    if decision is None:
        return line(f"{name}: {f'stale: {compiled.stale}' if compiled.stale else 'not measured yet'}")
    return paragraph([name, *_outcome(compiled, decision)])


def _outcome(compiled: Artifacts, decision: "Decision") -> list[str]:
    """Return the lines about the choice and the manifest."""
    layout, left, entry = compiled.layout, decision.unfinished, decision.menu.spec.balanced
    if entry is None:
        return [*infeasible_text(decision.menu), *_kept(compiled)]
    card = choice_card(entry, compiled.application)
    if decision.manifest is None:
        return [*card, *(_kept(compiled) or ["  no manifest: the plan was not carried out"])]
    partial = "" if left is None else f", partial: {left.state}"
    manifest = _row("manifest", str(layout.manifest), f"with {layout.deploy.name}{partial}")
    return [manifest, *card]


def _kept(compiled: Artifacts) -> list[str]:
    """Return that the manifest is stale, if one is on disk and none follows."""
    path = str(compiled.layout.manifest)
    words = "stale: it stays, and apply refuses it, until there is a new one"
    return [_row("manifest", path, words)] if compiled.kept else []


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


def payoff(compiled: Artifacts) -> "Payoff | None":
    """Return what the benchmark will spend and save; None without a volume, and after it was measured."""
    if compiled.application.spec.benchmark.volume is None or compiled.decision is not None:
        return None
    from fogspec.choice.payoff import expected_payoff

    offers = compiled.admissible.offers
    usd = max_cost_usd(compiled.application.spec, offers.price_usd_per_hour)
    return expected_payoff(compiled.application, offers, usd, compiled.inputs.library)


def _unmeasured(compiled: Artifacts) -> list[str]:
    expected, body = payoff(compiled), compiled.plan.spec
    worth = [] if expected is None else [_row("worth", "", expected.line())]
    if compiled.stale:
        keep = ways_to_keep(compiled.standing, compiled.layout.spec) if compiled.standing else []
        return [*worth, f"  stale: {compiled.stale}", *_kept(compiled), *(f"  {text}" for text in keep)]
    machines = [sample.machine for sample in body.samples]
    beware = [_row("", "", text) for text in unattended(machines, body.commitment, compiled.layout.name)]
    return [*worth, *beware, "  not measured yet: models, menu and manifest follow once it is"]


def _menu_text(menu: "Menu") -> str:
    body = menu.spec
    return f"{body.meet} of {count(body.predicted, 'machine')} {'meets' if body.meet == 1 else 'meet'} the limits"


def entry_text(entry: "Entry") -> str:
    """Format a menu entry: the machine, its price, latency with interval, and cost."""
    gpu = f" with {entry.gpu.label}" if entry.gpu else ""
    spot = " spot" if entry.spot else ""
    return (
        f"{entry.instance}{spot}{gpu} in {entry.infra}, {units.shown_price(entry.price)} "
        f"({units.shown_month(entry.usd_per_month)}): {units.shown_duration(entry.latency)}"
        f"{units.shown_interval(entry.interval)} {_how(entry)}, "
        f"{metrics_text(entry.metrics)}{units.shown_cost(entry.cost)}"
    )


def _how(entry: "Entry") -> str:
    return entry.how if entry.measured or entry.nested_in else ", ".join(filter(None, ("predicted", entry.how)))


def choice_card(entry: "Entry", application: "Application") -> list[str]:
    """Return the choice as a card of lines: the machine, then latency, cost and metrics, each against its limit."""
    limits, gpu = application.spec.constraints, entry.gpu
    shape = f"{units.shown(entry.cpus)} vCPU, {units.shown(entry.memory)} GiB"
    machine = (
        f"{entry.instance}{' spot' if entry.spot else ''}  {shape}{f', {gpu.label}' if gpu else ''}  {entry.infra}"
    )
    rows = [
        (
            "latency",
            f"{units.shown_duration(entry.latency)}{units.shown_interval(entry.interval)}",
            latency_limit_s(application),
            entry.latency,
        ),
        ("cost", units.shown_cost(entry.cost), limits.cost, entry.cost),
        *(
            (name, f"{units.shown(one.value)}{one.unit or ''}", one.limit, one.value)
            for name, one in entry.metrics.items()
        ),
    ]
    bounds: dict[str, Callable[[float], str]] = {
        "latency": units.shown_duration,
        "cost": lambda usd: units.money(1000 * usd),
    }
    lines = [_row("choice", "", f"{machine}  {_how(entry)}")]
    for name, text, bound, value in rows:
        limit = "" if bound is None else f"limit {bounds.get(name, units.shown)(bound)}"
        room = "" if bound is None else units.headroom_text(value, bound)
        lines.append(_row("", "", f"{name:<8} {text:<31} {limit:<13} {room}".rstrip()))
    price = f"{units.shown_price(entry.price)}, {units.shown_month(entry.usd_per_month)}"
    met = f"P(all limits) {entry.probability:.3g}" if entry.probability is not None else ""
    return [*lines, _row("", "", f"{'price':<8} {price:<31} {met}".rstrip())]


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
    lines = ["  no machine meets the limits:"]
    for miss in body.missed:
        beside = "of those that meet the other limits, " if miss.alone and len(body.limits) > 1 else ""
        bound, needs = shown_miss(miss)
        lines.append(
            f"  {miss.limit}: limit {bound} is infeasible: {beside}the best machine, {miss.instance} in {miss.infra}, "
            f"needs {needs}"
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
            "at_most": compiled.most_usd,
        },
        "budget_usd": body.budget,
        "payoff_usd": None if expected is None else {"spends": expected.spends_usd, "saves": expected.saves_usd},
        "stale": compiled.stale,
        "kept": sorted(str(path) for path in compiled.kept),
        "partial": None if chosen is None or chosen.unfinished is None else chosen.unfinished.state,
        "menu": None if chosen is None else menu_data(chosen.menu),
        "manifest": None if chosen is None or chosen.manifest is None else str(layout.manifest),
    }
