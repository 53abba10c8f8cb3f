"""Describe a change of manifests for reviewers of a pull request: the choice, its cost, reasons and freshness."""

import itertools
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from fogspec.audit.compare import Change, changes, short
from fogspec.audit.diff import (
    NAMES,
    Difference,
    committed_manifest,
    costs,
    headline,
    manifest_in,
    significant,
)
from fogspec.audit.freshness import Status
from fogspec.audit.git import Repository
from fogspec.base import digest
from fogspec.base.redaction import redacted
from fogspec.base.text import code, shell_command
from fogspec.base.text import markdown as md
from fogspec.spec.loader import SourceFile

MARK = "<!-- fogspec review -->"
INPUTS = {
    "application": "the spec",
    "catalog": "the catalog",
    "plan": "the plan",
    "results": "the results",
    "models": "the models",
}


@dataclass(frozen=True, slots=True)
class Review:
    """An application's manifest at the base and now, and its status."""

    difference: Difference
    status: Status

    @property
    def fresh(self) -> bool:
        """True if all stages are fresh."""
        return self.status.fresh

    @property
    def touched(self) -> bool:
        """True if there is something to review."""
        return bool(self.difference.changes) or not self.fresh


@dataclass(frozen=True, slots=True)
class Removed:
    """A removed application and its last manifest."""

    name: str
    manifest: Mapping[str, Any]


def review(status: Status, repository: Repository, commit: str) -> Review:
    """Compare the manifest at `commit` with the one on disk."""
    inputs, layout = status.inputs, status.layout
    secrets = inputs.application.spec.secrets
    now, content = inputs.on_disk.get(layout.manifest), repository.at(commit, layout.manifest)
    old = new = redacted(committed_manifest(inputs), secrets)
    if now is None or content != now.content:
        before = None if content is None else manifest_in(SourceFile(layout.manifest, content))
        old = redacted(before, secrets)
    every = list(changes(old, new))
    found = Difference(
        layout=layout,
        before=old,
        after=new,
        changes=tuple(significant(iter(every))) if old != new else (),
        costs=costs(old, new),
        why=tuple(dict.fromkeys(_inputs(every))) if old and new else (),
        to_measure=("",) * (status.to_measure or 0),
        refused=status.refused,
    )
    return Review(found, status)


def removed(repository: Repository, commit: str, names: Collection[str]) -> list[Removed]:
    """Return the applications that had a manifest at `commit` and have neither a manifest nor a spec now.

    `names` are the applications that have a spec.
    """
    gone = [
        path
        for path in repository.paths(commit)
        if path.match("compiled/*/manifest.yaml") and path.parent.name not in names and not path.exists()
    ]
    content = ((path, repository.at(commit, path) or b"") for path in gone)
    return [Removed(path.parent.name, redacted(manifest_in(SourceFile(path, text)))) for path, text in content]


def _inputs(every: Sequence[Change]) -> Iterator[str]:
    """Yield the inputs that differ between two manifests, from the changes in their provenance."""
    for change in every:
        steps = change.field.split(".")
        if steps[0] != "provenance" or len(steps) < 2:
            continue
        if steps[1:3] == ["application", "field_digests"] and len(steps) > 3:
            yield f"spec.{'.'.join(steps[3:])} changed"
        elif steps[1] == "builder":
            yield f"made by fogspec {short(change.before)} -> {short(change.after)}"
        elif steps[1] == "catalog" and steps[-1] in ("revision", "date", "source"):
            yield f"catalog {steps[-1]}: {short(change.before)} -> {short(change.after)}"
        elif steps[-1] == "digest" and steps[1] != "application":
            yield f"{INPUTS.get(steps[1], steps[1])} changed"


def markdown(reviews: Sequence[Review], gone: Sequence[Removed], picture_base: str | None) -> str:
    """Return the comment: changed or stale applications in full, removed ones, and the names of the others."""
    touched = [one for one in reviews if one.touched]
    lines = [MARK, "## fogspec: what this change deploys", ""]
    for one in touched:
        lines += [*_application(one, picture_base), ""]
    for application in gone:
        lines += [*_removal(application), ""]
    if rest := [one.difference.layout.name for one in reviews if not one.touched]:
        lines.append(f"Unchanged and fresh: {', '.join(map(md, rest))}.")
    return "\n".join(lines).rstrip() + "\n"


