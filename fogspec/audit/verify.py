"""Recompute the chain behind a manifest: every link from the spec to the pinned machine, byte for byte.

Each link is checked separately, so that the report locates the break.
"""

import io
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from fogspec import __version__
from fogspec.audit.compare import change_text, changes_in_file
from fogspec.base import digest
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import FogspecError, InvalidInput
from fogspec.base.text import count, paragraph, restore_command, shell_command
from fogspec.compile.artifacts import Artifacts
from fogspec.compile.bundle import ManifestBundle
from fogspec.compile.compiler import try_compile
from fogspec.plan.schema import digest_without_budget
from fogspec.results.io import raw_timings
from fogspec.results.requests import RecordRules, parse_requests
from fogspec.results.schema import LatencySummary, Measured, Results
from fogspec.results.statistics import summary, weights
from fogspec.spec import fingerprints
from fogspec.spec.lockfile import listed

SHOWN = 8


@dataclass(frozen=True, slots=True)
class Check:
    """A link of the chain: the compared files, and how they break it; `notes` do not break the link."""

    name: str
    what: str
    breaks: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def state(self) -> Literal["holds", "breaks"]:
        """The result in one word."""
        return "breaks" if self.breaks else "holds"


def verify(opened: ManifestBundle, compiled: Artifacts | FogspecError | None = None) -> list[Check]:
    """Check every link of the chain of a manifest, from the spec to the deployed files.

    `compiled` is what `try_compile` returned for its inputs, if that is known.
    """
    layout, results = opened.layout, opened.inputs.results
    named = opened.manifest.provenance
    links = [_spec(opened), _catalog(opened), _beside(opened)]
    try:
        compiled = compiled or try_compile(opened.inputs)
    except DiagnosticError as problems:
        why = tuple(one.message for one in problems.diagnostics)
        return [*links, Check("results", str(layout.results), why), *_later("results", "models", "manifest")]
    if isinstance(compiled, FogspecError):
        return [
            *links,
            Check("plan", str(layout.plan), (compiled.message, *compiled.hints)),
            *_later("plan", "results", "models", "manifest"),
        ]
    links += [_plan(opened, compiled), _results(opened, compiled, results)]
    if results is None or compiled.results is None:
        return [*links, *_later("results", "models", "manifest")]
    links.append(_timings(opened, results))
    links.append(_bytes("models", layout.models, compiled, named.models.digest))
    links.append(_bytes("menu", layout.menu, compiled))
    links.append(_bytes("manifest", layout.manifest, compiled, notes=_builder(opened)))
    return [*links, _deployment(opened, compiled)]


def _later(first: str, *names: str) -> list[Check]:
    return [Check(name, "", (f"cannot be recomputed: the link {first} breaks",)) for name in names if name != first]


def _spec(opened: ManifestBundle) -> Check:
    application, reference = opened.loaded.application, opened.manifest.provenance.application
    if fingerprints.chosen_digest(application) == reference.digest:
        return Check("spec", reference.path)
    fields = [
        name
        for name, now in fingerprints.chosen_fields(application).items()
        if reference.field_digests.get(name) != now
    ]
    changed = ", ".join(f"spec.{name}" for name in fields) or "what the choice reads of it"
    return Check("spec", reference.path, (f"{changed} changed since the manifest was made",))


def _catalog(opened: ManifestBundle) -> Check:
    named, now = opened.manifest.provenance.catalog, opened.inputs.catalog.about
    what = " ".join(filter(None, (now.source, now.revision, now.date)))
    if named.digest == now.digest:
        return Check("catalog", what)
    was = " ".join(filter(None, (named.source, named.revision, named.date)))
    return Check("catalog", what, (f"the manifest was made from another catalog: {was}, {named.digest}",))


def _beside(opened: ManifestBundle) -> Check:
    """Check the files and directories that the spec names and the lock pins."""
    layout, inputs = opened.layout, opened.inputs
    if inputs.pins is None:
        return Check(
            "lock", str(layout.lock), (), ("there is no lock: images and files beside the spec are not pinned",)
        )
    return Check("lock", str(layout.lock), tuple(listed(inputs.drifted, "{} is not what the lock says", SHOWN)))


def _plan(opened: ManifestBundle, compiled: Artifacts) -> Check:
    layout, named = opened.layout, opened.manifest.provenance.plan
    breaks = _differing(layout.plan, compiled)
    for sample in compiled.plan.spec.samples:
        breaks += _differing(layout.task(sample.id), compiled)
    if not breaks:
        found = digest_without_budget(compiled.plan)
        if found != named.digest:
            breaks.append(f"the manifest was made from another plan: {named.digest}, not {found}")
    return Check("plan", f"{layout.plan} and {count(len(compiled.plan.spec.samples), 'task')}", tuple(breaks[:SHOWN]))


def _results(opened: ManifestBundle, compiled: Artifacts, results: Results | None) -> Check:
    layout, named = opened.layout, opened.manifest.provenance.results
    if results is None:
        return Check("results", str(layout.results), ("it is missing",))
    breaks = [] if compiled.stale is None else [compiled.stale]
    if results.integrity != named.digest:
        breaks.append(f"the manifest was made from other results: {named.digest}, not {results.integrity}")
    return Check("results", str(layout.results), tuple(breaks))


