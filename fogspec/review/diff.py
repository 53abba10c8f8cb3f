"""What a change does to each application: two manifests, the inputs between them, and what `apply` would do.

Without a base, the two are the manifest on disk and the one that compile would write; with a base, the one at that commit and
the one on disk.
"""

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

from fogspec.base.diagnostics import Diagnostic, DiagnosticError
from fogspec.base.errors import FogspecError
from fogspec.base.layout import Layout
from fogspec.base.redaction import redacted
from fogspec.base.text import count
from fogspec.base.units import dollars, shown_month
from fogspec.bench.quote import most_usd
from fogspec.bench.spending import spending
from fogspec.check.audit import Stage, Status, look
from fogspec.check.compare import Change, compared
from fogspec.compile.artifacts import Artifacts
from fogspec.compile.inputs import Inputs
from fogspec.compile.manifest import Manifest, given
from fogspec.language.loader import LoadedSpec, SourceFile, check_text
from fogspec.language.rules.policies import Policies
from fogspec.plan.schema import estimate
from fogspec.results.schema import completed
from fogspec.review.changed import Carried, SampleChange, carried, input_changes, sample_changes, sent_changes
from fogspec.review.deployed import Deployed, share
from fogspec.review.git import Base, Repository

Rollout = Literal["none", "start", "replace", "in place"]
PAID_RUNNER = "skypilot"  # whose samples cost money


@dataclass(frozen=True, slots=True)
class Due:
    """Ids of the samples to measure first, whether the model then selects more, and the most that all of it costs in USD."""

    samples: tuple[str, ...] = ()
    selects_more: bool = False
    usd: float = 0.0

    def __bool__(self) -> bool:
        return bool(self.samples or self.selects_more)

    @property
    def text(self) -> str:
        """How many samples they are, what follows them, and the most that all of it costs, for people."""
        more = ", then the machines that the model selects" if self.selects_more else ""
        return f"{count(len(self.samples), 'sample')}{more}, at most {dollars(self.usd)}"


