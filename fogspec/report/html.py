"""Render the report page of an application: the answer, the menu to explore, evidence, costs, provenance.

The page is self-contained: its content security policy forbids network access. Every value is escaped for the
language that it is embedded in; the same inputs give the same bytes. Its charts are those that `compile` draws.
"""

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

from fogspec import __version__
from fogspec.base import units
from fogspec.base.templates import render, shipped
from fogspec.base.units import dollars
from fogspec.charts import menu_chart, menu_svg, model_svg
from fogspec.charts.chart import per_hour, per_request
from fogspec.choice.sensitivity import LEVEL, Refits
from fogspec.compile.artifacts import Artifacts
from fogspec.compile.decision import Decision, caveats
from fogspec.report.answer import cost_bar, tiles, why
from fogspec.report.explain import explain, meet_words, refits_of
from fogspec.report.page_data import menu_data
from fogspec.report.page_tables import curve_rows, left_out, measured_table, planned_table, residual_rows

SECTIONS = {
    "menu": "Explore", "why": "Why this machine", "evidence": "Evidence", "samples": "Samples", "costs": "Costs",
    "funnel": "Filters", "models": "Models", "provenance": "Provenance", "spec": "Spec",
}  # fmt: skip
MARKS, MARKS_NARROW = 120, 16  # machines that a chart of the page has marks for, and one for a phone


def page(compiled: Artifacts, command: str, menu_command: str) -> bytes:
    """Return the HTML page, UTF-8 encoded.

    `command` regenerates the page; `menu_command` computes the same menu as the sliders on the page.
    """
    chosen, results = compiled.decision, compiled.results
    refits = None if chosen is None else refits_of(compiled, chosen)
    data = None
    if chosen is not None and len(chosen.choice.front):
        data = {**menu_data(compiled.application, chosen.choice), "command": menu_command}
    script = "".join(
        (shipped("templates") / name).read_text(encoding="utf-8")
        for name in ("report_page.js", *(["report.js"] if data else []))
    )
    there = {"menu": data is not None} | dict.fromkeys(("why", "evidence", "models"), chosen is not None)
    doubts = caveats(chosen.models, chosen.choice) if chosen else [compiled.stale] if compiled.stale else []
    rest = [one for one in chosen.menu.spec.warnings if one not in doubts] if chosen else []
    return render(
        "report.html.j2",
        name=compiled.layout.name,
        title=menu_chart.title_of(chosen.choice) if chosen else f"{compiled.layout.name} is not measured yet",
        facts=menu_chart.facts_of(compiled.application, chosen.choice)
        if chosen
        else compiled.stale or "There is no menu yet.",
        prices=compiled.catalog.about,
        version=__version__,
        command=command,
        requests=units.REQUESTS_TEXT,
        warnings={"first": doubts, "more": rest},
        tiles=tiles(compiled, chosen) if chosen else [],
        sections=[(id, words) for id, words in SECTIONS.items() if there.get(id, True)],
        data=None if data is None else _json(data),
        script=script,
        script_digest=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        menu_picture=_image(compiled, compiled.layout.picture),
        panels=_panels(compiled, chosen, data) if chosen and data else [],
        level=f"{LEVEL:.0%}" if data and any(low is not None for low in data["offers"]["low"]) else "",
        gpus=data is not None and any(data["offers"]["gpu"]),
        menu_note="" if data is None else _menu_note(data),
        why=why(compiled, chosen) if chosen else [],
        explanation=explain(compiled, refits) if chosen is not None else "",
        figures=_figures(compiled, chosen, refits, doubts) if chosen and refits and data else [],
        funnel=_funnel(compiled),
        funnel_words="admissible" if chosen is None else meet_words(chosen.menu.spec.meet),
        measured=results is not None,
        samples=planned_table(compiled.plan) if results is None else measured_table(results),
        models=_models(compiled, refits),
        costs=_costs(compiled),
        cost_bar=cost_bar(compiled),
        provenance=_flat("", _provenance(compiled)),
        source=compiled.layout.relative(compiled.layout.spec),
        spec_text=_text(compiled.inputs.spec_content),
    ).encode()


def _panels(compiled: Artifacts, decision: Decision, data: Mapping[str, Any]) -> list[str]:
    """Return the charts to explore: around the limits, of all machines, and by price per hour."""
    choice = decision.choice
    rows = sorted(data["offers"]["row"], key=lambda row: (not choice.feasible[row], choice.objective[row]))[:MARKS]
    found = []
    for broad, most in ((menu_svg.WIDTH, MARKS), (menu_svg.NARROW, MARKS_NARROW)):
        chart = menu_chart.menu_chart(compiled.application, choice, (), rows[:most])
        views = (
            ("near", per_request(chart), True),
            ("all", per_request(chart), False),
            ("hour", per_hour(chart), False),
        )
        found += [menu_svg.panel(chart, view, near=near, id=f"chart-{id}", broad=broad) for id, view, near in views]
    return found


