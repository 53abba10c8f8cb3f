"""Explain a choice: the funnel, binding limits, influential samples, weak predictions, and close alternatives."""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from fogspec.base import units
from fogspec.base.console import is_verbose
from fogspec.base.quantities import as_numbers
from fogspec.base.text import count, line, paragraph, shell_command
from fogspec.base.units import LIMIT_UNITS, dollars, rounded, shown_limit, shown_percent
from fogspec.catalog.table import in_its_unit
from fogspec.choice.choose import Choice
from fogspec.choice.menu import Menu, floored, menu_data, shown_probability, shown_text
from fogspec.choice.next_samples import NextSample, best_next_sample, probability_better
from fogspec.choice.sensitivity import (
    LEVEL,
    Influence,
    OtherConfidence,
    Refits,
    Slack,
    influences,
    other_confidences,
    parts,
    slacks,
    widest_intervals,
)
from fogspec.choice.shortlist import alternatives, shortlist
from fogspec.compile.artifacts import Artifacts
from fogspec.compile.decision import Decision
from fogspec.language.fingerprints import LIBRARY
from fogspec.model.fit import Model, targets
from fogspec.numerics.servers import OTHER, SHIFTS
from fogspec.report.facts import baseline_of, latency_of, machine_of
from fogspec.report.summary import WIDEST, billing_text, infeasible_text, metrics_text, rows, warning_lines
from fogspec.results.resources import use_line

MOST_SAMPLES = 3
SHOWN = ("runner-up", "ruled out")  # alternatives that are always shown
DIFFERENT = 0.05  # of the latency: what the servers of one type may differ by unsaid


@dataclass(frozen=True, slots=True)
class Analysis:
    """The analysis behind an explanation: slack of the limits, influence of the samples, and the best next sample."""

    bindings: list[Slack]
    influences: list[Influence]
    next: NextSample | None

    @classmethod
    def of(cls, compiled: Artifacts, decision: Decision, refits: Refits) -> "Analysis":
        """Analyze a decision; refit the model without each sample in turn."""
        offers = compiled.admissible.offers
        app, body = compiled.application, compiled.plan.spec
        usd = body.commitment.usd(offers)
        failed = [one.machine for one in decision.models.rejected]
        return cls(
            slacks(decision.choice),
            influences(app, decision.models, refits, decision.choice),
            best_next_sample(app, decision.predicted, failed, usd) if len(offers) else None,
        )


@in_its_unit
def explain(compiled: Artifacts, refits: Refits | None = None, following: Sequence[str] = ()) -> str:
    """Return the explanation of a measured application, feasible or not, or the plan of an unmeasured one.

    With `--verbose` also what the model rests on: funnel, samples, servers. `refits` caches fits without some of the samples,
    to share them with other analyses; `following` are lines about what comes next.
    """
    decision = compiled.decision
    if decision is None:
        return paragraph([*_unmeasured(compiled), *following])
    menu, choice, verbose = decision.menu, decision.choice, is_verbose()
    found = Analysis.of(compiled, decision, refits or refits_of(compiled, decision))
    local = decision.models.measured_on_local
    lines = [f"{compiled.layout.name}: {menu.spec.objective}, {billing_text(menu)}"]
    if menu.spec.balanced is None:
        lines += infeasible_text(menu)
    else:
        lines += rows(_choice_rows(menu, choice))
    lines += rows([("limits", _slack_text(one, verbose)) for one in found.bindings])
    if verbose:
        lines += rows([("confident", _confidence_text(choice, one)) for one in other_confidences(choice)])
    lines += rows(_others(compiled, decision, verbose))
    if choice.chosen is not None:  # else it is the first that is said
        lines += rows([("one more", _next_sample_text(choice, found.next, local))])
    lines += rows(_details(compiled, decision, found)) if verbose else []
    warnings = menu.spec.warnings
    named = warning_lines(warnings, len(warnings) if verbose else None)
    lines += [part for text in named for part in textwrap.wrap(line(text), WIDEST, subsequent_indent=" " * 4)]
    if not verbose:
        hidden = len(warnings) - len(named)
        again = shell_command("fogspec", "explain", compiled.layout.argument, "-v")
        lines.append(f"  {count(hidden, 'note') + ' and ' if hidden else ''}the model: {again}")
    return paragraph([*lines, *following])


