"""Render the report page of an application: the answer, the machines to explore, evidence and provenance.

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
from fogspec.catalog.table import in_its_unit
from fogspec.charts.menu import facts_of, title_of
from fogspec.choice.menu import entry_of
from fogspec.compile.artifacts import Artifacts
from fogspec.compile.decision import Decision
from fogspec.language.warned import is_decisive, sentence
from fogspec.report.explain import explain, meet_words, refits_of
from fogspec.report.facts import COST, Block, card, machine_of, machines, measured_of
from fogspec.report.page_data import machines_of, rule_data
from fogspec.report.page_tables import curve_table, measured_table, planned_table, residual_table

FIRST = 20  # machines of the table that are shown at first


@in_its_unit
def page(compiled: Artifacts, command: str, menu_command: str) -> bytes:
    """Return the HTML page, UTF-8 encoded.

    `command` regenerates the page; `menu_command` computes the same choice as its controls.
    """
    chosen, results = compiled.decision, compiled.results
    warnings = [] if chosen is None else chosen.menu.spec.warnings
    values: dict[str, Any] = {"title": f"{compiled.layout.name} is not measured yet", "facts": compiled.stale}
    table, data = Block([]), None
    if chosen is not None:
        values = _answer(compiled, chosen)
        table, data = _explored(compiled, chosen, menu_command)
    layout = compiled.layout
    drawn = {"menu": layout.picture, "model": layout.latencies, "metric": layout.metric_picture}
    script = "" if data is None else (shipped("templates") / "report.js").read_text(encoding="utf-8")
    return render(
        "report.html.j2",
        **{"answer": "", "card": Block([]), "explanation": "", "tables": []} | values,
        name=compiled.layout.name,
        prices=compiled.catalog.about,
        version=__version__,
        command=command,
        requests=units.REQUESTS_TEXT,
        decisive=[sentence(one) for one in warnings if is_decisive(one)],
        notes=[sentence(one) for one in warnings if not is_decisive(one)],
        machines=table,
        first=FIRST,
        data=None if data is None else _json(data),
        script=script,
        script_digest=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        pictures={
            name: _inline(compiled.files[path].decode(), name) if path in compiled.files else ""
            for name, path in drawn.items()
        },
        samples=planned_table(compiled.plan) if results is None else measured_table(results),
        measured=results is not None,
        funnel=_funnel(compiled),
        provenance=Block(_flat("", _provenance(compiled)), ("input", "value")),
        source=compiled.layout.relative(compiled.layout.spec),
        spec_text=compiled.inputs.spec_content.decode().replace("\r\n", "\n").replace("\r", "\n"),
    ).encode()


def _answer(compiled: Artifacts, decision: Decision) -> dict[str, Any]:
    """Return the finding, the choice against its limits, why it is chosen, and what the model rests on."""
    menu, refits = decision.menu, refits_of(compiled, decision)
    head = "" if menu.spec.balanced is None else machine_of(menu.spec.balanced)
    return {
        "title": title_of(decision.choice),
        "facts": facts_of(compiled.application, decision.choice),
        "answer": head,
        "card": Block([*card(menu, compiled.application).rows, ("measured", measured_of(compiled), "", "")]),
        "explanation": explain(compiled, refits),
        "tables": [
            ("Curves of the paper's families, for comparison", curve_table(decision.models)),
            ("Each sample, by its curve and by all other samples", residual_table(decision.models, refits)),
        ],
    }


def _explored(compiled: Artifacts, decision: Decision, command: str) -> tuple[Block, dict[str, Any] | None]:
    """Return the table of machines and the data of the rule; none if no machine can be predicted."""
    rows, types = machines_of(decision.choice)
    if not len(rows):
        return Block([]), None
    entries = [entry_of(decision.choice, int(row)) for row in rows]
    table = machines(decision.menu, entries)
    left = [] if types == len(rows) else [f"without {types - len(rows):,} that another one beats in everything"]
    offers = f"of {len(decision.choice.offers):,} offers the cheapest of each of {types:,} instance types"
    data = rule_data(compiled.application, decision.choice, rows)
    metric = next((head for head in table.heads if data["metric"] and head.startswith(data["metric"])), "latency")
    data |= {"command": command, "per": units.REQUESTS_SHOWN, "heads": {"value": metric, "cost": COST}}
    return Block(table.rows, table.heads, [*table.notes, offers, *left], table.numbers), data


def _inline(svg: str, name: str) -> str:
    """Return a picture as part of a page, in which identifiers are unique."""
    for before in ('id="', "url(#"):
        svg = svg.replace(before, f"{before}{name}-")
    return svg


def _json(data: Mapping[str, Any]) -> str:
    """Return JSON for a script element, without characters that HTML could interpret as markup."""
    text = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _funnel(compiled: Artifacts) -> str:
    """Return how many machines each filter leaves, from the catalog to those that meet the limits."""
    found = compiled.admissible.funnel.line()
    if compiled.decision is None:
        return found
    body = compiled.decision.menu.spec
    return f"{found} -> {body.predicted:,} can be predicted -> {body.meet:,} {meet_words(body.meet)}"


def _provenance(compiled: Artifacts) -> dict[str, Any]:
    if compiled.decision is not None and compiled.decision.manifest is not None:
        made = compiled.decision.manifest.model_dump(mode="json")
        return {**made["evidence"], "pins": made["pins"]}
    found = compiled.plan.model_dump(mode="json")["spec"]
    return {"catalog": found["catalog"], "builder": {"version": __version__}}


def _flat(name: str, value: Any) -> list[tuple[str, str]]:
    """Return nested values as rows (path, value)."""
    if isinstance(value, Mapping):
        return [row for key, one in value.items() for row in _flat(f"{name}.{key}" if name else str(key), one)]
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [row for i, one in enumerate(value) for row in _flat(f"{name}[{i}]", one)]
    return [(name, "none" if value is None else str(value))]
