"""Teardown of an application: everything that runs under its name, verified gone, by whatever process started."""

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from fogspec.backends.naming import Owner
from fogspec.backends.protocol import DeploymentBackend, Job, Unreachable
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import CloudError, FogspecError, Interrupted, InvalidInput, UsageError
from fogspec.base.git import check_untracked, tracked_state
from fogspec.base.layout import MOST_BYTES, Layout
from fogspec.base.project_files import LinkedPath
from fogspec.base.repository import committed
from fogspec.base.signals import finishing
from fogspec.base.text import shell_command
from fogspec.bench.journal import JournalState
from fogspec.deploy.apply import stop_machine
from fogspec.deploy.shared_state import SharedRecord, holding, shared_layouts, store_of
from fogspec.deploy.state import DeploymentState, WallClock

Confirm = Callable[[Sequence[str]], None]


def layout_of(spec_or_name: str) -> Layout:
    """Return the layout of the application of a spec's path or a name.

    Raise InvalidInput for an invalid spec, UsageError for a name that nothing has. A name needs only the live state below
    the working directory: the spec may be deleted.
    """
    from fogspec.language.loader import load

    if spec_or_name.endswith((".yaml", ".yml")) or "/" in spec_or_name:
        try:
            found = [one for one in load([spec_or_name]) if one.base is None]
        except DiagnosticError as wrong:
            what, at = wrong.diagnostics[0], Path(spec_or_name)
            name = at.parent.name if at.parent.parent.name in ("compiled", "results") else at.stem
            raise InvalidInput(
                f"{what.span.path}:{what.span.line}:{what.span.column}: {what.message}",
                f"what runs is ended by its application's name too: {shell_command('fogspec', 'down', name)}",
            ) from None
        if len(found) > 1:
            names = ", ".join(one.name for one in found)
            raise InvalidInput(f"{spec_or_name} has several applications", f"name one of them: {names}")
        return found[0].layout
    layout = Layout.named(Path(), spec_or_name)
    if os.path.basename(spec_or_name) != spec_or_name or spec_or_name in (".", "..", ""):
        raise InvalidInput(f"{spec_or_name!r} is not an application's name", "name one, or its spec")
    known = layout.files.is_folder(layout.state) or layout.files.is_folder(layout.compiled)
    sources = (layout.plan, layout.spec) if layout.overlay is None else (layout.manifest, layout.overlay)
    known = known or layout.files.exists(sources[1])
    known = known or any(committed(layout.root, path) for path in sources)
    if not known and (store := store_of(layout)) is not None:
        known = any(one.name == layout.name for one in shared_layouts(store, layout.root))
    if not known:
        raise UsageError(f"there is no application named {spec_or_name} here", *_meant(layout, spec_or_name))
    with contextlib.suppress(DiagnosticError, InvalidInput):
        load([layout.spec])  # what machines say is printed without the secrets that it names
    return layout


def _meant(layout: Layout, name: str) -> list[str]:
    """Return the known name that is nearest to this one, else where it was looked for, as a list of hints."""
    from fogspec.deploy.running import layouts
    from fogspec.language.discover import applications
    from fogspec.language.suggest import did_you_mean

    known = [*applications(), *(one.name for one in layouts(layout.root))]
    return did_you_mean(name, known) or [f"looked for {layout.state} and {layout.compiled}"]


def leave_link(layout: Layout) -> None:
    """Forget the cloud's end of the link, if the spec still exists, is valid, and has a link."""
    from fogspec.deploy.link import leave
    from fogspec.language.loader import load

    with contextlib.suppress(DiagnosticError, InvalidInput):
        for one in load([layout.spec]):
            if one.name == layout.name:
                leave(one.application, layout)


def down(
    layout: Layout,
    backends: Sequence[Callable[[], DeploymentBackend]],
    times: WallClock,
    report: Callable[[str], None],
    confirm: Confirm | None = None,
    owner: Owner | None = None,
) -> tuple[int, float]:
    """Stop everything of one application; return the number of machines, and their cost in USD.

    `confirm` is called with the names of the machines before the first is stopped, and may raise. `owner` is another one than
    the application of this repository, whose machines are stopped in place of ours.

    Machines that are not in the live state are found by the application's name, also those of a bench that died. If one
    backend is unavailable, the machines of the others are still stopped.
    Raise Busy while a bench or an apply runs, CloudError for machines that could not be verified gone.
    """
    try:
        what = f"down of {layout.name}"
        with finishing(), holding(layout, what, times, report, salvage=True, owner=owner, ends=True) as record:
            live = readable_state(layout, times, report, record, owner)
            live.verb = "down"
            done = _down(live, backends, report, confirm, others_too=owner is not None)
        if layout.files.remove_folder(layout.state):
            layout.files.remove_folder(layout.state.parent)
        return done
    except KeyboardInterrupt:
        again = f"run it again: fogspec down {layout.name}"
        raise Interrupted("interrupted: what was not said to be gone may still run", again) from None
    except (BrokenPipeError, FogspecError):
        raise
    except OSError as problem:
        message = f"{problem.filename or layout.state}: {problem.strerror or problem}"
        raise InvalidInput(message, f"run it again: fogspec down {layout.name}") from None