def _choice_rows(menu: Menu, choice: Choice) -> list[tuple[str, str]]:
    """Return the choice with its figures, what it beats, and why it is chosen; none without one."""
    entry, row = menu.spec.balanced, choice.chosen
    if entry is None or row is None:
        return []
    figures = f"{latency_of(entry)}, {metrics_text(entry.metrics)}{units.shown_cost(entry.cost)}"
    rows = [("choice", machine_of(entry)), ("choice", f"{figures}, {entry.price_words}")]
    costs = choice.rule.costs.take(np.array([row]))
    busy_s = float(choice.latency.value[row] * costs.busy_ratio[0])
    if not costs.requests_per_s and not math.isclose(busy_s, choice.latency.value[row], rel_tol=0.005):
        rows.append(
            ("paid", f"{units.shown_duration(busy_s)} for each request that succeeds: so long is the machine busy")
        )
    if words := baseline_of(menu):
        rows.append(("baseline", words))
    pool, meet = int(choice.candidates.sum()), int(choice.feasible.sum())
    among = "no other machine meets all limits" if meet == 1 else f"lowest of the {meet} machines that meet all limits"
    if pool < meet:
        among = f"lowest of {pool} measured machines among the {meet} that meet all limits"
    rows.append(("why", f"objective value {units.shown(float(choice.objective[row]))}: {among}"))
    probability = choice.probability(row)
    if probability is not None and choice.bounds:
        required = "none is required" if choice.confidence is None else f"required {choice.confidence:g}"
        met = f"all limits are met with probability {floored(probability):.3f} ({required})"
        here = choice.probability(row, measured_server=True)
        if is_verbose() and here is not None:
            met += f"; on the server that was measured, with probability {floored(here):.3f}"
        rows.append(("confident", met))
    return rows


def _details(compiled: Artifacts, decision: Decision, found: Analysis) -> list[tuple[str, str]]:
    """Return what the model rests on: the funnel of offers, errors, samples, servers and what was used on them."""
    scale = " + ".join(f"{name} / {shown_text(name, divisor)}" for name, divisor in decision.menu.spec.scale.items())
    rows = [("scale", scale), ("funnel", _funnel(compiled, decision))]
    rows += [("model", text) for text in _model(decision, found)]
    rows += [("samples", _influence_text(one)) for one in found.influences[:MOST_SAMPLES]]
    rows += [("measured on", text) for text in _servers(compiled)]
    rows += [("used", text) for text in _used(compiled)]
    if another := _another_server(compiled, decision):
        rows.append(("servers", another))
    return rows


def as_dict(compiled: Artifacts) -> dict[str, Any]:
    """Return the explanation as a dict for JSON."""
    found: dict[str, Any] = {"name": compiled.layout.name, "stale": compiled.stale, "funnel": _funnel_dict(compiled)}
    if compiled.decision is None:
        return found
    decision = compiled.decision
    analysis = Analysis.of(compiled, decision, refits_of(compiled, decision))
    choice, menu = decision.choice, menu_data(decision.menu)
    return {
        **found,
        **{
            key: menu[key]
            for key in ("objective", "balanced", "cheapest", "fastest", "least", "nearest", "missed", "warnings")
        },
        "confidence": choice.confidence,
        "probability_met": None if choice.chosen is None else choice.probability(choice.chosen),
        "probability_met_on_measured_server": None
        if choice.chosen is None
        else choice.probability(choice.chosen, measured_server=True),
        "likeliest": _likeliest_dict(choice),
        "limits": [_slack_dict(b) for b in analysis.bindings],
        "confidences": [_confidence_dict(choice, one) for one in other_confidences(choice)],
        "samples": [asdict(one) for one in analysis.influences],
        "servers": _server_dicts(compiled),
        "resources": _resource_dicts(compiled),
        "weak": [
            {"instance": str(choice.offers.instance[one.row]), "ratio": one.ratio} for one in widest_intervals(choice)
        ],
        "next_sample": None if analysis.next is None else _next_sample_dict(choice, analysis.next),
        "models": [as_numbers(model) for model in decision.models.curves],
        "alternatives": [] if choice.chosen is None else [as_numbers(one) for one in alternatives(choice)],
    }


