"""Taking over what runs and is in no live state: by its name and labels, and by what its nodes say now."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from fogspec.backends.naming import FALLBACK_LABEL, MANIFEST_LABEL, RUNS_LABEL
from fogspec.backends.protocol import DeploymentBackend, Job, LaunchRefused, Unreachable
from fogspec.base import digest
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import CloudError, FogspecError, UsageError
from fogspec.base.git import git
from fogspec.base.layout import MOST_BYTES, Layout
from fogspec.base.repository import head_of
from fogspec.compile.manifest import Manifest
from fogspec.deploy.down import readable_state
from fogspec.deploy.preflight import LaunchPlan
from fogspec.deploy.schema import DeployedMachine, date_of
from fogspec.deploy.shared_state import holding
from fogspec.deploy.state import DeploymentState, WallClock
from fogspec.language.loader import SourceFile

UNKNOWN_RUNS = "unknown"  # what it was given is not known: the next apply replaces it
COMMITS = 200


class _NotAdopted(Exception):
    """A machine is not taken over, for the reason given."""


@dataclass(frozen=True, slots=True)
class Adopted:
    """The machines that were taken over, and why others were not; `serves` names that which is given what apply would give."""

    machines: tuple[DeployedMachine, ...]
    left: tuple[str, ...]
    serves: str | None


def adopt(
    layout: Layout,
    planned: LaunchPlan | None,
    backends: Sequence[Callable[[], DeploymentBackend]],
    times: WallClock,
    report: Callable[[str], None],
) -> Adopted:
    """Write the machines that serve an application and are in no record into its live state; nothing is started or ended.

    `planned` is what `apply` would start now, None if it would refuse. A machine is known by its name, which has the digest of
    repository and application, and by its labels, which have those of its manifest and of all that it was given; the
    manifest is on disk or was committed, and the nodes must answer. A damaged record is set aside once there is a new one.
    The record is that of an apply from here, of the commit that has the manifest.
    Raise Busy while another command works on the application, CloudError if machines cannot be listed.
    """
    what = f"apply --adopt of {layout.name}"
    with holding(layout, what, times, report, salvage=True) as record:
        live = readable_state(layout, times, report, record)
        live.verb = "apply --adopt"
        live.check_owned()
        known = {one.name for one in live.machines}
        found, left = list[DeployedMachine](), list[str]()
        manifests = dict[str, bytes]()
        for backend, name in _running(live, backends):
            if name in known:
                continue
            try:
                machine, manifests[name] = _machine(live, planned, backend, name)
            except _NotAdopted as why:
                left.append(f"{name}: {why}")
            else:
                found.append(machine)
        # The one that apply would keep comes first: health and diff look at the first that serves.
        wanted = set() if planned is None else {one.runs for one in planned.candidates}
        found.sort(key=lambda one: one.runs not in wanted)
        if found and (kept := live.set_aside()) is not None:
            report(f"{kept} is the live state that cannot be read")
        for machine in found:
            live.put(machine)
            live.keep_manifest(machine.name, manifests[machine.name])
        serves = next((one.name for one in found if one.runs in wanted), None)
        return Adopted(tuple(found), tuple(left), serves)


def _running(
    live: DeploymentState, makers: Sequence[Callable[[], DeploymentBackend]]
) -> Iterator[tuple[DeploymentBackend, str]]:
    """Yield the deployments of the application that run; raise CloudError if they cannot be listed."""
    seen = set[str]()
    for make in makers:
        backend = make()
        try:
            names = backend.list(live.owner, live.layout.state)
        except Unreachable as lost:
            raise CloudError(f"{live.layout.name}: status unknown, no contact: {lost}", "safe to run again") from None
        yield from ((backend, name) for name in names if live.owner.has_deployment(name) and name not in seen)
        seen |= set(names)


def _machine(
    live: DeploymentState, planned: LaunchPlan | None, backend: DeploymentBackend, name: str
) -> tuple[DeployedMachine, bytes]:
    """Return the record of a machine and its manifest; raise _NotAdopted."""
    layout, times = live.layout, live.times
    job = Job(name=name, owner=live.owner, root=layout.root, directory=live.folder(name))
    try:
        labels, status = backend.labels(job), backend.poll(job)
    except Unreachable as lost:
        raise _NotAdopted(f"no contact just now: {lost}") from None
    except LaunchRefused as no:
        raise _NotAdopted(f"its machine is gone: {no.detail}") from None
    if status.state != "ready":
        detail = f": {status.detail}" if status.detail else ""
        raise _NotAdopted(f"its nodes do not answer, it is {status.state}{detail}; fogspec down {layout.name} ends it")
    content, commit = _manifest(layout, labels, name)
    manifest = _parsed(content, name)
    number = int(text) if (text := labels.get(FALLBACK_LABEL, "0")).isdigit() else 0
    reviewed = [manifest.spec.machine, *(one.machine for one in manifest.spec.fallbacks)]
    runs = digest.from_label(labels.get(RUNS_LABEL, "")) or UNKNOWN_RUNS
    same = planned is not None and any(one.runs == runs for one in planned.candidates)
    return (
        DeployedMachine(
            name=name,
            deployer=backend.name,
            place=live.place(backend.name),
            state="serving",
            manifest=digest.of_bytes(content),
            machine=reviewed[number] if number < len(reviewed) else reviewed[0],
            runs=runs,
            fallback=number,
            image=planned.image if planned is not None and same else manifest.spec.image,
            files=dict(planned.files) if planned is not None and same else None,
            address=status.address,
            at=times.now_s(),
            boot=times.boot(),
            since=date_of(times.date().timestamp()),
            applied=live.applied(commit),
        ),
        content,
    )


def _manifest(layout: Layout, labels: Mapping[str, str], name: str) -> tuple[bytes, str | None]:
    """Return the manifest that a machine was started for, on disk or committed, and its commit; raise _NotAdopted."""
    wanted = digest.from_label(labels.get(MANIFEST_LABEL, ""))
    short = name.rsplit("-", 2)[1]  # machines of former versions have no label, and 8 digits in their name
    for content, commit in _versions(layout):
        found = digest.of_bytes(content)
        if found == wanted or (wanted is None and digest.shorten(found, len(short)) == short):
            return content, commit
    raise _NotAdopted(
        f"it was started for a manifest {short}… that is neither at {layout.manifest} nor among the last {COMMITS} commits "
        f"of it here: fetch its commit, or fogspec down {layout.name} ends it"
    )


def _versions(layout: Layout) -> Iterator[tuple[bytes, str | None]]:
    """Yield the manifest on disk with HEAD, and each that was committed with its commit, the latest first."""
    if layout.files.is_file(layout.manifest):
        yield layout.files.head(layout.manifest, MOST_BYTES + 1), head_of(layout.root)
    folder, path = os.path.realpath(layout.root), Path(layout.relative(layout.manifest))
    try:
        commits = git("log", "--all", f"--max-count={COMMITS}", "--format=%H", "--", f"./{path}", folder=folder).split()
    except UsageError:
        return
    for commit in map(bytes.decode, commits):
        try:
            yield git("cat-file", "blob", f"{commit}:./{path}", folder=folder), commit
        except UsageError:
            continue  # that commit removed it


def _parsed(content: bytes, name: str) -> Manifest:
    try:
        return SourceFile(f"manifest of {name}", content).document(Manifest)
    except (DiagnosticError, FogspecError):
        raise _NotAdopted("its manifest is of another version of fogspec") from None