def _figures(compiled: Artifacts, decision: Decision, refits: Refits, doubts: Sequence[str]) -> list[dict[str, Any]]:
    """Return the charts by vCPUs, and the predictions of each sample from all others."""
    metric = compiled.application.spec.objective.metric
    found = []
    for id, name in (("by-vcpus", None), *([("metric-by-vcpus", metric)] if metric else [])):
        chart = model_svg.size_chart(compiled.application, decision.choice, decision.models, doubts, name)
        if chart.series:
            svg = "".join(model_svg.panel(chart, id, broad) for broad in (menu_svg.WIDTH, menu_svg.NARROW))
            curves = any(one.curve for one in chart.series)
            found.append(
                {"title": f"{model_svg.title_of(chart)}.", "words": f"{chart.facts}.", "svg": svg, "curves": curves}
            )
    points = left_out(decision.models, refits, decision.choice)
    if points:
        inside = sum(low <= measured <= high for _, measured, _, low, high in points)
        missed = sorted(abs(value / measured - 1) for _, measured, value, *_ in points)
        words = (
            f"Each sample, predicted from those of all other machines: at most {missed[-1]:.1%} off; "
            f"{inside} of {len(points)} are in their 90% interval."
        )
        svg = "".join(
            model_svg.left_out_panel(points, "left-out", broad) for broad in (menu_svg.WIDTH, menu_svg.NARROW)
        )
        title = f"Half of the leave-one-out predictions are at most {missed[len(missed) // 2]:.1%} off."
        found.append({"title": title, "words": words, "svg": svg, "curves": False})
    return found


def _menu_note(data: Mapping[str, Any]) -> str:
    parts = [
        f"{data['types']:,} instance types in {data['admissible']:,} offers can be predicted; of each type the cheapest counts."
    ]
    if not data["complete"]:
        shown = len(data["offers"]["row"])
        parts.append(
            f"The page has the {shown:,} types that can win under some weight and limits; another type beats each of the "
            "others in everything."
        )
    if data["relaxed"]:
        parts.append("The spec asks for the relaxed method; this page looks at every machine.")
    return " ".join(parts)


def _json(data: Mapping[str, Any]) -> str:
    """Return JSON for a script element, without characters that HTML could interpret as markup."""
    text = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _image(compiled: Artifacts, path: Any) -> str:
    content = compiled.files.get(path)
    return "" if content is None else "data:image/svg+xml;base64," + base64.b64encode(content).decode()


def _funnel(compiled: Artifacts) -> list[tuple[str, str, str, float]]:
    """Return filter, removed, left, and the width of a bar in percent; its length is logarithmic."""
    funnel = compiled.admissible.funnel
    rows = [("on offer", 0, funnel.offered), *((one.name, one.removed, one.left) for one in funnel.filters)]
    if compiled.decision is not None:
        body = compiled.decision.menu.spec
        rows.append(("can be predicted", body.admissible - body.predicted, body.predicted))
        rows.append(("meets all limits", body.predicted - body.meet, body.meet))
    most = max(funnel.offered, 2)
    share = [round(100 * (left + 1).bit_length() / (most + 1).bit_length()) if left else 0 for *_, left in rows]
    return [
        (name, f"{removed:,}" if removed else "", f"{left:,}", wide)
        for (name, removed, left), wide in zip(rows, share, strict=True)
    ]


def _text(content: bytes) -> str:
    """Return the text of a file with its line ends normalized to LF."""
    return content.decode().replace("\r\n", "\n").replace("\r", "\n")


def _models(compiled: Artifacts, refits: Refits | None) -> dict[str, Any] | None:
    if compiled.decision is None or refits is None:
        return None
    models = compiled.decision.models
    words = (
        "Measured on shapes of one host: the curves below are all that predicts, and how far off they are cannot be said."
        if models.spec.measured_on_local
        else "Predictions come from a Gaussian process over machines, conditioned on all samples. The curves of the paper's "
        "families are fitted beside it for comparison and for the relaxed method."
    )
    return {
        "words": words,
        "curves": curve_rows(models),
        "residuals": residual_rows(models, refits, compiled.decision.choice),
    }


def _costs(compiled: Artifacts) -> list[tuple[str, str]]:
    body, results = compiled.plan.spec, compiled.results
    rows = [
        ("measuring", dollars(body.estimate.measuring)),
        ("with set-up, start and end, at most", dollars(body.estimate.total)),
        *([("with what the model selects, at most", dollars(compiled.most_usd))] if compiled.selects_more else []),
        ("budget", "none" if body.budget is None else dollars(body.budget)),
        ("spent on measuring", dollars(results.spec.spent if results else 0.0)),
    ]
    if compiled.decision is not None and (entry := compiled.decision.menu.spec.balanced) is not None:
        rows += [
            ("the chosen machine, per hour", units.money(entry.price)),
            ("the chosen machine, per month", units.shown_month(entry.usd_per_month).removesuffix("/month")),
            (f"{units.REQUESTS_TEXT} on it", units.money(units.REQUESTS_SHOWN * entry.cost)),
        ]
    return rows


def _provenance(compiled: Artifacts) -> dict[str, Any]:
    if compiled.decision is not None and compiled.decision.manifest is not None:
        return compiled.decision.manifest.model_dump(mode="json")["provenance"]  # type: ignore[no-any-return]
    found = compiled.plan.model_dump(mode="json")["spec"]
    return {"application": found["application"], "catalog": found["catalog"], "builder": {"version": __version__}}


def _flat(name: str, value: Any) -> list[tuple[str, str]]:
    """Return nested values as rows (path, value)."""
    if isinstance(value, Mapping):
        return [row for key, one in value.items() for row in _flat(f"{name}.{key}" if name else str(key), one)]
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [row for i, one in enumerate(value) for row in _flat(f"{name}[{i}]", one)]
    return [(name, "none" if value is None else str(value))]
