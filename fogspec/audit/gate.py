"""The gate of a pull request: whether `apply` would deploy exactly what is committed, for every application.

All verbs have one rule of freshness (`fogspec.audit.freshness`), one of the chain (`fogspec.audit.verify`) and one of
policies; this module asks them all, and what no other verb sees: manifests that a change took away, and files without a spec.
"""

import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fogspec.audit.diff import manifest_in
from fogspec.audit.freshness import Status, located, look, status
from fogspec.audit.git import Repository
from fogspec.audit.review import machine_in
from fogspec.audit.shared_work import share
from fogspec.audit.verify import verify
from fogspec.base.diagnostics import Diagnostic, DiagnosticError
from fogspec.base.errors import FogspecError
from fogspec.base.git import tracked_state
from fogspec.base.layout import Layout
from fogspec.base.text import paragraph, shell_command
from fogspec.base.units import parse_until
from fogspec.compile.artifacts import Artifacts
from fogspec.compile.bundle import ManifestBundle
from fogspec.compile.compiler import try_compile
from fogspec.compile.inputs import Inputs
from fogspec.compile.manifest import Manifest
from fogspec.compile.tasks import LEAST_LIFETIME_S
from fogspec.spec.loader import LoadedSpec
from fogspec.spec.rules.policies import Policies