def readable_state(
    layout: Layout,
    times: WallClock,
    report: Callable[[str], None],
    record: SharedRecord | None,
    owner: Owner | None = None,
) -> DeploymentState:
    """Return the live state; a damaged record hides no machine, since all are found by name too, and is kept."""
    if record is not None and record.damaged is not None:
        report(f"{record.path}: it is damaged: machines are found by their names")
        damaged = DeploymentState(layout, times, [], unreadable=True, record=record, manifests={}, _owner=record.owner)
        damaged.where = record.path
        return damaged
    if record is None and (tracked := tracked_state(layout)) is not None:
        report(f"{layout.root / tracked}: git tracks it, so its machines are found by their names")
        return DeploymentState(layout, times, [], unreadable=True, _owner=owner)
    try:
        return DeploymentState.read(layout, times, record, owner)
    except (DiagnosticError, LinkedPath) as problem:
        why = problem.diagnostics[0].message if isinstance(problem, DiagnosticError) else problem.message
        report(f"{layout.live}: {why}: machines are found by their names")
        return DeploymentState(layout, times, [], unreadable=True, _owner=owner)


def _down(
    live: DeploymentState,
    makers: Sequence[Callable[[], DeploymentBackend]],
    report: Callable[[str], None],
    confirm: Confirm | None,
    others_too: bool,
) -> tuple[int, float]:
    backends, left, ended = list[DeploymentBackend](), list[str](), 0
    unwritten: list[InvalidInput | OSError] = []
    for make in makers:
        with _collecting(left, unwritten):
            backends.append(make())
    by_name = {one.name: one for one in backends}
    spent = live.total_usd()
    if confirm is not None and (names := _named(live, backends, report)):
        confirm(names)
    for machine in list(live.machines):
        with _collecting(left, unwritten):
            if machine.deployer in by_name:
                stop_machine(live, machine, by_name[machine.deployer], report)
                ended += 1
            elif not left:
                raise Unreachable(f"{machine.name}: this environment cannot terminate what {machine.deployer} started")
    for backend in backends:
        with _collecting(left, unwritten):
            ended += _orphans(live, backend, report)
    if left:
        raise CloudError(f"{live.layout.name}: not everything could be verified gone", *left, "safe to run again")
    if unwritten:
        raise unwritten[0]
    if not (others_too and live.foreign):  # else the rest of the record is of this repository's application
        _clear(live, report)
    return ended, spent


def _clear(live: DeploymentState, report: Callable[[str], None]) -> None:
    """Remove the record of an application of which nothing runs; raise Refused for one that git tracks, and ForeignMachine."""
    if live.record is None:
        check_untracked(live.layout)
    live.check_owned()
    if (kept := live.set_aside()) is not None:
        report(f"{kept} is the live state that cannot be read: nothing of this application runs any more, remove it")
    for path in live.clear():
        report(f"{path}: removed")


def _named(live: DeploymentState, backends: Sequence[DeploymentBackend], report: Callable[[str], None]) -> list[str]:
    """Return the names of the machines that would be stopped: those on record, and those that can be listed."""
    names = [one.name for one in live.machines]
    for backend in backends:
        try:
            names += backend.list(live.owner, live.layout.state)
        except Unreachable as lost:
            report(f"{backend.name}: cannot be listed just now: {lost}")
    return list(dict.fromkeys(names))


def _orphans(live: DeploymentState, backend: DeploymentBackend, report: Callable[[str], None]) -> int:
    """Stop machines with the application's name that are not in the live state; return their number."""
    layout = live.layout
    known = {one.name for one in live.machines} | {act.name for act in live.history if act.did == "ended"}
    names = list(backend.list(live.owner, layout.state))
    for name in [*names, *(name for name in _journaled(live, backend.name) if name not in names)]:
        directory = live.folder(name) if live.owner.has_deployment(name) else layout.state / "attempts" / name
        backend.stop(Job(name=name, owner=live.owner, root=layout.root, directory=directory))
        if name in names:
            report(f"{name}: gone")
        if live.owner.has_deployment(name) and name not in known:
            live.gone_by_name(name)
    if rest := backend.list(live.owner, layout.state):
        raise Unreachable(f"still there: {', '.join(rest)}")
    return len(names)


def _journaled(live: DeploymentState, runner: str) -> list[str]:
    """Return the machines that benches started with this runner and have not verified gone: a list may lack them."""
    with contextlib.suppress(OSError, FogspecError):
        opened = JournalState.read(live.layout.files.head(live.layout.journal, MOST_BYTES)).open
        return [name for name, one in opened.items() if one.runner == runner and live.owner.has(name)]
    return []


@contextlib.contextmanager
def _collecting(left: list[str], unwritten: list[InvalidInput | OSError]) -> Iterator[None]:
    """Collect problems: a failure with one machine must not keep another one alive."""
    try:
        yield
    except CloudError as failed:
        left.append("; ".join([failed.message, *failed.hints]))
    except Unreachable as lost:
        left.append(str(lost))
    except (InvalidInput, OSError) as problem:
        unwritten.append(problem)