def _application(one: Review, picture_base: str | None) -> list[str]:
    difference, layout = one.difference, one.difference.layout
    lines = [f"### {md(layout.name)}: {md(_headline(one))}", ""]
    lines += [f"- {md(text)}" for text in _choice(difference.after)]
    lines += [f"- why: {md(text)}" for text in difference.why]
    lines += [
        f"- **{md(stage.name)} is {md(stage.state)}**: {md('; '.join(stage.reasons) or 'compile it')}"
        for stage in one.status.stages
        if stage.state != "fresh"
    ]
    if one.status.refused:
        lines.append(f"- **cannot be compiled**: {md(one.status.refused)}")
    if one.status.to_measure and one.status.artifacts is not None:
        measure = one.status.artifacts.plan.bench_command(_from_here(layout.spec))
        lines.append(f"- {one.status.to_measure} samples to measure: {code(measure)}")
    elif one.fresh:
        lines.append("- everything is fresh; no benchmark needed")
    elif not one.status.refused:
        lines.append(
            f"- **to do**: {code(shell_command('fogspec', 'compile', _from_here(layout.spec)))}, and commit what it writes"
        )
    lines += ["", *_costs(difference), *_warnings(difference)]
    if layout.files.is_file(layout.picture) and picture_base is not None:
        address = f"{picture_base.rstrip('/')}/{quote(_from_here(layout.picture))}"
        lines += [f"![menu of {md(layout.name)}]({address})", ""]
    return [*lines, *_provenance(difference.after), *_fields(difference.changes)]


def _headline(one: Review) -> str:
    difference = one.difference
    if difference.after is None:
        return "no manifest" if difference.before is None else "the manifest is gone"
    if difference.changes or difference.before is None:
        return headline(difference) + ("" if one.fresh else ", but the manifest is not fresh")
    return "the manifest is not fresh"


def _removal(one: Removed) -> list[str]:
    """Return the section about a removed application; merging terminates no machine."""
    lines = [f"### {md(one.name)}: no longer deployed", ""]
    lines += [f"- {md(text)}" for text in itertools.islice(_choice(one.manifest), 1)]
    return [
        *lines,
        f"- its deployment keeps running: {code(shell_command('fogspec', 'down', one.name))} ends it, while the files exist",
    ]


def _warnings(difference: Difference) -> list[str]:
    """Return the warnings: new ones in full, earlier ones folded."""
    was, now = ((document or {}).get("warnings") or [] for document in (difference.before, difference.after))
    lines = [f"- **warning**: {md(str(text))}" for text in now if text not in was]
    if old := [f"- {md(str(text))}" for text in now if text in was]:
        lines += ["", f"<details><summary>{len(old)} warnings, as before</summary>", "", *old, "", "</details>"]
    return [*lines, ""] if lines else []


def _choice(manifest: Mapping[str, Any] | None) -> Iterator[str]:
    """Yield the machine and the expected latency and cost in a manifest."""
    if manifest is None or not isinstance(manifest.get("spec"), Mapping):
        return
    spec, latency = manifest["spec"], _part(manifest, "expected", "latency")
    cost = _part(manifest, "expected", "cost")
    yield (
        f"runs on {spec.get('instance')} in {spec.get('infra')}, {spec.get('price')}, {cost.get('month')}"
        f"; image {spec.get('image') or 'none'}"
    )
    interval = latency.get("interval")
    within = f" [{', '.join(map(str, interval))}]" if isinstance(interval, list) else ""
    limit = f", limit {latency['limit']}" if latency.get("limit") else ""
    partial = _part(manifest, "provenance", "partial")
    if partial:
        yield f"partial: {partial.get('measured')} of {partial.get('planned')} planned samples are measured"
    sure = f", met with probability {latency['probability_met']}" if latency.get("probability_met") is not None else ""
    expected = f"expected {latency.get('statistic')} latency {latency.get('predicted')}{within}{limit}{sure}"
    yield f"{expected}; {cost.get('predicted')}"


def _costs(difference: Difference) -> list[str]:
    if not difference.costs:
        return []
    rows = [
        f"| {NAMES[name]} | {md(was)} | {md(now)} | {md(rel)} |" for name, (was, now, rel) in difference.costs.items()
    ]
    return ["| | before | after | |", "|--|--|--|--|", *rows, ""]


def _provenance(manifest: Mapping[str, Any] | None) -> list[str]:
    named = _part(manifest or {}, "provenance")
    rows = []
    for name in INPUTS:
        one = _part(named, name)
        where = one.get("path") or " ".join(filter(None, (one.get("source"), one.get("revision"), one.get("date"))))
        if one:
            rows.append(f"| {name} | {md(str(where))} | {code(digest.shorten(str(one.get('digest'))))} |")
    if not rows:
        return []
    return [
        "<details><summary>Provenance</summary>",
        "",
        "| made from | | digest |",
        "|--|--|--|",
        *rows,
        "",
        "</details>",
        "",
    ]


def _fields(found: Sequence[Change]) -> list[str]:
    if not found:
        return []
    rows = [f"| {code(one.field)} | {md(short(one.before))} | {md(short(one.after))} |" for one in found]
    head = f"<details><summary>{len(found)} fields differ</summary>"
    return [head, "", "| field | before | after |", "|--|--|--|", *rows, "", "</details>", ""]


def _part(document: Mapping[str, Any], *steps: str) -> Mapping[str, Any]:
    value: Any = document
    for step in steps:
        value = value.get(step) if isinstance(value, Mapping) else None
    return value if isinstance(value, Mapping) else {}


def _from_here(path: Path) -> str:
    return Path(os.path.relpath(path)).as_posix()