SHOWN = 3


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the gate found of one application: `problems` fail it; `what` is what would be deployed, in a few words."""

    name: str
    what: str
    problems: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Gate:
    """What all applications are judged by; a process that helps is sent it. `resolve_image` is the option of `apply`."""

    catalog: str | None = None
    policies: tuple[str, ...] = ()
    commit: str | None = None
    resolve_image: bool = False

    def judge(self, loaded: Sequence[LoadedSpec], workers: int | None) -> list[Verdict]:
        """Return a verdict on each of these applications, by so many processes: see `share`.

        Raise the errors of `Inputs.load`.
        """
        return share(self._judge, loaded, workers)

    def _judge(self, loaded: Sequence[LoadedSpec]) -> list[Verdict]:
        repository = None if self.commit is None else Repository()
        inputs = Inputs.load([], catalog=self.catalog, audit=True, each=True, loaded=loaded)
        rules = Policies(self.policies)
        return [judge(one, rules, repository, self.commit, self.resolve_image) for one in inputs]


def judge(
    inputs: Inputs, policies: Policies, repository: Repository | None, commit: str | None, resolve_image: bool = False
) -> Verdict:
    """Return the verdict on one application; `commit` is the base, None without a repository.

    `apply` refuses an image that is not pinned, unless it is to resolve it.
    """
    layout = inputs.layout
    try:
        compiled: Artifacts | FogspecError = try_compile(inputs)
    except DiagnosticError:
        return Verdict(layout.name, "damaged", look(inputs, commit).stages[0].reasons)
    found = status(inputs, compiled)
    problems = [] if found.refused is None else [f"cannot be compiled: {found.refused}"]
    if layout.manifest in inputs.on_disk:
        broken = list(_manifest(inputs, compiled, found))
        what = "manifest not verified" if broken else "manifest verified"
        what += f": partial, {found.partial}" if found.partial else ""
        problems += broken
        problems += [] if broken else _over(inputs)
        image = _unpinned(inputs)
        if image is not None and not broken and not resolve_image:
            spec = inputs.layout.spec
            pin = f"{shell_command('fogspec', 'lock', spec)}, then {shell_command('fogspec', 'compile', spec)}"
            problems.append(f"image {image} is not pinned, so that apply refuses it: {pin}")
    else:
        what = "not compiled: nothing to deploy"
        if inputs.results_file is not None or any(layout.compiled in path.parents for path in inputs.on_disk):
            what = "planned, nothing measured" if inputs.results_file is None else "measured, no manifest"
            problems += _stale(found)
        had = repository is not None and commit is not None and repository.at(commit, layout.manifest) is not None
        if had:
            problems.append(
                f"{layout.manifest}: it is committed at the base and missing now: what runs could not be updated"
            )
    problems += [one.message for one in _policy_problems(inputs, policies)]
    if (tracked := tracked_state(layout)) is not None:
        problems.append(f"{tracked}: git tracks live state, which bench, apply and down refuse")
    return Verdict(layout.name, what, tuple(dict.fromkeys(problems)))


def _manifest(inputs: Inputs, compiled: Artifacts | FogspecError, found: Status) -> Iterator[str]:
    """Yield why `apply` would refuse the manifest on disk, or deploy something else than was reviewed."""
    file = inputs.on_disk[inputs.layout.manifest]
    try:
        opened = ManifestBundle(file.document(Manifest), file.content, inputs)
    except DiagnosticError as damaged:
        yield from map(located, damaged.diagnostics)
        return
    for link in verify(opened, compiled):
        if link.breaks:
            yield f"{link.name}: {'; '.join(link.breaks[:SHOWN])}"
    yield from _stale(found)


def _over(inputs: Inputs) -> Iterator[str]:
    """Yield that the end in the manifest has come, if it has."""
    until = inputs.on_disk[inputs.layout.manifest].document(Manifest).spec.until
    if until is None:
        return
    end = parse_until(until)
    left_s = (end - datetime.now(UTC)).total_seconds() if isinstance(end, datetime) else end
    if left_s < LEAST_LIFETIME_S:
        yield f"spec.deployment.until: {until} is over, or less than a minute away, so that apply refuses it"


def _unpinned(inputs: Inputs) -> str | None:
    """Return the image of the manifest if it is not pinned and the machine runs it in a container."""
    manifest = manifest_in(inputs.on_disk[inputs.layout.manifest])
    machine = machine_in(manifest)
    return None if machine is None else machine.unpinned_image


def _stale(found: Status) -> Iterator[str]:
    """Yield the stages that are not fresh; before anything is measured, results are no problem."""
    measured = found.layout.manifest in found.inputs.on_disk or found.inputs.results_file is not None
    for stage in found.stages:
        early = not measured and stage.name != "plan"
        if not found.settled(stage) and not early:
            yield stage.words + (f": {'; '.join(stage.reasons[:SHOWN])}" if stage.reasons else "")


def _policy_problems(inputs: Inputs, policies: Policies) -> list[Diagnostic]:
    loaded: Sequence[LoadedSpec] = [inputs.spec]
    return [*policies.check_specs(loaded), *policies.check_manifests(loaded, Manifest, dict(inputs.on_disk))]


def leftovers(root: Path, names: Collection[str]) -> list[str]:
    """Return compiled files and results below `root` that belong to no application of these names."""
    files = Layout.of(root / "specs" / "any.yaml", "any").files
    found = []
    for name in files.names(root / "compiled"):
        folder = root / "compiled" / name
        if (
            name not in names
            and files.is_folder(folder)
            and any(files.is_file(folder / one) for one in ("plan.yaml", "manifest.yaml"))
        ):
            found.append(f"{folder}: no spec has an application of this name")
    for name in files.names(root / "results"):
        path = root / "results" / name
        if name.endswith(".yaml") and name.removesuffix(".yaml") not in names and files.is_file(path):
            found.append(f"{path}: no spec has an application of this name")
    return found


def changed(loaded: Sequence[LoadedSpec], paths: Collection[Path]) -> set[str]:
    """Return the applications for which a change of these files may matter, paths as they are named on disk.

    Their spec, its compiled files and results, and the overlay of the environment; any other file beside the spec, for it is
    sent to machines; lock and policies.
    """
    whole = {os.path.abspath(path) for path in paths}
    specs = {os.path.abspath(one.path) for one in loaded}
    return {one.name for one in loaded if any(_matters(path, one.layout, specs) for path in whole)}


def _matters(path: str, layout: Layout, specs: Collection[str]) -> bool:
    spec, root = os.path.abspath(layout.spec), os.path.abspath(layout.root)
    if path == spec or path in map(os.path.abspath, (layout.lock, layout.agent, layout.overlay or layout.spec)):
        return True
    if path in specs:
        return False
    results = os.path.abspath(layout.results)
    folders = (
        os.path.abspath(layout.compiled),
        os.path.abspath(layout.planned),
        results.removesuffix(".yaml"),
        os.path.join(root, "policies"),
        os.path.dirname(spec),
    )
    return path == results or any(path.startswith(folder + os.sep) for folder in folders)


def as_text(
    verdicts: Sequence[Verdict], others: Sequence[str], invalid: Sequence[str], skipped: int, since: str | None
) -> str:
    """Return a line for each application with its problems, files without a spec, invalid files, and a summary."""
    width = max((len(one.name) for one in verdicts), default=0)
    lines = []
    for one in verdicts:
        lines.append(f"{'FAIL' if one.problems else 'ok  '}  {one.name:<{width}}  {one.what}".rstrip())
        lines += [f"      {text}" for text in one.problems]
    lines += [f"FAIL  {text}" for text in (*others, *(f"{path}: invalid, see above" for path in invalid))]
    failed = sum(bool(one.problems) for one in verdicts) + len(others)
    total = len(verdicts) + skipped
    summary = []
    if total or not invalid:
        summary.append(f"{total} {'application' if total == 1 else 'applications'}: {failed or 'none'} failed")
    if invalid:
        summary.append(f"{len(invalid)} {'file is' if len(invalid) == 1 else 'files are'} invalid")
    if skipped:
        summary.append(f"{skipped} not changed since {since}")
    return paragraph([*lines, ", ".join(summary)])


def as_dict(
    verdicts: Sequence[Verdict], others: Sequence[str], invalid: Sequence[str], skipped: Sequence[str]
) -> Mapping[str, Any]:
    """Return the verdicts as values for JSON."""
    return {
        "passed": not others and not invalid and not any(one.problems for one in verdicts),
        "applications": [{"name": one.name, "what": one.what, "problems": list(one.problems)} for one in verdicts],
        "without_spec": list(others),
        "invalid": list(invalid),
        "not_changed": list(skipped),
    }
