"""Describe a change of manifests for reviewers of a pull request: the choice, its cost, reasons, policies and freshness."""

import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from fogspec.audit.compare import Change, changes
from fogspec.audit.diff import (
    Difference,
    Due,
    committed_manifest,
    costs,
    manifest_in,
    number,
    significant,
    to_measure,
)
from fogspec.audit.freshness import Stage, Status, look
from fogspec.audit.git import Repository
from fogspec.base import digest
from fogspec.base.clouds import cloud_of
from fogspec.base.diagnostics import Diagnostic, DiagnosticError
from fogspec.base.layout import Layout
from fogspec.base.redaction import redacted
from fogspec.compile.inputs import Inputs
from fogspec.compile.manifest import Manifest
from fogspec.spec.loader import LoadedSpec, SourceFile, check_text
from fogspec.spec.lock_io import sent_tree
from fogspec.spec.lockfile import is_pinned
from fogspec.spec.render import render_document
from fogspec.spec.rules.policies import Policies
from fogspec.spec.tree import DOCUMENT

Rollout = Literal["none", "start", "replace", "in place"]


@dataclass(frozen=True, slots=True)
class Base:
    """What a change is compared with: a commit, and the files that differ between it and the checkout."""

    repository: Repository
    commit: str
    paths: frozenset[str]
    _content: dict[str, bytes | None] = field(default_factory=dict)

    @classmethod
    def of(cls, repository: Repository, commit: str) -> "Base":
        """Find the files that differ."""
        return cls(repository, commit, frozenset(os.path.realpath(path) for path in repository.changed(commit)))

    def differs(self, path: Path) -> bool:
        """Return whether a file differs between the base and the checkout."""
        return os.path.realpath(path) in self.paths

    def below(self, folder: Path) -> list[str]:
        """Return the files that differ in a folder, at any depth, sorted: their paths relative to it."""
        start = os.path.realpath(folder) + os.sep
        return sorted(path.removeprefix(start) for path in self.paths if path.startswith(start))

    def at(self, path: Path) -> bytes | None:
        """Return the content of a file at the base, None if it did not exist; git is asked once."""
        key = os.path.realpath(path)
        if key not in self._content:
            self._content[key] = self.repository.at(self.commit, Path(key))
        return self._content[key]


