"""The gate of a pull request: whether `apply` would deploy exactly what is committed, for every application.

All verbs have one rule of freshness (`fogspec.check.audit`) and one of policies; this module asks both, and what no other verb
sees: manifests that a change took away, and files without a spec.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from fogspec.base.diagnostics import Diagnostic, Span
from fogspec.base.digest import of_bytes
from fogspec.base.git import tracked_state
from fogspec.base.text import count, paragraph, shell_command
from fogspec.base.units import parse_until
from fogspec.check.audit import Stage, Status, look
from fogspec.compile.bundle import ManifestBundle
from fogspec.compile.inputs import Inputs, policies_read
from fogspec.compile.manifest import Manifest
from fogspec.compile.tasks import LEAST_LIFETIME_S
from fogspec.language.loader import LoadedSpec
from fogspec.language.rules.policies import Policies
from fogspec.review.deployed import Deployed
from fogspec.review.git import Repository, Rules
from fogspec.review.shared_work import share
from fogspec.review.statement import Approved
from fogspec.review.status import stage_data


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """What the gate found of one application; it passes between processes.

    `what` is what would be deployed, in a few words. `problems` fail it, and `remedy` is the command that mends them, if there
    is one. `chain` are lines on its inputs and stages. `approved` is what a statement of a manifest that passes says.
    """

    name: str
    spec: str
    what: str
    problems: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    remedy: str | None = None
    stages: tuple[Stage, ...] = ()
    chain: tuple[str, ...] = ()
    approved: Approved | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdicts:
    """The verdicts on all applications that were judged.

    `rules` are files that judge the change and changed with it, without an approval, `others` files and deployments without
    a spec, `invalid` the specs that cannot be read, `skipped` the applications that
    no file concerns which changed since the commit `since`.
    """

    judged: Sequence[Verdict]
    rules: Sequence[str] = ()
    others: Sequence[str] = ()
    invalid: Sequence[str] = ()
    skipped: Sequence[str] = ()
    since: str | None = None

    @property
    def failed(self) -> list[str]:
        """What is not as it should be: names of applications, and files without a spec."""
        return [*(one.name for one in self.judged if one.problems), *self.rules, *self.others]

    @property
    def approved(self) -> list[Approved]:
        """What the manifests approve."""
        return [one.approved for one in self.judged if one.approved is not None]


@dataclass(frozen=True, slots=True)
class Gate:
    """What all applications are judged by; a process that helps is sent it. `resolve_image` is the option of `apply`."""

    policies: tuple[str, ...] = ()
    rules: Rules = field(default_factory=Rules)
    commit: str | None = None
    resolve_image: bool = False

    def judge(self, loaded: Sequence[LoadedSpec], workers: int | None) -> list[Verdict]:
        """Return a verdict on each of these applications, by so many processes: see `share`.

        Raise the errors of `Inputs.load`.
        """
        return share(self._judge, loaded, workers)

    def _judge(self, loaded: Sequence[LoadedSpec]) -> list[Verdict]:
        repository = None if self.commit is None else Repository()
        inputs = Inputs.load([], audit=True, each=True, recorded=True, loaded=loaded)
        rules = Policies(self.policies, self.rules.before, policies_read(inputs))
        return [judge(look(one, self.commit), rules, repository, self.commit, self.resolve_image) for one in inputs]


def judge(
    found: Status, policies: Policies, repository: Repository | None, commit: str | None, resolve_image: bool = False
) -> Verdict:
    """Return the verdict on one application; `commit` is the base, None without a repository.

    `apply` refuses an image that is not pinned, unless it is to resolve it.
    """
    inputs, layout = found.inputs, found.layout
    deploys = layout.manifest in inputs.on_disk
    # Before a first compile, which prices count is not known.
    unborn = inputs.pins is None and not (
        inputs.on_disk.keys() - {layout.agent} or inputs.results_files or found.damaged
    )
    problems = [] if unborn else found.problems_of(list(_due(found)))
    if deploys and not problems:
        problems += _refused_by_apply(inputs, resolve_image)
    approved = _approved(inputs) if deploys and not problems else None
    if not deploys and repository is not None and commit is not None:
        had = repository.at(commit, layout.manifest) is not None
        problems += [
            f"{layout.manifest}: it is committed at the base and missing now: what runs could not be updated"
        ] * had
    problems += [one.message for one in _policy_problems(inputs, policies)]
    if (tracked := tracked_state(layout)) is not None:
        problems.append(f"{tracked}: git tracks live state, which bench and apply refuse")
    return Verdict(
        name=layout.name,
        spec=str(layout.spec),
        what=_what(found),
        problems=tuple(dict.fromkeys(problems)),
        warnings=() if found.artifacts is None else found.artifacts.chart_warnings,
        remedy=found.remedy if _due(found) or found.refused is not None else None,
        stages=found.stages,
        chain=tuple(_chain(found)),
        approved=approved,
    )


def _due(found: Status) -> list[Stage]:
    """Return the stages that are not fresh and should be: before anything is measured, only a plan that was begun."""
    inputs, layout = found.inputs, found.layout
    if layout.manifest in inputs.on_disk or inputs.results_files or found.refused is not None:
        return list(found.unsettled)
    begun = any(layout.compiled in path.parents for path in inputs.on_disk)
    return [stage for stage in found.unsettled if begun and stage.name == "plan"]


def _what(found: Status) -> str:
    inputs, layout = found.inputs, found.layout
    if found.damaged:
        return "damaged"
    if layout.manifest in inputs.on_disk:
        kept = f"; {inputs.prices_kept}" if inputs.unread else ""
        partial = f": partial, {found.partial}" if found.partial else ""
        return f"manifest {'not ' * bool(_due(found) or found.refused)}verified{partial}{kept}"
    if inputs.results_files:
        infeasible = not _due(found) and found.artifacts is not None and found.artifacts.infeasible
        unsettled = infeasible and found.artifacts is not None and found.artifacts.settles
        why = "not settled" if unsettled else "no machine meets the limits" if infeasible else "no manifest"
        return f"measured, {why}: nothing to deploy"
    begun = any(layout.compiled in path.parents for path in inputs.on_disk)
    return "planned, nothing measured" if begun else "not compiled: nothing to deploy"


def _chain(found: Status) -> Iterator[str]:
    """Yield the inputs that the stages follow from, and the stages, with the digests of their files."""
    inputs, about = found.inputs, found.inputs.catalog.about
    yield f"{'spec':<9} {inputs.layout.spec}"
    yield f"{'catalog':<9} {' '.join(filter(None, (about.source, about.revision, about.date)))}  {about.digest}"
    lock = "none: catalog and image tags are not frozen" if inputs.pins is None else str(inputs.layout.lock)
    yield f"{'lock':<9} {lock}"
    records = [] if inputs.results is None else inputs.results.spec.samples
    raw = sum(one.timings is not None for one in records)
    yield f"{'timings':<9} kept for {raw} of {count(len(records), 'record')}"
    for stage in found.stages:
        content = inputs.content(stage.path)
        of_file = "" if content is None else of_bytes(content)
        named = found.inputs.results.integrity if stage.name == "results" and found.inputs.results else of_file
        yield f"{stage.name:<9} {stage.state:<8} {stage.path}  {named}".rstrip()
        yield from (f"{'':<9} {'':<8} {text}" for text in stage.notes)


def _approved(inputs: Inputs) -> Approved:
    file = inputs.on_disk[inputs.layout.manifest]
    return Approved.of(ManifestBundle(file.document(Manifest), file.content, inputs))


def _refused_by_apply(inputs: Inputs, resolve_image: bool) -> Iterator[str]:
    """Yield why `apply` refuses a fresh manifest: its end has come, or its image is not pinned."""
    file, layout = inputs.on_disk[inputs.layout.manifest], inputs.layout
    until = file.document(Manifest).spec.until
    if until is not None:
        end = parse_until(until)
        left_s = (end - datetime.now(UTC)).total_seconds() if isinstance(end, datetime) else end
        if left_s < LEAST_LIFETIME_S:
            yield f"spec.deployment.until: {until} is over, or less than a minute away, so that apply refuses it"
    manifest = None if resolve_image else Deployed.of(file)
    if manifest is not None and (image := manifest.unpinned_image) is not None:
        pin = (
            f"{shell_command('fogspec', 'lock', layout.spec)}, then {shell_command('fogspec', 'compile', layout.spec)}"
        )
        yield f"image {image} is not pinned, so that apply refuses it: {pin}"


def _policy_problems(inputs: Inputs, policies: Policies) -> list[Diagnostic]:
    loaded: Sequence[LoadedSpec] = [inputs.spec]
    return [*policies.check_specs(loaded), *policies.check_manifests(loaded, Manifest, dict(inputs.on_disk))]


def as_text(found: Verdicts, chain: bool = False) -> str:
    """Return a line for each application with its problems, also its `chain`, what has no spec, and a summary."""
    names = [*(one.name for one in found.judged), *found.skipped]
    width = max(map(len, names), default=0)
    lines = []
    for one in found.judged:
        lines.append(f"{'FAIL' if one.problems else 'ok  '}  {one.name:<{width}}  {one.what}".rstrip())
        if chain:
            lines += [f"      {text}" for text in one.chain]
        lines += [f"      {text}" for text in (*one.problems, *one.warnings)]
        lines += [f"      fix: {one.remedy}"] if one.problems and one.remedy else []
    lines += [
        f"--    {name:<{width}}  not judged: nothing that concerns it changed since {found.since}"
        for name in found.skipped
    ]
    lines += [
        f"FAIL  {text}"
        for text in (
            *map(_of_rule, found.rules),
            *found.others,
            *(f"{path}: invalid, see above" for path in found.invalid),
        )
    ]
    summary = []
    if names or not found.invalid:
        were = "was" if len(found.judged) == 1 else "were"
        judged = f"{len(found.judged)} of {count(len(names), 'application')} {were} judged"
        summary.append(f"{judged}: {len(found.failed) or 'none'} failed")
    if found.invalid:
        summary.append(f"{len(found.invalid)} {'file is' if len(found.invalid) == 1 else 'files are'} invalid")
    return paragraph([*lines, ", ".join(summary)])


def _of_rule(path: str) -> str:
    return f"{path}: it judges this change, and changed with it; to accept that: check --allow-policy-change"


def as_diagnostics(found: Verdicts) -> Iterator[Diagnostic]:
    """Yield each problem as a diagnostic of the spec, or of the file that has none."""
    for one in found.judged:
        yield from (
            Diagnostic("check", f"{one.name}: {text}", Span(one.spec, 1, 1), one.remedy) for text in one.problems
        )
    yield from (
        Diagnostic("check", text, Span(text.partition(":")[0], 1, 1))
        for text in (*map(_of_rule, found.rules), *found.others)
    )


def as_dict(found: Verdicts) -> Mapping[str, Any]:
    """Return the verdicts as values for JSON."""
    return {
        "passed": not found.failed and not found.invalid,
        "applications": [
            {
                "name": one.name,
                "what": one.what,
                "problems": list(one.problems),
                "warnings": list(one.warnings),
                "remedy": one.remedy,
                "stages": list(map(stage_data, one.stages)),
            }
            for one in found.judged
        ],
        "rules_changed": list(found.rules),
        "without_spec": list(found.others),
        "invalid": list(found.invalid),
        "not_judged": list(found.skipped),
    }