def refits_of(compiled: Artifacts, decision: Decision) -> Refits:
    """Return the fits of a decision's model without some of its samples."""
    return Refits(decision.predicted.space, decision.models, targets(compiled.application))


def _likeliest_dict(choice: Choice) -> dict[str, Any] | None:
    row = choice.most_probable
    if row is None:
        return None
    return {"instance": str(choice.offers.instance[row]), "probability_met": choice.probability(row)}


def _next_sample_dict(choice: Choice, sample: NextSample) -> dict[str, Any]:
    return {
        "infra": choice.offers.infra(sample.row),
        "instance": str(choice.offers.instance[sample.row]),
        "gain": sample.gain,
        "probability_better": sample.probability_better,
        "cost_usd": sample.usd,
    }


def _slack_dict(b: Slack) -> dict[str, Any]:
    return {
        "limit": b.limit,
        "unit": LIMIT_UNITS.get(b.limit, b.unit),
        "bound": rounded(b.bound),
        "value": rounded(b.value),
        "needs": rounded(b.required),
        "rules_out_alone": b.rules_out_alone,
        "changes_to": b.changes_to,
        "changes_at": None if b.changes_at is None else rounded(b.changes_at),
    }


def meet_words(count: int) -> str:
    """Return what so many machines do: `meet all limits`."""
    return f"{'meets' if count == 1 else 'meet'} all limits"


def _funnel(compiled: Artifacts, decision: Decision) -> str:
    body = decision.menu.spec
    return (
        f"{compiled.admissible.funnel.line()} -> {body.predicted:,} predicted -> {body.meet:,} {meet_words(body.meet)}"
    )


def _funnel_dict(compiled: Artifacts) -> list[dict[str, Any]]:
    funnel = compiled.admissible.funnel
    return [{"filter": f.name, "removed": f.removed, "left": f.left} for f in funnel.filters]


def _slack_text(binding: Slack, verbose: bool) -> str:
    """Return a limit with its room; `verbose` says which machines it alone excludes."""
    name = binding.limit
    value, bound, required = (
        shown_limit(name, one, binding.unit).removesuffix(f" per {units.REQUESTS_TEXT}")
        for one in (binding.value, binding.bound, binding.required)
    )
    words = f"{name}: {value}, limit {bound}, {units.headroom_text(binding.value, binding.bound)}"
    words += f"; holds down to {required}"
    if not verbose:
        return words
    words += f"; alone it excludes {count(binding.rules_out_alone, 'machine')}"
    if binding.changes_at is not None:
        at = shown_limit(name, binding.changes_at, binding.unit)
        words += f"; at {at} it would let in {binding.changes_to}, which is better"
    elif binding.rules_out_alone:
        words += ", none of them better"
    return words


def _confidence_dict(choice: Choice, one: OtherConfidence) -> dict[str, Any]:
    return {
        "confidence": one.confidence,
        "instance": None if one.row is None else str(choice.offers.instance[one.row]),
        "infra": None if one.row is None else choice.offers.infra(one.row),
        "cost_ratio": one.cost,
        "latency_ratio": one.latency,
    }