class Warnings(NamedTuple):
    """The warnings that a change adds, keeps and removes."""

    new: list[Mapping[str, Any]]
    as_before: list[Mapping[str, Any]]
    gone: list[Mapping[str, Any]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """An application's manifest before and after, None for a missing one. It is plain data, which passes between processes.

    `fields` are those of the manifest that differ, `inputs` and `samples` what changed by hand. `fresh`, `stages`, `why` and
    `unusable` are those of its status, `refused` is why there is no manifest after it. `rollout` is what `apply` does with the
    machine that serves the manifest before: `none` if nothing changes. `due` is what must be measured first, `carried` are
    the changes that samples outlive. `broken` says where a policy of `policies` is broken. `idle` is an application without a
    manifest, before and now, of which no file differs. `running` are the changes from what runs to the manifest on disk, None
    if nothing runs; `unknown` is why that is not known.
    """

    layout: Layout
    before: Deployed | None
    after: Deployed | None
    fresh: bool
    stages: tuple[Stage, ...]
    why: tuple[str, ...]
    refused: str | None
    unusable: tuple[Diagnostic, ...]
    due: Due
    bench_options: tuple[str, ...]
    rollout: Rollout
    policies: tuple[str, ...]
    broken: tuple[Diagnostic, ...]
    fields: tuple[Change, ...]
    carried: tuple[Carried, ...]
    inputs: tuple[Change, ...]
    samples: tuple[SampleChange, ...]
    idle: bool
    running: tuple[Change, ...] | None = None
    unknown: FogspecError | None = None

    @property
    def name(self) -> str:
        """The application's name."""
        return self.layout.name

    @property
    def damaged(self) -> bool:
        """True if the manifest after the change cannot be read, so that `apply` refuses it."""
        return self.after is not None and self.after.damage is not None

    @property
    def differs(self) -> bool:
        """True if there is something to look at."""
        found = self.fields or self.inputs or self.samples or self.broken or self.rollout != "none"
        return bool(found or not (self.fresh or self.idle) or (self.before is None) != (self.after is None))

    @property
    def figures(self) -> list[Change]:
        """The fields of the manifest that differ, without those of its record, which are `inputs`, and its `warnings`."""
        return [one for one in self.fields if not one.field.startswith(("evidence.inputs.", "warnings"))]

    @property
    def refused_image(self) -> str | None:
        """The image that `apply` refuses, as it is not pinned, when it is to start a machine."""
        starts = self.rollout in ("start", "replace")
        return self.after.unpinned_image if starts and self.after is not None else None

    @property
    def warnings(self) -> Warnings:
        """The warnings of both manifests, compared by code and values."""
        was, now = ([] if one is None else one.warnings for one in (self.before, self.after))
        common = [one for one in now if one in was]
        return Warnings([one for one in now if one not in was], common, [one for one in was if one not in now])

    @property
    def months_usd(self) -> tuple[float, float]:
        """What its machine costs in USD per month, before and after; a damaged manifest changes nothing."""
        before = 0.0 if self.before is None else self.before.month_usd
        return before, before if self.damaged else 0.0 if self.after is None else self.after.month_usd

    @property
    def weight(self) -> tuple[int, float, str]:
        """How early it is shown: what stops the merge, then machines, then the rest; what changes more money first."""
        before, after = self.months_usd
        rank = 0 if self.broken or not (self.fresh or self.idle) else 1 if self.rollout in ("start", "replace") else 2
        return rank, -abs(after - before), self.name


@dataclass(frozen=True, slots=True)
class Whole:
    """All that a change does: the applications that it may concern, and the manifests of the `others`.

    `removed` are the last manifests of removed applications, `invalid` the errors of specs that cannot be read. With a
    `warning` all of it may be of others, too.
    """

    base: str | None
    found: Sequence[Difference]
    others: Mapping[str, Deployed | None] = field(default_factory=dict)
    removed: Mapping[str, Deployed] = field(default_factory=dict)
    invalid: Sequence[Diagnostic] = ()
    warning: str | None = None

    @property
    def shown(self) -> list[Difference]:
        """The applications that differ, by weight."""
        return sorted((one for one in self.found if one.differs), key=lambda one: one.weight)

    @property
    def changed(self) -> str:
        """How many applications changed, for people."""
        number = len(self.shown) + len(self.removed)
        total = count(len(self.found) + len(self.others) + len(self.removed), "application")
        return f"{number:,} of {total} changed" if number else "No application changes"

    @property
    def months_usd(self) -> tuple[float, float]:
        """The cost of all machines in USD per month, before and after; of a removed application there is none after."""
        each = [one.months_usd for one in self.found]
        same = sum(one.month_usd for one in self.others.values() if one is not None)
        gone = sum(one.month_usd for one in self.removed.values())
        before, after = (same + sum(one[side] for one in each) for side in (0, 1))
        return round(before + gone, 6), round(after, 6)

    @property
    def costs(self) -> str:
        """The cost of all machines before and after, for people."""
        before, after = self.months_usd
        relative = share(before, after)
        return f"{shown_month(before)} before, {shown_month(after)} after{relative and f' ({relative})'}"

    @property
    def due(self) -> Due:
        """What must be measured first, of all applications; environments of one share its plan."""
        each = list({one.layout.plan: one.due for one in self.found if not one.idle}.values())
        names = tuple(name for one in each for name in one.samples)
        return Due(names, any(one.selects_more for one in each), sum(one.usd for one in each))

    @property
    def problems(self) -> list[Diagnostic]:
        """The errors of specs, results and policies, each once."""
        own = [found for one in self.found for found in (*one.broken, *one.unusable)]
        return list(dict.fromkeys([*self.invalid, *own]))


def difference(inputs: Inputs, base: Base | None, policies: Policies) -> Difference:
    """Return the difference of an application to a base, or without one to what compile would write now."""
    status = look(inputs, None if base is None else base.commit)
    compiled, layout = status.artifacts, status.layout
    there, task = Deployed.of(inputs.on_disk.get(layout.manifest)), inputs.content(layout.deploy)
    files: tuple[Change, ...] = ()
    if base is None:
        sides = (there, _compiled(status))
        tasks = (task, None if compiled is None else compiled.files.get(layout.deploy))
    else:
        before = Deployed.of(base.file(layout.manifest)) if base.differs(layout.manifest) else there
        sides, tasks = (before, there), (base.at(layout.deploy) if base.differs(layout.deploy) else task, task)
        files = tuple(sent_changes(status, base))
    fields = _fields(*sides)
    loaded: Sequence[LoadedSpec] = [inputs.spec]
    own = [layout.spec, layout.plan, *([] if layout.overlay is None else [layout.overlay])]
    return Difference(
        layout=layout,
        before=sides[0],
        after=sides[1],
        fresh=status.fresh,
        stages=status.stages,
        why=(*status.problems, *((status.remedy,) if status.damaged and status.remedy else ())),
        refused=status.refused or (_no_manifest(compiled) if base is None else None),
        unusable=status.damaged,
        due=Due() if compiled is None else to_measure(compiled),
        bench_options=() if compiled is None else tuple(compiled.plan.runner_options),
        rollout=_rollout(*sides, tasks, bool(files), bool(fields)),
        policies=tuple(policies.paths(layout.root)),
        broken=(*policies.check_specs(loaded), *policies.check_manifests(loaded, Manifest, dict(inputs.on_disk))),
        fields=fields,
        inputs=(*input_changes(status, base, *sides), *files),
        samples=() if base is None else tuple(sample_changes(status, base)),
        carried=tuple(carried(layout, *sides, base)),
        idle=base is not None
        and sides == (None, None)
        and not files
        and not any(map(base.differs, own))
        and not base.below(layout.results),
    )


def _compiled(status: Status) -> Deployed | None:
    """Return the manifest that compile would write; None if there is none."""
    decision = None if status.artifacts is None else status.artifacts.decision
    if status.artifacts is not None and status.inputs.unread and status.layout.manifest in status.artifacts.files:
        return Deployed.of(status.inputs.on_disk[status.layout.manifest])
    if decision is None or decision.manifest is None:
        return None
    return Deployed(redacted(decision.manifest.model_dump(mode="json")))


def _fields(before: Deployed | None, after: Deployed | None) -> tuple[Change, ...]:
    """Return the fields in which two manifests differ; none without a second one that can be read."""
    if before is None or after is None or after.damage is not None or before == after:
        return ()
    return tuple(compared(before.values or {"damaged": before.damage}, after.values))


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


def removed(repository: Repository, commit: str, names: Collection[str], whole: bool = False) -> dict[str, Deployed]:
    """Return the last manifests of applications that had one at `commit` and have neither a manifest nor a spec now.

    `names` are the applications that have a spec; all of them if `whole`. Then a manifest that is left of a spec that was
    there at `commit` counts as none.
    """
    found, paths = {}, repository.paths(commit)
    for path in paths:
        name = path.parent.name
        if not path.match("compiled/*/manifest.yaml") or name in names or (path.exists() and not whole):
            continue
        last = Deployed.of(SourceFile(path, repository.at(commit, path) or b"")) or Deployed({})
        if not path.exists() or _had_spec(repository, commit, path.parents[2] / "specs", name):
            found[name] = last
    return found


def _had_spec(repository: Repository, commit: str, folder: Path, name: str) -> bool:
    """Return whether a commit has a spec with an application of this name."""
    for path in repository.paths(commit):
        if folder in path.parents and path.suffix in (".yaml", ".yml"):
            known = check_text(repository.at(commit, path) or b"", str(path))[0]
            if name.partition("@")[0] in [one.name for one in known]:
                return True
    return False


def _no_manifest(compiled: Artifacts | None) -> str | None:
    if compiled is None:
        return None
    if compiled.decision is None:
        return compiled.stale or "nothing is measured yet: there is no manifest"
    refusal = compiled.decision.refusal
    return None if refusal is None else refusal.message.removeprefix(f"{compiled.layout.name}: ")


def _rollout(
    old: Deployed | None, new: Deployed | None, tasks: tuple[bytes | None, bytes | None], files: bool, changed: bool
) -> Rollout:
    """Return what `apply` does with the machine that serves `old`: it stays if the new manifest gives it nothing new."""
    if new is None or new.damage is not None or (old is not None and not changed and not files):
        return "none"
    if old is None:
        return "start"
    return "replace" if files or _given(old, tasks[0]) != _given(new, tasks[1]) else "in place"


def _given(manifest: Deployed, task: bytes | None) -> Any:
    """Return all that a machine is given by a manifest and its task."""
    try:
        content = None if task is None else SourceFile("task", task).plain()
    except DiagnosticError:
        content = task
    return given(content, manifest.part("spec"), manifest.part("pins"))


def from_here(path: Path) -> str:
    """Return a path as a command line in the working directory names it."""
    return Path(os.path.relpath(path)).as_posix()
