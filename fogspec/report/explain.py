"""Explain a choice: the funnel, binding limits, influential samples, weak predictions, and close alternatives."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from fogspec.base import units
from fogspec.base.quantities import as_numbers
from fogspec.base.text import count, paragraph
from fogspec.base.units import dollars, rounded
from fogspec.choice.choose import Choice
from fogspec.choice.menu import LIMIT_UNITS, entry_of, floored, menu_data, shown_limit, shown_probability, shown_text
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
from fogspec.choice.shortlist import shortlist
from fogspec.compile.artifacts import Artifacts
from fogspec.compile.decision import Decision
from fogspec.compile.manifest import alternatives
from fogspec.model.fit import Model, targets
from fogspec.numerics.servers import OTHER, SHIFTS
from fogspec.report.summary import billing_text, entry_text, infeasible_text, metrics_text
from fogspec.results.resources import use_line
from fogspec.results.schema import Measured, NestedIn, own_records

MOST_SAMPLES = 3
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
        usd = offers.price_usd_per_hour * body.commitment.paid_s / 3600
        failed = [one.machine for one in decision.models.spec.rejected if one.nested_in is None]
        return cls(
            slacks(decision.choice),
            influences(app, decision.models, refits, decision.choice),
            best_next_sample(app, decision.predicted, failed, usd) if len(offers) else None,
        )


def explain(compiled: Artifacts, refits: Refits | None = None, following: Sequence[str] = ()) -> str:
    """Return the explanation of a measured application, feasible or not, or the plan of an unmeasured one.

    `refits` caches fits without some of the samples, to share them with other analyses; `following` are lines about what
    comes next.
    """
    decision = compiled.decision
    if decision is None:
        return paragraph([*_unmeasured(compiled), *following])
    menu, choice = decision.menu, decision.choice
    found = Analysis.of(compiled, decision, refits or refits_of(compiled, decision))
    local = decision.models.spec.measured_on_local
    lines = [f"{compiled.layout.name}: {menu.spec.objective}, {billing_text(menu)}"]
    if menu.spec.balanced is None:
        lines += [*infeasible_text(menu), *_infeasible(choice)]
    else:
        lines += ["", f"chosen    {entry_text(menu.spec.balanced)}", *_why(choice, menu.spec.scale)]
    lines += ["", "funnel    " + _funnel(compiled, decision)]
    if choice.chosen is not None:
        lines += ["", "limits", *(f"  {_slack_text(b)}" for b in found.bindings)]
        lines += [f"  {_confidence_text(choice, one)}" for one in other_confidences(choice)]
    lines += ["", "model", *_model(decision, found)]
    if found.influences:
        lines += [
            "",
            "samples that matter most",
            *(f"  {_influence_text(one)}" for one in found.influences[:MOST_SAMPLES]),
        ]
    if servers := _servers(compiled):
        lines += ["", "measured on", *(f"  {text}" for text in servers)]
    if used := _used(compiled):
        lines += ["", "used while measured", *(f"  {text}" for text in used)]
    lines += ["", "one more sample", f"  {_next_sample_text(choice, found.next, local)}"]
    if another := _another_server(compiled, decision):
        lines += ["", "another server", f"  {another}"]
    lines += ["", "others", *_others(compiled, decision)]
    if menu.spec.warnings:
        lines += ["", *(f"warning: {text}" for text in menu.spec.warnings)]
    return paragraph([*lines, *(["", *following] if following else [])])


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
        "sure": choice.meets_confidence,
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
        "models": [as_numbers(model) for model in decision.models.spec.models],
        "alternatives": []
        if choice.chosen is None
        else [as_numbers(one) for one in alternatives(choice, choice.chosen)],
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
        "saves_usd": sample.saves_usd,
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


def _why(choice: Choice, scale: dict[str, str]) -> list[str]:
    row = choice.chosen
    if row is None:
        return []
    terms = " and ".join(f"{name} / {shown_text(name, divisor)}" for name, divisor in scale.items())
    pool, meet = int(choice.candidates.sum()), int(choice.feasible.sum())
    among = ": no other machine meets all limits" if meet == 1 else f", among the {meet} machines that meet all limits"
    if pool < meet:
        among = f", among the {pool} measured machines of {meet} that meet all limits"
    lines = [f"why       lowest objective value, {units.shown(float(choice.objective[row]))}, of {terms}{among}"]
    probability = choice.probability(row)
    if probability is not None and choice.bounds:
        where = choice.latency.where_nested(row)
        unmeasured = "not measured" if where is None else f"measured on {where}, not itself"
        how = "measured" if choice.latency.measured[row] else f"{unmeasured}: see the sample below"
        lines.append(
            f"confident all limits are met with probability {floored(probability):.3f} (required {choice.confidence:g}); {how}"
        )
    return lines


def _infeasible(choice: Choice) -> list[str]:
    row = choice.most_probable
    if row is None:
        return []
    probability = choice.probability(row) or 0.0
    offer = choice.offers.machine(row)
    sure = (
        "the model excludes that any does"
        if probability < 1 - choice.confidence
        else "the model cannot exclude that one does"
    )
    met = shown_probability(probability)
    return [f"  most likely to meet all limits: {offer.instance} in {offer.infra}, with probability {met}: {sure}"]


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


def _slack_text(binding: Slack) -> str:
    name = binding.limit
    value, bound = (shown_limit(name, one, binding.unit) for one in (binding.value, binding.bound))
    words = f"{name}: {value} of at most {bound}, {units.headroom_text(binding.value, binding.bound)}"
    words += f"; the choice holds down to {shown_limit(name, binding.required, binding.unit)}"
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
    choice, body = decision.choice, decision.models.spec
    lines = []
    if not body.measured_on_local:
        beside = f" and machine library {body.predictor.priors}" if body.predictor.priors else ""
        lines.append(
            f"  surrogate on {len(body.observations)} samples{beside}{_leave_one_out_text(choice, found.influences)}"
        )
    for one in widest_intervals(choice):
        low, high = map(units.shown_duration, choice.latency.interval(one.row, LEVEL) or (0.0, 0.0))
        lines.append(f"  weak: {choice.offers.instance[one.row]} [{low}, {high}], a factor of {one.ratio:.2f}")
    return lines + [f"  curve: {_model_text(model)}" for model in body.models]


def _server_dicts(compiled: Artifacts) -> list[dict[str, Any]]:
    samples = [] if compiled.results is None else compiled.results.spec.samples
    return [{"id": one.id, **as_numbers(one.server)} for one in own_records(samples) if one.server is not None]


def _servers(compiled: Artifacts) -> list[str]:
    """Return a line for each server that ran samples, as it described itself."""
    samples = [] if compiled.results is None else compiled.results.spec.samples
    own = [f"{one.machine.instance}: {one.server.line()}" for one in own_records(samples) if one.server is not None]
    return own + [_nested_text(one, one.nested_in) for one in samples if one.nested_in is not None]


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
    own = [one for one in decision.models.spec.observations if one.nested_in is None]
    measured = [one.values["latency"] for one in own if one.machine.type_key == machine.type_key]
    usd = compiled.plan.spec.commitment.usd(machine.price)
    chance = SHIFTS.get(machine.cloud_name, OTHER).beyond(DIFFERENT)
    differ = (
        f"servers of one type on {machine.cloud_name} differ by more than {DIFFERENT:.0%} with probability {chance:.2f}"
    )
    if len(measured) > 1:
        apart = max(measured) / min(measured) - 1
        return f"{machine.instance} was measured {len(measured)} times, up to {apart:.1%} apart; {differ}"
    how = "" if compiled.application.spec.benchmark.is_adaptive else "with sampler: adaptive, "
    return f"{differ}; {how}benchmark.servers: 2 measures {machine.instance} on another one, for at most {dollars(usd)}"


def _nested_text(one: Measured, where: NestedIn) -> str:
    """Return what a record of a part of a machine says of the type that it stands for."""
    held = where.confined
    by = "" if held is None else f", vCPUs held by {held.cpus_by}" + (", memory by cgroup" if held.memory_by else "")
    value = one.state if one.latency is None else units.shown_duration(one.latency.mean)
    return f"{one.machine.instance}: {value} on {where.label}, not on {one.machine.instance} itself{by}"


def _leave_one_out_text(choice: Choice, found: list[Influence]) -> str:
    known = sorted(one.missed_by for one in found if one.missed_by == one.missed_by)
    if not known:
        return ""
    covered, posterior = sum(one.covered for one in found), choice.latency.posterior
    factor = 1.0 if posterior is None else posterior.calibration.factor
    widened = f", which is widened by a factor of {factor:.3g} for them" if factor > 1 else ""
    return (
        f": leave-one-out error: median {known[len(known) // 2]:.1%}, max {known[-1]:.1%}; "
        f"{covered} of {len(found)} are within the {LEVEL:.0%} interval{widened}"
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
    saves = "" if found.saves_usd is None else f", which saves {dollars(found.saves_usd)} over the volume"
    if choice.chosen is None:
        return f"{words}meets the limits with probability {shown_probability(choice.probability(found.row) or 0)}"
    if choice.latency.measured[found.row]:
        which = "the choice" if found.row == choice.chosen else "a rival"
        again = f"{which} once more, for one sample may err"
        return f"{words}{again}: betters the choice by {found.gain:.2%} on average{saves}"
    if found.row == choice.chosen:
        return f"{words}it is the choice: measuring it verifies it{saves}"
    better = f"better than the choice with probability {shown_probability(found.probability_better or 0)}"
    return f"{words}{better}, by {found.gain:.2%} on average{saves}"


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


def _others(compiled: Artifacts, decision: Decision) -> list[str]:
    if decision.choice.chosen is None:
        nearest = decision.choice.least_infeasible
        return [] if nearest is None else [f"  nearest   {entry_text(entry_of(decision.choice, nearest))}"]
    rows = shortlist(decision.choice)
    return [
        f"  {a.role:<9} {a.instance} in {a.infra}, {units.shown_price(a.price)}: {units.shown_duration(a.latency)}, "
        f"{metrics_text(a.metrics)}{units.shown_cost(a.cost)}; {a.why_not}{_difference_text(compiled, decision, rows[a.role])}"
        for a in alternatives(decision.choice, decision.choice.chosen)
    ]


def _difference_text(compiled: Artifacts, decision: Decision, row: int) -> str:
    """Return the terms of the objective against the choice, and the probability that the machine is better.

    The text is empty for an infeasible machine.
    """
    choice, app = decision.choice, compiled.application
    if choice.chosen is None or not choice.feasible[row]:
        return ""
    both = zip(parts(app, choice, row), parts(app, choice, choice.chosen), strict=True)
    words = ", ".join(f"{name} {own - best:+.3f}" for (name, own), (_, best) in both)
    better = probability_better(decision.predicted, choice, row)
    return f" ({words})" + (
        "" if better is None else f"; better after all with probability {shown_probability(better)}"
    )


def _unmeasured(compiled: Artifacts) -> list[str]:
    lines = [
        f"{compiled.layout.name}: {compiled.stale or 'not measured yet'}",
        f"funnel    {compiled.admissible.funnel.line()}",
    ]
    lines += ["samples", *(f"  {s.machine.infra} {s.machine.instance}: {s.reason}" for s in compiled.plan.spec.samples)]
    return lines