def _confidence_text(choice: Choice, one: OtherConfidence) -> str:
    if one.row is None or one.cost is None or one.latency is None:
        return f"at confidence {one.confidence:g} no machine is sure enough to meet all limits"
    cost, latency = _difference(one.cost, "cheaper", "more expensive"), _difference(one.latency, "faster", "slower")
    return f"at confidence {one.confidence:g} the choice would be {choice.offers.instance[one.row]}, {cost}, {latency}"


def _difference(ratio: float, less: str, more: str) -> str:
    return f"{abs(1 - ratio):.0%} {less if ratio < 1 else more}"


def _model(decision: Decision, found: Analysis) -> list[str]:
    choice, models = decision.choice, decision.models
    lines = []
    if not models.measured_on_local:
        library = models.inputs.get(LIBRARY)
        beside = f" and machine library {library}" if library else ""
        lines.append(f"surrogate on {len(models.observations)} samples{beside}{_leave_one_out_text(found.influences)}")
        by_suite = {} if choice.latency.posterior is None else choice.latency.posterior.scales_like
        if words := ", ".join(f"{name} {one:.2f}" for name, one in by_suite.items()):
            lines.append(f"scales like, by weight of the library's programs: {words}")
    for one in widest_intervals(choice):
        low, high = map(units.shown_duration, choice.latency.interval(one.row, LEVEL) or (0.0, 0.0))
        lines.append(f"weak: {choice.offers.instance[one.row]} [{low}, {high}], a factor of {one.ratio:.2f}")
    return lines + [f"curve, for comparison: {_model_text(model)}" for model in models.curves]


def _server_dicts(compiled: Artifacts) -> list[dict[str, Any]]:
    samples = [] if compiled.results is None else compiled.results.spec.samples
    return [{"id": one.id, **as_numbers(one.server)} for one in samples if one.server is not None]


def _servers(compiled: Artifacts) -> list[str]:
    """Return a line for each server that ran samples, as it described itself."""
    samples = [] if compiled.results is None else compiled.results.spec.samples
    return [f"{one.machine.instance}: {one.server.line()}" for one in samples if one.server is not None]


def _used(compiled: Artifacts) -> list[str]:
    """Return a line for each sample of what it used of its machine."""
    samples = [] if compiled.results is None else compiled.results.spec.samples
    return [f"{one.machine.instance}: {use_line(one.resources)}" for one in samples if one.resources is not None]


def _resource_dicts(compiled: Artifacts) -> list[dict[str, Any]]:
    samples = [] if compiled.results is None else compiled.results.spec.samples
    return [
        {"id": one.id, "summary": use_line(one.resources), **one.resources.model_dump(mode="json", exclude_none=True)}
        for one in samples
        if one.resources is not None
    ]


def _another_server(compiled: Artifacts, decision: Decision) -> str | None:
    """Return how the servers of the chosen type differ, and what measuring it on another one costs; None of local machines."""
    row, choice = decision.choice.chosen, decision.choice
    if row is None or not choice.latency.measured[row]:
        return None
    machine = choice.offers.machine(row)
    if machine.is_local:
        return None
    own = decision.models.observations
    measured = [one.values["latency"] for one in own if one.machine.type_key == machine.type_key]
    usd = compiled.plan.spec.commitment.usd(machine)
    chance = SHIFTS.get(machine.cloud_name, OTHER).beyond(DIFFERENT)
    differ = (
        f"servers of one type on {machine.cloud_name} differ by more than {DIFFERENT:.0%} with probability {chance:.2f}"
    )
    if len(measured) > 1:
        apart = max(measured) / min(measured) - 1
        return f"{machine.instance} was measured {len(measured)} times, up to {apart:.1%} apart; {differ}"
    how = "" if compiled.application.spec.sampler == "adaptive" else "with sampler: adaptive, "
    return f"{differ}; {how}benchmark.servers: 2 measures {machine.instance} on another one, for at most {dollars(usd)}"


