"""Compare the committed manifest with a recompiled one: fields, costs, and the reasons of the changes.

A difference is rendered as text, as JSON, and as Markdown for a pull request.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from fogspec import __version__
from fogspec.audit.compare import Change, change_text, changes, short
from fogspec.audit.freshness import Status
from fogspec.base import units
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.layout import Layout
from fogspec.base.redaction import redacted
from fogspec.base.text import code, count, line, paragraph
from fogspec.base.text import markdown as md
from fogspec.base.units import dollars
from fogspec.bench.quote import most_usd
from fogspec.bench.spending import spending
from fogspec.compile.artifacts import Artifacts
from fogspec.compile.inputs import Inputs
from fogspec.plan.schema import estimate
from fogspec.results.schema import completed
from fogspec.spec import fingerprints
from fogspec.spec.loader import SourceFile

COSTS = {
    "price": ("spec", "price"),
    "month": ("expected", "cost", "month"),
    "request": ("expected", "cost", "predicted"),
    "latency": ("expected", "latency", "predicted"),
}
PAID_RUNNER = "skypilot"  # whose samples cost money
THEN = ", then the machines that the model selects"
KEYS = {
    "price": "price_usd_per_hour",
    "month": "usd_per_month",
    "request": "cost_usd_per_request",
    "latency": "latency_s",
}
SHOWN: dict[str, tuple[str, Callable[[float, int], str]]] = {
    "price": ("machine", units.shown_price),
    "month": ("per month", lambda usd, _: units.shown_month(usd)),
    "request": ("requests", units.shown_cost),
    "latency": ("latency", units.shown_duration),
}


@dataclass(frozen=True, slots=True)
class Due:
    """Ids of the samples to measure first, whether the model then selects more, and the most that all of it costs in USD."""

    samples: tuple[str, ...] = ()
    selects_more: bool = False
    usd: float = 0.0

    def __bool__(self) -> bool:
        return bool(self.samples or self.selects_more)

    @property
    def most(self) -> str:
        """What follows the samples, and the most that all of it costs, for people."""
        return f"{THEN if self.selects_more else ''}, at most {dollars(self.usd)}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """An application's manifest before and after; None stands for a missing manifest.

    `costs` has the changes in price, month, request and latency as (before, after, relative change). `why` lists the
    changed inputs, `due` what must be measured first. `refused` is the reason why nothing can be compiled.
    """

    layout: Layout
    before: Mapping[str, Any] | None
    after: Mapping[str, Any] | None
    changes: tuple[Change, ...] = ()
    costs: Mapping[str, tuple[str, str, str]] = field(default_factory=dict)
    why: tuple[str, ...] = ()
    due: Due = field(default_factory=Due)
    refused: str | None = None

    @property
    def differs(self) -> bool:
        """True if compile would write something that is not on disk."""
        return bool(self.changes or self.why or self.refused)


def difference(status: Status) -> Difference:
    """Compare the committed manifest with the one that compile would write now."""
    inputs, compiled = status.inputs, status.artifacts
    secrets = inputs.application.spec.secrets
    before = redacted(committed_manifest(inputs), secrets)
    if compiled is None:
        reasons = tuple(f"{stage.name}: {text}" for stage in status.stages for text in stage.reasons)
        return Difference(layout=inputs.layout, before=before, after=None, why=reasons, refused=status.refused)
    after = redacted(_manifest_now(compiled), secrets)
    due = to_measure(compiled)
    differing = tuple(significant(changes(before, after))) if after else ()
    why = list(_why(status, before))
    if not differing and not why:
        why = [f"{path} is not what was compiled" for path in status.differing]
    return Difference(
        layout=inputs.layout,
        before=before,
        after=after,
        changes=differing,
        costs=costs(before, after),
        why=tuple(why),
        due=due,
        refused=_no_manifest(compiled),
    )


def to_measure(compiled: Artifacts) -> Due:
    """Return what `fogspec bench` would measure on the machines that cost money, and its price, as bench says it."""
    body, measured, more = compiled.plan.spec, completed(compiled.results), compiled.selects_more
    left = [sample for sample in body.samples if sample.id not in measured]
    names = tuple(sample.id for sample in left)
    if not body.estimate.total or not (left or more):
        return Due(names, more)
    worst_usd, cap_usd = estimate(left, body.commitment).total, None
    if body.budget is not None:
        spent = spending(compiled.layout, compiled.inputs.results).get(PAID_RUNNER, 0.0)
        cap_usd = max(body.budget - spent, 0.0)
    most = most_usd(worst_usd, cap_usd, more)
    return Due(names, more, worst_usd if most is None else most)


def committed_manifest(inputs: Inputs) -> Mapping[str, Any] | None:
    """Return the manifest on disk as plain values, None if it is missing; see `manifest_in` for a damaged one."""
    file = inputs.on_disk.get(inputs.layout.manifest)
    return None if file is None else manifest_in(file)


def read_manifest(layout: Layout) -> Mapping[str, Any] | None:
    """Read the manifest on disk, as `committed_manifest` returns it."""
    files = layout.files
    return manifest_in(SourceFile.read(layout.manifest, files)) if files.is_file(layout.manifest) else None


def manifest_in(file: SourceFile) -> Mapping[str, Any]:
    """Return the manifest in a file as plain values; a damaged one has the single field `damaged`, with the error."""
    try:
        found = file.plain()
    except DiagnosticError as problems:
        return {"damaged": problems.diagnostics[0].message}
    return found if isinstance(found, dict) else {"damaged": "it has no mapping"}


def _manifest_now(compiled: Artifacts) -> Mapping[str, Any] | None:
    """Return the manifest that compile would write, as plain values; None if there is none."""
    if compiled.decision is None or compiled.decision.manifest is None:
        return None
    return compiled.decision.manifest.model_dump(mode="json")


def significant(found: Iterator[Change]) -> list[Change]:
    """Return the significant changes, with digests only if nothing else differs."""
    every = list(found)
    return [one for one in every if not one.is_digest and ".field_digests." not in one.field] or every


def costs(before: Mapping[str, Any] | None, after: Mapping[str, Any] | None) -> dict[str, tuple[str, str, str]]:
    """Return the changes in price, month, request and latency: before, after, and relative change."""
    found = {}
    for name, steps in COSTS.items():
        was, now = _at(before, steps), _at(after, steps)
        if was is None or now is None or was == now:
            continue
        found[name] = (was, now, _relative(was, now))
    return found


def _at(document: Mapping[str, Any] | None, steps: tuple[str, ...]) -> str | None:
    value: Any = document
    for step in steps:
        value = value.get(step) if isinstance(value, Mapping) else None
    return value if isinstance(value, str) else None


def _relative(was: str, now: str) -> str:
    """Format the relative change between two quantities, such as `+12%`; empty if they are not comparable."""
    numbers = []
    for text in (was, now):
        value = number(text)
        if value is None:
            return ""
        numbers.append(value)
    before, after = numbers
    return "" if before <= 0 else f"{(after - before) / before:+.0%}"


def number(text: str) -> float | None:
    """Return a duration, price or cost in base units; None for any other text."""
    for parse in (units.parse_duration_s, units.parse_price_usd_per_hour, units.parse_cost_usd_per_request):
        try:
            return parse(text)
        except units.UnitError:
            continue
    try:
        return units.parse_money_usd(text.removesuffix("/month").replace(",", ""))
    except units.UnitError:
        return None


def _why(status: Status, manifest: Mapping[str, Any] | None) -> Iterator[str]:
    """Yield the changed inputs, by stage, from the first stage that is not fresh."""
    for stage in status.stages:
        if stage.name in ("plan", "results") and (not status.settled(stage) or (stage.notes and not status.fresh)):
            yield from (f"{stage.name}: {text}" for text in (*stage.reasons, *stage.notes))
    if not all(map(status.settled, status.stages)):
        yield from _changed_inputs(status.inputs, manifest)


def _changed_inputs(inputs: Inputs, manifest: Mapping[str, Any] | None) -> Iterator[str]:
    """Yield the inputs of a manifest that have changed since."""
    named = manifest.get("provenance") if manifest else None
    if not isinstance(named, Mapping):
        yield "there is no manifest yet" if manifest is None else "the manifest is damaged"
        return
    application = _mapping(named.get("application"))
    if application.get("digest") != fingerprints.chosen_digest(inputs.application):
        reads = _mapping(application.get("field_digests"))
        now = fingerprints.chosen_fields(inputs.application)
        yield from (f"spec: spec.{name} changed" for name, value in now.items() if reads.get(name) != value)
    was, about = _mapping(named.get("catalog")), inputs.catalog.about
    if was.get("digest") != about.digest:
        before = _named(was.get("source"), was.get("revision"), was.get("date"))
        yield f"catalog: {before} -> {_named(about.source, about.revision, about.date)}"
    version = _mapping(named.get("builder")).get("version")
    if version != __version__:
        yield f"fogspec: {version} -> {__version__}"


def _named(*parts: Any) -> str:
    return " ".join(str(part) for part in parts if part)


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _no_manifest(compiled: Artifacts) -> str | None:
    if compiled.decision is None:
        return compiled.stale or "nothing is measured yet: there is no manifest"
    refusal = compiled.decision.refusal
    return None if refusal is None else refusal.message.removeprefix(f"{compiled.layout.name}: ")


def measuring_text(one: Difference) -> str:
    """Return the samples that a benchmark would measure and their cost, or that none is needed."""
    if not one.due:
        return "no benchmark needed: everything that counts is measured"
    names = one.due.samples
    shown = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
    return f"{count(len(names), 'sample')} to measure first{one.due.most}" + (f": {shown}" if names else "")


def _measuring(one: Difference) -> list[str]:
    """Return what must be measured as one line; none if that is not known, as nothing could be compiled."""
    return [] if one.refused and one.after is None and not one.due else [measuring_text(one)]


def as_text(one: Difference, running: Sequence[Change] | None = None) -> str:
    """Return the difference as text; `running` are the changes from the manifest to the deployed state."""
    lines = [line(f"{one.layout.name}: {headline(one)}")]
    lines += [f"  {change_text(change)}" for change in one.changes]
    lines += [f"  cost: {line(cost)}" for cost in _cost_lines(one)]
    if one.differs:
        lines += [f"  why: {line(reason)}" for reason in one.why]
        lines += [f"  {line(text)}" for text in _measuring(one)]
    if running is not None:
        lines.append(f"  running: {'as the manifest says' if not running else 'not what the manifest says'}")
        lines += [f"    {change_text(change)}" for change in running]
    return paragraph(lines)


def headline(one: Difference) -> str:
    """Return a one-line summary of the difference."""
    if one.refused and one.after is None:
        return f"cannot be compiled to a manifest now: {one.refused}"
    if one.before is None:
        return "a new manifest"
    if not one.changes:
        return "the manifest is what compile would write" + (", other files differ" if one.why else "")
    was, now = (_machine(document) for document in (one.before, one.after))
    return f"{was} -> {now}" if was != now else f"{was} stays"


def _machine(document: Mapping[str, Any] | None) -> str:
    spec = document.get("spec") if document else None
    if not isinstance(spec, Mapping):
        return "nothing"
    return f"{spec.get('instance')} in {spec.get('infra')}"


def _cost_lines(one: Difference) -> Iterator[str]:
    for name, was, now, relative in _shown_costs(one):
        yield f"{name} {was} -> {now}{f' ({relative})' if relative else ''}"


def _shown_costs(one: Difference) -> Iterator[tuple[str, str, str, str]]:
    """Yield each change of a cost for people: what it is of, before, after, and the relative change."""
    for key, (was, now, relative) in one.costs.items():
        name, show = SHOWN[key]
        before, after = number(was), number(now)
        if before is None or after is None:
            yield name, was, now, relative
        else:
            yield name, *units.shown_apart(before, after, show), relative


def as_dict(one: Difference, running: Sequence[Change] | None = None) -> dict[str, Any]:
    """Return the difference as a dict for JSON."""
    return {
        "name": one.layout.name,
        "differs": one.differs,
        "refused": one.refused,
        "changes": [_change(change) for change in one.changes],
        "costs": {
            KEYS[name]: {"before": number(was), "after": number(now)} for name, (was, now, _) in one.costs.items()
        },
        "why": list(one.why),
        "to_measure": list(one.due.samples),
        "measuring_usd_at_most": one.due.usd,
        "running": None if running is None else [_change(change) for change in running],
    }


def _change(change: Change) -> dict[str, Any]:
    return {"field": change.field, "before": change.before, "after": change.after}


def markdown(one: Difference, running: Sequence[Change] | None = None) -> str:
    """Return the difference as Markdown, for a pull request."""
    lines = [f"### {md(one.layout.name)}: {md(headline(one))}", ""]
    if one.costs:
        lines += ["| | before | after | |", "|--|--|--|--|"]
        lines += [f"| {name} | {md(was)} | {md(now)} | {md(rel)} |" for name, was, now, rel in _shown_costs(one)]
        lines.append("")
    if one.differs:
        lines += [*(f"- {md(text)}" for text in (*one.why, *_measuring(one))), ""]
    if one.changes:
        lines += [
            f"<details><summary>{len(one.changes)} fields differ</summary>",
            "",
            "| field | before | after |",
            "|--|--|--|",
        ]
        lines += [
            f"| {code(change.field)} | {md(short(change.before))} | {md(short(change.after))} |"
            for change in one.changes
        ]
        lines += ["", "</details>", ""]
    if running is not None:
        lines += [f"What runs {'is what the manifest says.' if not running else 'differs from the manifest:'}", ""]
        lines += [f"- {md(change_text(change))}" for change in running]
    return "\n".join(lines).rstrip()