def _timings(opened: ManifestBundle, results: Results) -> Check:
    """Check that the raw timings are unmodified and that the records follow from them."""
    layout = opened.layout
    rules = RecordRules.of(opened.loaded.application)
    kept = [(record, record.timings.path) for record in results.spec.samples if record.timings is not None]
    folder = layout.results.parent
    breaks = [wrong for record, path in kept for wrong in _record(record, folder, path, rules)]
    without = len(results.spec.samples) - len(kept)
    notes = (f"{without} of {len(results.spec.samples)} records have no raw timings",) if without else ()
    return Check("timings", f"{count(len(kept), 'file')} of raw timings", tuple(breaks[:SHOWN]), notes)


def _record(record: Measured, folder: Path, timings: str, rules: RecordRules) -> Iterator[str]:
    """Yield the differences between a record and its raw timings, a file relative to `folder`."""
    path = folder / timings
    try:
        content = raw_timings(record, folder)
    except InvalidInput as wrong:
        yield wrong.message
        return
    requests = parse_requests(io.BytesIO(content), rules)
    latency = summary(requests.latencies_s, weights(requests.scenarios, rules.scenarios))
    now = record.model_copy(
        update={"requests": len(requests.latencies_s), "failed_requests": requests.failed, "latency": latency}
    )
    for name in ("requests", "failed_requests", "latency"):
        was, found = getattr(record, name), getattr(now, name)
        if not _same(was, found):
            yield f"{record.id}: {name} is {was} in the record, {found} from {path}"


def _same(was: Any, found: Any) -> bool:
    """Compare values, numbers to nine digits: another version may sum in another order."""
    if isinstance(was, LatencySummary) and isinstance(found, LatencySummary):
        return all(_same(getattr(was, name), getattr(found, name)) for name in LatencySummary.model_fields)
    if isinstance(was, float) and isinstance(found, float):
        return math.isclose(was, found, rel_tol=1e-9)
    return bool(was == found)


def _bytes(name: str, path: Path, compiled: Artifacts, named: str | None = None, notes: tuple[str, ...] = ()) -> Check:
    breaks = _differing(path, compiled)
    if not breaks and named is not None and digest.of_bytes(compiled.files.get(path, b"")) != named:
        breaks.append(f"the manifest was made from another one: {named}")
    return Check(name, str(path), tuple(breaks[:SHOWN]), notes)


def _differing(path: Path, compiled: Artifacts) -> list[str]:
    file, now = compiled.inputs.on_disk.get(path), compiled.files.get(path)
    if file is None:
        return [f"{path} is missing"]
    if now is None:
        return [f"{path} no longer follows from spec, catalog and results"]
    if compiled.inputs.content(path) == now:
        return []
    if path.suffix != ".yaml":
        return [f"{path} is not what is computed"]
    return [f"{path}: {line}" for line in map(change_text, changes_in_file(file, now))] or [
        f"{path}: its text was edited"
    ]


def _builder(opened: ManifestBundle) -> tuple[str, ...]:
    version = opened.manifest.provenance.builder.version
    return () if version == __version__ else (f"made by fogspec {version}, recomputed by {__version__}",)


def _deployment(opened: ManifestBundle, compiled: Artifacts) -> Check:
    """Check the deployed files: tasks, launch files, and files sent to the machine."""
    layout = opened.layout
    derived = {
        layout.manifest,
        layout.models,
        layout.menu,
        layout.plan,
        *(layout.task(s.id) for s in compiled.plan.spec.samples),
    }
    rest = [path for path in sorted(compiled.files) if path not in derived]
    breaks = [*opened.edited(), *(line for path in rest for line in _differing(path, compiled))]
    breaks += [f"{path} should not be there" for path in compiled.removed]
    return Check("deployment", f"{count(len(rest), 'file')} to run or to read", tuple(dict.fromkeys(breaks))[:SHOWN])


def remedy(opened: ManifestBundle, broken: Check) -> str:
    """Return the commands that repair a broken link."""
    layout, damaged = opened.layout, opened.inputs.damaged
    if broken.name == "results" and damaged is not None and (fix := damaged.diagnostics[0].fix):
        return fix
    if broken.name in ("results", "timings"):
        bench = shell_command("fogspec", "bench", layout.spec)
        return f"put back what was measured ({restore_command(layout.results.parent)}), or measure it: {bench}"
    if broken.name == "attestation":
        return f"attest it again: {shell_command('fogspec', 'attest', layout.manifest)}"
    lock = f"{shell_command('fogspec', 'lock', layout.spec)}, then " if broken.name == "lock" else ""
    return f"make it again and review it: {lock}{shell_command('fogspec', 'compile', layout.spec)}"


def as_text(opened: ManifestBundle, links: list[Check]) -> str:
    """Return the links as text, each with its breaks and notes."""
    lines = [f"{opened.layout.manifest}  {opened.digest}"]
    for link in links:
        lines.append(f"  {link.name:<10} {link.state:<6} {link.what}".rstrip())
        lines += [f"  {'':<10} {'':<6} {text}" for text in (*link.breaks, *link.notes)]
    return paragraph(lines)


def as_dict(opened: ManifestBundle, links: list[Check]) -> dict[str, Any]:
    """Return the links as a dict for JSON."""
    return {
        "manifest": str(opened.layout.manifest),
        "digest": opened.digest,
        "holds": all(not link.breaks for link in links),
        "links": [
            {
                "name": link.name,
                "what": link.what,
                "state": link.state,
                "breaks": list(link.breaks),
                "notes": list(link.notes),
            }
            for link in links
        ],
    }
