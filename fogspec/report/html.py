"""Render the report page of an application: spec, funnel, samples, models, menu, costs, provenance.

The page is self-contained: its content security policy forbids network access. Every value is escaped for the
language that it is embedded in; the same inputs give the same bytes.
"""

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

from fogspec import __version__
from fogspec.base import units
from fogspec.base.templates import render, shipped
from fogspec.base.units import rounded
from fogspec.choice.sensitivity import Refits
from fogspec.compile.artifacts import Artifacts
from fogspec.report.explain import explain, refits_of
from fogspec.report.page_data import menu_data
from fogspec.report.page_tables import curve_rows, measured_table, planned_table, residual_rows
from fogspec.report.summary import entry_text

SECTIONS = {
    "menu": "Menu", "why": "Why this machine", "funnel": "Funnel", "samples": "Samples", "models": "Models",
    "costs": "Costs", "provenance": "Provenance", "spec": "Spec",
}  # fmt: skip


def page(compiled: Artifacts, command: str, menu_command: str) -> bytes:
    """Return the HTML page, UTF-8 encoded.

    `command` regenerates the page; `menu_command` computes the same menu as the sliders on the page.
    """
    chosen, results = compiled.decision, compiled.results
    refits = None if chosen is None else refits_of(compiled, chosen)
    data = None
    if chosen is not None and len(chosen.choice.front):
        data = {**menu_data(compiled.application, chosen.choice), "command": menu_command}
    scripts = (
        "report_picture.js",
        "report.js",
    )  # the drawing code first: the other script runs as soon as it is parsed
    script = "".join((shipped("templates") / name).read_text(encoding="utf-8") for name in scripts)
    samples = planned_table(compiled.plan) if results is None else measured_table(results)
    there = {"menu": data is not None, "why": chosen is not None, "models": chosen is not None}
    return render(
        "report.html.j2",
        name=compiled.layout.name,
        lead=_lead(compiled),
        version=__version__,
        command=command,
        warnings=chosen.menu.spec.warnings if chosen else [compiled.stale] if compiled.stale else [],
        sections=[(id, words) for id, words in SECTIONS.items() if there.get(id, True)],
        data=None if data is None else _json(data),
        script=script,
        script_digest=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        menu_picture=_image(compiled, compiled.layout.picture),
        latency_picture=_image(compiled, compiled.layout.latencies),
        menu_note="" if data is None else _menu_note(data),
        x_words=_x_words(compiled),
        explanation=explain(compiled, refits) if chosen is not None else "",
        funnel=_funnel(compiled),
        samples=samples,
        models=_models(compiled, refits),
        costs=_costs(compiled),
        provenance=_flat("", _provenance(compiled)),
        source=compiled.layout.relative(compiled.layout.spec),
        spec_text=_text(compiled.inputs.spec_content),
    ).encode()


def _lead(compiled: Artifacts) -> str:
    if compiled.decision is None:
        return f"{compiled.stale or 'not measured yet'}: there is no menu"
    body = compiled.decision.menu.spec
    if body.balanced is None:
        return f"No machine meets the limits; {body.objective}"
    return f"Chosen: {entry_text(body.balanced)}; {body.objective}"


def _x_words(compiled: Artifacts) -> str:
    spec = compiled.application.spec
    return spec.objective.metric or f"{spec.constraints.statistic} latency"


def _menu_note(data: Mapping[str, Any]) -> str:
    parts = [
        f"{data['types']:,} machine types in {data['admissible']:,} offers can be predicted; of each type the cheapest counts."
    ]
    if not data["complete"]:
        shown, faint = len(data["offers"]["row"]), len(data["faint"]["x"])
        parts.append(
            f"The page has the {shown:,} types that can win under some weight and limits; of the others, which another "
            f"type beats in everything, {faint:,} are drawn faintly and no more."
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


def _funnel(compiled: Artifacts) -> list[tuple[str, str, str]]:
    funnel = compiled.admissible.funnel
    rows = [("on offer", "", f"{funnel.offered:,}")]
    rows += [(one.name, f"{one.removed:,}", f"{one.left:,}") for one in funnel.filters]
    if compiled.decision is not None:
        body = compiled.decision.menu.spec
        rows.append(("can be predicted", f"{body.admissible - body.predicted:,}", f"{body.predicted:,}"))
        rows.append(("meets all limits", f"{body.predicted - body.meet:,}", f"{body.meet:,}"))
    return rows


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
    return {"words": words, "curves": curve_rows(models), "residuals": residual_rows(models, refits)}


def _costs(compiled: Artifacts) -> list[tuple[str, str]]:
    body, results = compiled.plan.spec, compiled.results
    rows = [
        ("measuring", units.format_money(body.estimate.measuring)),
        ("with set-up, start and end, at most", units.format_money(body.estimate.total)),
        ("budget", "none" if body.budget is None else units.format_money(body.budget)),
        ("spent on measuring", units.format_money(results.spec.spent if results else 0.0)),
    ]
    if compiled.decision is not None and (entry := compiled.decision.menu.spec.balanced) is not None:
        rows += [
            ("the chosen machine, an hour", units.format_money(entry.price)),
            ("the chosen machine, a month", entry.month.removesuffix("/month")),
            ("1,000 requests on it", units.format_money(rounded(entry.cost * 1000))),
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