def _leave_one_out_text(found: list[Influence]) -> str:
    known = sorted(one.missed_by for one in found if one.missed_by == one.missed_by)
    if not known:
        return ""
    covered = sum(one.covered for one in found)
    return (
        f": leave-one-out error: median {known[len(known) // 2]:.1%}, max {known[-1]:.1%}; "
        f"{covered} of {len(found)} are within the {LEVEL:.0%} interval"
    )


def _influence_text(one: Influence) -> str:
    then = f"{one.changes_to} would be chosen" if one.changes_to else "no machine would meet the limits"
    change = f"without it {then}" if one.changes else "without it the choice stays"
    return f"{one.id}: {change}; predictions move by {one.moves:.1%} (median)"


def _next_sample_text(choice: Choice, found: NextSample | None, local: bool) -> str:
    if local:
        return "any machine of the catalog: shapes of one host do not show how fast its machines are"
    if found is None:
        return "no further sample would add information"
    offer = choice.offers.machine(found.row)
    words = f"{offer.instance} in {offer.infra}, at most {dollars(found.usd)}: "
    if choice.latency.measured[found.row]:
        which = "the choice" if found.row == choice.chosen else "a rival"
        again = f"{which} once more, for one sample may err"
        return f"{words}{again}; expected to improve the choice by {shown_percent(found.gain)}"
    if found.row == choice.chosen:
        return f"{words}it is the choice: measuring it verifies it"
    better = f"better than the choice with probability {shown_probability(found.probability_better or 0)}"
    return f"{words}{better}; expected to improve it by {shown_percent(found.gain)}"


def _model_text(model: Model) -> str:
    beside = f" with {model.gpu}" if model.gpu else ""
    values = ", ".join(f"{name} = {rounded(value):g}" for name, value in model.coefficients.items())
    error = (
        "its error is unknown"
        if model.loo_median_error is None or model.loo_max_error is None
        else f"leave-one-out error: median {model.loo_median_error:.1%}, max {model.loo_max_error:.1%}"
    )
    r2 = "" if model.r2 is None else f"; R² {model.r2:.3f}"
    return f"{model.target}{beside} = {model.formula}, {values}; c = vCPUs, m = GiB; {model.n} samples: {error}{r2}"


def _others(compiled: Artifacts, decision: Decision, verbose: bool) -> list[tuple[str, str]]:
    """Return the runner-up and the machine that a limit excludes, of a `verbose` explanation all named ones."""
    if decision.choice.chosen is None:
        return []
    rows = shortlist(decision.choice)
    return [
        (
            a.role,
            f"{a.instance}: {units.shown_duration(a.latency)}, {metrics_text(a.metrics)}{units.shown_cost(a.cost)}; "
            f"{a.why_not}{_difference_text(compiled, decision, rows[a.role], verbose)}",
        )
        for a in alternatives(decision.choice)
        if verbose or a.role in SHOWN
    ]


def _difference_text(compiled: Artifacts, decision: Decision, row: int, verbose: bool) -> str:
    """Return the probability that the machine is better, with `verbose` also the objective's terms against the choice.

    The text is empty for an infeasible machine.
    """
    choice, app = decision.choice, compiled.application
    if choice.chosen is None or not choice.feasible[row]:
        return ""
    both = zip(parts(app, choice, row), parts(app, choice, choice.chosen), strict=True)
    words = ", ".join(f"{name} {own - best:+.3f}" for (name, own), (_, best) in both)
    better = probability_better(decision.predicted, choice, row)
    return (f" ({words})" if verbose else "") + (
        "" if better is None else f"; better with probability {shown_probability(better)}"
    )


def _unmeasured(compiled: Artifacts) -> list[str]:
    lines = [
        f"{compiled.layout.name}: {compiled.stale or 'not measured yet'}",
        f"funnel    {compiled.admissible.funnel.line()}",
    ]
    lines += ["samples", *(f"  {s.machine.infra} {s.machine.instance}: {s.reason}" for s in compiled.plan.spec.samples)]
    return lines