@dataclass(frozen=True, slots=True)
class Machine:
    """What a manifest deploys and what it expects; None stands for what it does not say.

    `infra` and `instance` are as the manifest writes them.
    """

    infra: str
    instance: str
    spot: bool
    image: str | None
    price_usd_per_hour: float | None
    usd_per_month: float | None
    usd_per_request: float | None
    latency_s: float | None
    statistic: str | None
    interval_s: tuple[float, float] | None
    limit_s: float | None
    probability_met: float | None
    measured: int | None
    planned: int | None

    @property
    def unpinned_image(self) -> str | None:
        """The image if it is not pinned by digest, and the machine runs containers: `apply` refuses it."""
        if self.image is None or is_pinned(self.image):
            return None
        cloud = cloud_of(self.infra)
        return self.image if cloud.on_skypilot and cloud.containers else None

    @property
    def place(self) -> str:
        """The machine in a few words, such as `a.large in aws/r1`."""
        return f"{self.instance} in {self.infra}{' spot' if self.spot else ''}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Review:
    """An application's manifest at the base and now, and its status.

    It is plain data, which passes between processes: `fresh`, `stages` and `refused` are those of its `Status`.

    `unusable` are the errors of damaged results, each with the command that restores them.
    `inputs` are the inputs that differ, old and new. `rollout` is what `apply` does with the machine that serves the
    manifest of the base: `none` if nothing is deployed or changed. `due` is what must be measured first. `broken`
    says where a policy of `policies` is broken. `idle` is an application that has no manifest, before and now, and of which
    no file differs.
    """

    difference: Difference
    fresh: bool
    stages: tuple[Stage, ...]
    refused: str | None
    unusable: tuple[Diagnostic, ...] = ()
    bench_options: tuple[str, ...] = ()
    inputs: tuple[Change, ...] = ()
    rollout: Rollout = "none"
    due: Due = field(default_factory=Due)
    policies: tuple[str, ...] = ()
    broken: tuple[Diagnostic, ...] = ()
    idle: bool = False

    @property
    def name(self) -> str:
        """The application's name."""
        return self.difference.layout.name

    @property
    def before(self) -> Machine | None:
        """What the manifest of the base deploys."""
        return machine_in(self.difference.before)

    @property
    def after(self) -> Machine | None:
        """What the manifest on disk deploys."""
        return machine_in(self.difference.after)

    @property
    def deploys_unpinned(self) -> bool:
        """True if `apply` is to start a machine with an image that is not pinned, and refuses it."""
        return self.rollout in ("start", "replace") and self.after is not None and self.after.unpinned_image is not None

    @property
    def damaged(self) -> bool:
        """True if the manifest on disk cannot be read, so that `apply` refuses it."""
        return "damaged" in (self.difference.after or ())

    @property
    def touched(self) -> bool:
        """True if there is something to review."""
        return bool(
            self.difference.changes
            or self.inputs
            or self.broken
            or self.rollout != "none"
            or not (self.fresh or self.idle)
            or (self.difference.before is None) != (self.difference.after is None)
        )

    @property
    def warnings(self) -> tuple[list[str], list[str]]:
        """The warnings of the manifest on disk: those that are new, and those that were there before."""
        was, now = (_texts(document, "warnings") for document in (self.difference.before, self.difference.after))
        return [one for one in now if one not in was], [one for one in now if one in was]


@dataclass(frozen=True, slots=True)
class Removed:
    """A removed application and its last manifest."""

    name: str
    manifest: Mapping[str, Any]

    @property
    def before(self) -> Machine | None:
        """What its last manifest deploys."""
        return machine_in(self.manifest)


@dataclass(frozen=True, slots=True)
class Whole:
    """All that a change deploys: `invalid` are the errors of specs that cannot be read, in which case there is no review."""

    commit: str
    reviews: Sequence[Review]
    removed: Sequence[Removed] = ()
    invalid: Sequence[Diagnostic] = field(default=())

    @property
    def month_usd(self) -> tuple[float, float]:
        """The cost of all machines in USD per month, before and after; of a removed application there is none after."""
        before = [*(one.before for one in self.reviews), *(one.before for one in self.removed)]
        return _sum(before), _sum([one.before if one.damaged else one.after for one in self.reviews])

    @property
    def due(self) -> Due:
        """What must be measured first, of all applications."""
        each = [one.due for one in self._plans()]
        names = tuple(name for one in each for name in one.samples)
        return Due(names, any(one.selects_more for one in each), sum(one.usd for one in each))

    def _plans(self) -> Sequence["Review"]:
        """Return one application for each plan: its environments share it."""
        return list({one.difference.layout.plan: one for one in self.reviews if not one.idle}.values())

    @property
    def broken(self) -> int:
        """How often a policy is broken."""
        return sum(len(one.broken) for one in self.reviews)


@dataclass(frozen=True, slots=True)
class Reviewer:
    """What all applications are reviewed by; a process that helps is sent it."""

    base: Base
    catalog: str | None = None
    policies: tuple[str, ...] = ()

    def reviews(self, loaded: Sequence[LoadedSpec]) -> list[Review]:
        """Return the review of each application; raise the errors of `Inputs.load`."""
        inputs = Inputs.load([], catalog=self.catalog, audit=True, each=True, loaded=loaded)
        rules = Policies(self.policies)
        return [review(look(one, self.base.commit), self.base, rules) for one in inputs]


