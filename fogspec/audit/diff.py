"""What is committed against what compile would write now: field by field, what it costs, and why it changed."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fogspec.audit.compare import Change, changes
from fogspec.audit.freshness import status
from fogspec.base import units
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import FogspecError
from fogspec.base.layout import Layout
from fogspec.base.redaction import redacted
from fogspec.base.units import dollars
from fogspec.catalog.table import Catalog
from fogspec.compile.compiler import Artifacts, compile_application
from fogspec.plan.schema import lifetime_s
from fogspec.results.schema import completed
from fogspec.spec.loader import LoadedSpec, read_plain

COSTS = {
    "price": ("spec", "price"),
    "month": ("expected", "cost", "month"),
    "request": ("expected", "cost", "predicted"),
    "latency": ("expected", "latency", "predicted"),
}


@dataclass(frozen=True, slots=True)
class Difference:
    """One application's manifest before and after; None for one that is not there.

    `costs` has what changed of price, month, request and latency: (before, after, difference in words). `why` names
    what changed of the inputs, `to_measure` the samples that a benchmark would have to measure first, for at most
    `measuring_usd`; `refused` says why nothing can be compiled.
    """

    layout: Layout
    before: Mapping[str, Any] | None
    after: Mapping[str, Any] | None
    changes: tuple[Change, ...]
    costs: Mapping[str, tuple[str, str, str]]
    why: tuple[str, ...]
    to_measure: tuple[str, ...] = ()
    measuring_usd: float = 0.0
    refused: str | None = None

    @property
    def differs(self) -> bool:
        """Whether anything would be written that is not there."""
        return bool(self.changes or self.why or self.refused)


def difference(loaded: LoadedSpec, catalog: Catalog) -> Difference:
    """The committed manifest against the one that compile would write now; nothing is written."""
    application = loaded.application
    layout = Layout.of(loaded.path, application.metadata.name)
    before = read_manifest(layout)
    secrets = application.spec.secrets
    try:
        compiled = compile_application(application, loaded.path, catalog)
    except FogspecError as refused:
        told = redacted(before, secrets)
        return Difference(layout, told, None, (), {}, (), refused=refused.message)
    after = manifest_now(compiled)
    old, new = redacted(before, secrets), redacted(after, secrets)
    left = [sample for sample in compiled.plan.spec.samples if sample.id not in completed(compiled.results)]
    body = compiled.plan.spec
    worst = sum(sample.machine.price for sample in left) * lifetime_s(body.duration, body.setup_timeout) / 3600
    return Difference(
        layout, old, new, tuple(telling(changes(old, new))) if after else (), costs(old, new), tuple(_why(loaded, catalog)),
        tuple(sample.id for sample in left), worst, _no_manifest(compiled),
    )  # fmt: skip


def read_manifest(layout: Layout) -> Mapping[str, Any] | None:
    """The manifest on disk as plain values, None where there is none; damaged, it has one field that says so."""
    return manifest_in(layout.manifest) if layout.manifest.is_file() else None


def manifest_in(path: Path, content: bytes | None = None) -> Mapping[str, Any]:
    """The manifest in a file, or in what the file was; damaged, it has one field that says so."""
    try:
        found = read_plain(path, content)
    except DiagnosticError as problems:
        return {"damaged": problems.diagnostics[0].message}
    return found if isinstance(found, dict) else {"damaged": "it has no mapping"}


def manifest_now(compiled: Artifacts) -> Mapping[str, Any] | None:
    """The manifest that compile would write, as a reader of the file would see it."""
    content = compiled.files.get(compiled.layout.manifest)
    if content is None:
        return None
    found: Mapping[str, Any] = read_plain(compiled.layout.manifest, content)
    return found


def telling(found: Iterator[Change]) -> list[Change]:
    """The changes that say something: digests only where nothing else differs."""
    every = list(found)
    return [one for one in every if not one.is_digest and ".field_digests." not in one.field] or every


def costs(before: Mapping[str, Any] | None, after: Mapping[str, Any] | None) -> dict[str, tuple[str, str, str]]:
    """What changed of price, month, request and latency: before, after, and the difference in words."""
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
    """`+12 %`, of two quantities in the same words."""
    numbers = []
    for text in (was, now):
        value = _number(text)
        if value is None:
            return ""
        numbers.append(value)
    before, after = numbers
    return "" if before <= 0 else f"{(after - before) / before:+.0%}"


def _number(text: str) -> float | None:
    """A duration, price or cost in base units; None for what is none of these."""
    for parse in (units.parse_duration_s, units.parse_price_usd_per_hour, units.parse_cost_usd_per_request):
        try:
            return parse(text)
        except units.UnitError:
            continue
    try:
        return units.parse_money_usd(text.removesuffix("/month").replace(",", ""))
    except units.UnitError:
        return None


def _why(loaded: LoadedSpec, catalog: Catalog) -> Iterator[str]:
    """Which input changed, stage by stage, from the first that is not fresh."""
    found = status(loaded.application, loaded.path, catalog)
    for stage in found.stages:
        if stage.name in ("plan", "results") and (stage.state != "fresh" or stage.notes):
            yield from (f"{stage.name}: {text}" for text in (*stage.reasons, *stage.notes))
    if not any(stage.state != "fresh" for stage in found.stages):
        return
    yield from _inputs(loaded, catalog, read_manifest(found.layout))


def _inputs(loaded: LoadedSpec, catalog: Catalog, manifest: Mapping[str, Any] | None) -> Iterator[str]:
    """Which of the inputs that a manifest names are others now."""
    from fogspec.spec import fingerprints

    named = manifest.get("provenance") if manifest else None
    if not isinstance(named, Mapping):
        yield "there is no manifest yet"
        return
    application = _mapping(named.get("application"))
    if application.get("digest") != fingerprints.chosen_digest(loaded.application):
        reads = _mapping(application.get("field_digests"))
        fields = [
            name for name, now in fingerprints.chosen_fields(loaded.application).items() if reads.get(name) != now
        ]
        yield from (f"spec: spec.{name} changed" for name in fields)
    was, about = _mapping(named.get("catalog")), catalog.about
    if was.get("digest") != about.digest:
        yield (f"catalog: {_named(was.get('source'), was.get('revision'), was.get('date'))} -> "
               f"{_named(about.source, about.revision, about.date)}")  # fmt: skip
    from fogspec import __version__

    version = _mapping(named.get("builder")).get("version")
    if version != __version__:
        yield f"fogspec: {version} -> {__version__}"


def _named(*parts: Any) -> str:
    return " ".join(str(part) for part in parts if part)


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _no_manifest(compiled: Artifacts) -> str | None:
    if compiled.chosen is None:
        return compiled.stale or "nothing is measured yet: there is no manifest"
    return None if compiled.chosen.manifest is not None else "no machine meets the limits"


def measuring_words(one: Difference) -> str:
    """Whether a benchmark is needed, and which samples it would measure."""
    if not one.to_measure:
        return "no benchmark needed: everything that counts is measured"
    count = len(one.to_measure)
    shown = ", ".join(one.to_measure[:6]) + (f" and {count - 6} more" if count > 6 else "")
    return f"{count} sample{'' if count == 1 else 's'} to measure first, at most {dollars(one.measuring_usd)}: {shown}"
