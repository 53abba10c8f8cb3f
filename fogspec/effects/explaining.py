"""Why this machine: the funnel, the model, what binds, how far each limit may move, and who else was close."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from fogspec.base import units
from fogspec.choice import Choice
from fogspec.effects.compiling import Compiled
from fogspec.effects.summarising import entry_words, no_words
from fogspec.menu import LEVEL, entry_of, limit_text, rounded
from fogspec.models import Model


@dataclass(frozen=True, slots=True)
class Binding:
    """One limit at the choice: its value, how much room is left, how many machines only it rules out.

    `changes_at` is how far the limit would have to be relaxed for a better machine to be chosen; None if no
    machine that only this limit rules out is better.
    """

    limit: str
    bound: float
    value: float
    rules_out_alone: int
    changes_at: float | None
    changes_to: str | None


def explain(compiled: Compiled) -> str:
    """The explanation of a measured application, infeasible ones included; of an unmeasured one, its plan."""
    if compiled.chosen is None:
        return _unmeasured(compiled)
    menu, choice = compiled.chosen.menu, compiled.chosen.choice
    lines = [f"{compiled.layout.name}: {menu.spec.objective}, {menu.spec.billing} billing"]
    if menu.spec.balanced is None:
        lines += no_words(menu)
    else:
        lines += ["", f"chosen    {entry_words(menu.spec.balanced)}", *_why(choice, menu.spec.scale)]
    lines += ["", "funnel    " + _funnel(compiled)]
    if choice.chosen is not None:
        lines += ["", "limits", *(f"  {_binding_words(b)}" for b in bindings(choice))]
    lines += ["", "models", *(f"  {_model_words(model)}" for model in compiled.chosen.models.spec.models)]
    lines += ["", "others", *_others(compiled)]
    if menu.spec.warnings:
        lines += ["", *(f"warning: {text}" for text in menu.spec.warnings)]
    return "\n".join(lines)


def facts(compiled: Compiled) -> dict[str, Any]:
    """The same for programs."""
    found: dict[str, Any] = {"name": compiled.layout.name, "stale": compiled.stale, "funnel": _funnel_facts(compiled)}
    if compiled.chosen is None:
        return found
    chosen = compiled.chosen
    menu = chosen.menu.spec.model_dump(mode="json")
    return {
        **found,
        **{key: menu[key] for key in ("objective", "balanced", "cheapest", "fastest", "nearest", "missed", "warnings")},
        "limits": [
            {"limit": b.limit, "bound": limit_text(b.limit, b.bound), "value": limit_text(b.limit, b.value),
             "rules_out_alone": b.rules_out_alone, "changes_to": b.changes_to,
             "changes_at": None if b.changes_at is None else limit_text(b.limit, b.changes_at)}
            for b in bindings(chosen.choice)
        ],
        "models": [model.model_dump(mode="json") for model in chosen.models.spec.models],
        "alternatives": [] if chosen.manifest is None else chosen.manifest.model_dump(mode="json")["alternatives"],
    }  # fmt: skip


def bindings(choice: Choice) -> list[Binding]:
    """Every limit at the chosen machine; none when nothing was chosen."""
    row = choice.chosen
    if row is None:
        return []
    found = []
    for name, bound in choice.bounds.items():
        others = choice.eligible.copy()
        for other, limit in choice.bounds.items():
            if other != name:
                others &= choice.values[other] <= limit
        alone = others & ~(choice.values[name] <= bound)
        better = np.flatnonzero(alone & (choice.objective < choice.objective[row]))
        nearest = int(better[np.argmin(choice.values[name][better])]) if len(better) else None
        found.append(Binding(
            name, bound, float(choice.values[name][row]), int(alone.sum()),
            None if nearest is None else float(choice.values[name][nearest]),
            None if nearest is None else str(choice.offers.instance[nearest]),
        ))  # fmt: skip
    return found


def _why(choice: Choice, scale: dict[str, str]) -> list[str]:
    row = choice.chosen
    assert row is not None
    parts = " and ".join(f"{name} / {divisor}" for name, divisor in scale.items())
    lines = [
        f"why       smallest weighed sum, {units.format_number(rounded(float(choice.objective[row])))}, of {parts}, "
        f"among the {int(choice.feasible.sum())} machines that meet all limits"
    ]
    probability = (
        None if "latency" not in choice.bounds else choice.latency.probability_below(row, choice.bounds["latency"])
    )
    if probability is not None:
        lines.append(
            f"sure      the latency limit is met with probability {probability:.3f}; intervals hold {LEVEL:.0%}"
        )
    return lines


def _funnel(compiled: Compiled) -> str:
    assert compiled.chosen is not None
    body = compiled.chosen.menu.spec
    return f"{compiled.admissible.funnel.line()} -> {body.predicted:,} predicted -> {body.meet:,} meet all limits"


def _funnel_facts(compiled: Compiled) -> list[dict[str, Any]]:
    funnel = compiled.admissible.funnel
    return [{"filter": f.name, "removed": f.removed, "left": f.left} for f in funnel.filters]


def _binding_words(binding: Binding) -> str:
    name = binding.limit
    room = (1 - binding.value / binding.bound) if binding.bound else 0.0
    words = f"{name}: {limit_text(name, binding.value)} of at most {limit_text(name, binding.bound)}, {room:.0%} room"
    words += f"; alone it rules out {binding.rules_out_alone} machines"
    if binding.changes_at is not None:
        words += f"; at {limit_text(name, binding.changes_at)} it would let in {binding.changes_to}, which is better"
    elif binding.rules_out_alone:
        words += ", none of them better"
    return words


def _model_words(model: Model) -> str:
    beside = f" with {model.gpu}" if model.gpu else ""
    values = ", ".join(f"{name} = {rounded(value):g}" for name, value in model.coefficients.items())
    error = (
        "its error cannot be told"
        if model.loo_median_error is None or model.loo_max_error is None
        else f"a left-out sample is missed by {model.loo_median_error:.1%} (median), {model.loo_max_error:.1%} at most"
    )
    r2 = "" if model.r2 is None else f"; R² {model.r2:.3f}"
    return f"{model.target}{beside} = {model.formula}, {values}; c = vCPUs, m = GiB; {model.n} samples: {error}{r2}"


def _others(compiled: Compiled) -> list[str]:
    assert compiled.chosen is not None
    chosen = compiled.chosen
    if chosen.manifest is None:
        nearest = chosen.choice.nearest
        return [] if nearest is None else [f"  nearest   {entry_words(entry_of(chosen.choice, nearest))}"]
    return [
        f"  {a.role:<9} {a.instance} in {a.infra}, {units.format_price(a.price)}: {units.format_duration(a.latency)}, "
        f"{units.format_cost(a.cost)}; {a.why_not}"
        for a in chosen.manifest.alternatives
    ]


def _unmeasured(compiled: Compiled) -> str:
    lines = [
        f"{compiled.layout.name}: {compiled.stale or 'not measured yet'}",
        f"funnel    {compiled.admissible.funnel.line()}",
    ]
    lines += ["samples", *(f"  {s.machine.infra} {s.machine.instance}: {s.reason}" for s in compiled.plan.spec.samples)]
    return "\n".join([*lines, f"next: fogspec bench {compiled.layout.spec}"])