def review(status: Status, base: Base, policies: Policies) -> Review:
    """Compare the manifest at the base with the one on disk."""
    inputs, layout = status.inputs, status.layout
    secrets = inputs.application.spec.secrets
    old = new = redacted(committed_manifest(inputs), secrets)
    if base.differs(layout.manifest):
        content = base.at(layout.manifest)
        before = None if content is None else manifest_in(SourceFile(layout.manifest, content))
        old = redacted(before, secrets)
    found = Difference(
        layout=layout,
        before=old,
        after=new,
        changes=tuple(significant(changes(old, new))) if old != new else (),
        costs=costs(old, new),
        refused=status.refused,
    )
    files = list(_sent_files(status, base))
    due = Due() if status.artifacts is None else to_measure(status.artifacts)
    loaded: Sequence[LoadedSpec] = [inputs.spec]
    broken = [*policies.check_specs(loaded), *policies.check_manifests(loaded, Manifest, dict(inputs.on_disk))]
    return Review(
        difference=found,
        fresh=status.fresh,
        stages=status.stages,
        refused=status.refused,
        unusable=status.damaged,
        bench_options=tuple(status.artifacts.plan.runner_options if status.artifacts else ()),
        inputs=(*_spec_changes(status, base), *files, *_other_inputs(old, new)),
        rollout=_rollout(status, base, old, new, bool(files)),
        due=due,
        policies=tuple(policies.paths(layout.root)),
        broken=tuple(broken),
        idle=old is None and new is None and not files and not any(map(base.differs, _own_files(layout))),
    )


def _own_files(layout: Layout) -> list[Path]:
    return [layout.spec, layout.results, layout.plan, *([] if layout.overlay is None else [layout.overlay])]


def removed(repository: Repository, commit: str, names: Collection[str], whole: bool = False) -> list[Removed]:
    """Return the applications that had a manifest at `commit` and have neither a manifest nor a spec now.

    `names` are the applications that have a spec; all of them if `whole`. Then a manifest that is left of a spec that was
    there at `commit` counts as none.
    """
    found, paths = [], repository.paths(commit)
    for path in paths:
        name = path.parent.name
        if not path.match("compiled/*/manifest.yaml") or name in names or (path.exists() and not whole):
            continue
        manifest = manifest_in(SourceFile(path, repository.at(commit, path) or b""))
        spec = _part(manifest, "provenance", "application").get("path")
        if not path.exists() or (spec is not None and path.parents[2] / str(spec) in paths):
            found.append(Removed(name, redacted(manifest)))
    return found


def machine_in(manifest: Mapping[str, Any] | None) -> Machine | None:
    """Return what a manifest deploys, None without one or for a damaged one."""
    if manifest is None or not isinstance(manifest.get("spec"), Mapping):
        return None
    spec, latency, cost = manifest["spec"], _part(manifest, "expected", "latency"), _part(manifest, "expected", "cost")
    partial, interval = _part(manifest, "provenance", "partial"), latency.get("interval")
    ends = [number(str(one)) for one in interval] if isinstance(interval, list) else []
    return Machine(
        infra=str(spec.get("infra")),
        instance=str(spec.get("instance")),
        spot=spec.get("spot") is True,
        image=None if spec.get("image") is None else str(spec["image"]),
        price_usd_per_hour=_number(spec.get("price")),
        usd_per_month=_number(cost.get("month")),
        usd_per_request=_number(cost.get("predicted")),
        latency_s=_number(latency.get("predicted")),
        statistic=None if latency.get("statistic") is None else str(latency["statistic"]),
        interval_s=(ends[0], ends[1]) if len(ends) == 2 and ends[0] is not None and ends[1] is not None else None,
        limit_s=_number(latency.get("limit")),
        probability_met=_fraction(latency.get("probability_met")),
        measured=_count(partial.get("measured")),
        planned=_count(partial.get("planned")),
    )


def _spec_changes(status: Status, base: Base) -> Iterator[Change]:
    """Yield the fields of the spec that differ, defaults filled in; the file itself if it was no valid spec before."""
    layout, one = status.layout, status.inputs.spec
    named = [layout.spec, *([] if layout.overlay is None else [layout.overlay])]
    content = base.at(layout.spec) if any(map(base.differs, named)) else None
    overlay = None if layout.overlay is None else base.at(layout.overlay)
    if content is None:
        return
    known = check_text(content, one.path, None if overlay is None else (overlay, str(layout.overlay)))[0]
    was = next((found for found in known if found.application.metadata.name == layout.application), None)
    if was is None:
        yield Change(layout.relative(layout.spec), "not a valid spec", "a valid spec")
        return
    secrets = one.application.spec.secrets
    before, after = (redacted(render_document(found.application), secrets) for found in (was, one))
    yield from changes(before, after)


def _sent_files(status: Status, base: Base) -> Iterator[Change]:
    """Yield the files that machines are sent and that differ, with the beginnings of their digests."""
    layout, sent = status.layout, status.inputs.sent
    tree = sent_tree(status.inputs.application, layout)
    for name in base.below(layout.spec.parent) if tree is not None else ():
        path = layout.spec.parent / name
        if name not in sent and (path.exists() or tree is None or tree.excludes(name)):
            continue
        content = base.at(path)
        # What is gone was sent, if it was there and not one of fogspec's own documents.
        if name not in sent and (content is None or ("/" not in name and DOCUMENT.search(content))):
            continue
        before = None if content is None else f"sha256:{digest.shorten(digest.of_bytes(content))}"
        now = sent.get(name)
        if now is not None and (what := now.rpartition("sha256:"))[1]:
            now = f"{what[0]}sha256:{digest.shorten(f'sha256:{what[2]}')}"
        yield Change(layout.relative(layout.spec.parent / name), before, now)


def _other_inputs(old: Mapping[str, Any] | None, new: Mapping[str, Any] | None) -> Iterator[Change]:
    """Yield the inputs besides spec and files that differ between two manifests: image, catalog, results, priors, fogspec."""
    if old is None or new is None or old == new or "damaged" in new:
        return
    was, now = _part(old, "provenance"), _part(new, "provenance")
    named = {
        "image": (_part(old, "spec").get("image"), _part(new, "spec").get("image")),
        **{
            f"catalog {key}": (_part(was, "catalog").get(key), _part(now, "catalog").get(key))
            for key in ("source", "revision", "date")
        },
        "samples": (_part(was, "models").get("samples"), _part(now, "models").get("samples")),
        "priors": (_part(was, "models").get("priors"), _part(now, "models").get("priors")),
        "fogspec": (_part(was, "builder").get("version"), _part(now, "builder").get("version")),
    }
    yield from (Change(name, before, after) for name, (before, after) in named.items() if before != after)
    for name in ("catalog", "results"):
        before, after = (_part(document, name).get("digest") for document in (was, now))
        if before != after:
            yield Change(f"{name} digest", digest.shorten(str(before)), digest.shorten(str(after)))


def _rollout(
    status: Status, base: Base, old: Mapping[str, Any] | None, new: Mapping[str, Any] | None, files: bool
) -> Rollout:
    """Return what `apply` does with the machine that serves `old`: it stays if the new manifest gives it nothing new."""
    if new is None or "damaged" in new or (old == new and not files):
        return "none"
    if old is None:
        return "start"
    layout = status.layout
    then, now = base.at(layout.deploy), status.inputs.content(layout.deploy)
    if files or _given(old, then) != _given(new, now):
        return "replace"
    return "in place"


def _given(manifest: Mapping[str, Any], task: bytes | None) -> Any:
    """Return all that a machine is given by a manifest and its task; a new price or expectation is not among it."""
    spec = _part(manifest, "spec")
    try:
        content = None if task is None else SourceFile("task", task).plain()
    except DiagnosticError:
        content = task
    if isinstance(content, dict) and isinstance(content.get("resources"), dict):
        content["resources"].pop("max_hourly_cost", None)
    robot = _part(spec, "robot_launch").get("path")
    listed = spec.get("files")
    files = [one for one in listed if not isinstance(one, Mapping) or one.get("path") != robot] if listed else []
    return [content, *(spec.get(name) for name in ("infra", "instance", "spot", "image")), files]


def as_dict(whole: Whole) -> dict[str, Any]:
    """Return the review as values for JSON; money in USD, durations in seconds."""
    before_usd, after_usd = whole.month_usd
    return {
        "base": whole.commit,
        "applications": [_review_data(one) for one in whole.reviews],
        "removed": [{"name": one.name, "before": _machine_data(one.before)} for one in whole.removed],
        "invalid": [_diagnostic_data(one) for one in whole.invalid],
        "total": {
            "before_usd_per_month": before_usd,
            "after_usd_per_month": after_usd,
            "to_measure": len(whole.due.samples),
            "measuring_usd_at_most": whole.due.usd,
            "policies_broken": whole.broken,
        },
    }


def _review_data(one: Review) -> dict[str, Any]:
    new, kept = one.warnings
    return {
        "name": one.name,
        "spec": one.difference.layout.spec.as_posix(),
        "changed": one.touched,
        "fresh": one.fresh,
        "refused": one.refused,
        "stages": [{"name": stage.name, "state": stage.state, "reasons": list(stage.reasons)} for stage in one.stages],
        "rollout": one.rollout.replace(" ", "_"),
        "before": _machine_data(one.before),
        "after": _machine_data(one.after),
        "inputs": [_change_data(change) for change in one.inputs],
        "fields": [_change_data(change) for change in one.difference.changes],
        "warnings": {"new": new, "as_before": kept},
        "to_measure": len(one.due.samples),
        "measuring_usd_at_most": one.due.usd,
        "policies": {"checked": list(one.policies), "broken": [_diagnostic_data(found) for found in one.broken]},
    }


def _machine_data(one: Machine | None) -> dict[str, Any] | None:
    if one is None:
        return None
    return {
        "infra": one.infra,
        "instance": one.instance,
        "spot": one.spot,
        "image": one.image,
        "price_usd_per_hour": one.price_usd_per_hour,
        "usd_per_month": one.usd_per_month,
        "usd_per_1000_requests": None if one.usd_per_request is None else round(1000 * one.usd_per_request, 12),
        "latency": {
            "statistic": one.statistic,
            "predicted_s": one.latency_s,
            "interval_s": None if one.interval_s is None else list(one.interval_s),
            "limit_s": one.limit_s,
            "probability_met": one.probability_met,
        },
        "partial": None if one.planned is None else {"measured": one.measured, "planned": one.planned},
    }


def _change_data(change: Change) -> dict[str, Any]:
    return {"field": change.field, "before": change.before, "after": change.after}


def _diagnostic_data(one: Diagnostic) -> dict[str, Any]:
    place = {"path": one.span.path, "line": one.span.line, "column": one.span.column}
    return {"code": one.code, "message": one.message, "fix": one.fix, **place}


def _sum(machines: Sequence[Machine | None]) -> float:
    return round(sum(one.usd_per_month or 0.0 for one in machines if one is not None), 6)


def _part(document: Mapping[str, Any], *steps: str) -> Mapping[str, Any]:
    value: Any = document
    for step in steps:
        value = value.get(step) if isinstance(value, Mapping) else None
    return value if isinstance(value, Mapping) else {}


def _texts(document: Mapping[str, Any] | None, key: str) -> list[str]:
    found = (document or {}).get(key)
    return [str(one) for one in found] if isinstance(found, list) else []


def _number(value: Any) -> float | None:
    return None if value is None else number(str(value))


def _fraction(value: Any) -> float | None:
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None


def _count(value: Any) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) else None
