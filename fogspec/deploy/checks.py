"""The requirements of a bench or an apply, before money is spent: one list, which `--dry-run` prints.

No machine is started and nothing is written. What only the provider can tell is `NOT_CHECKED`, with the provider's own command.
"""

import contextlib
import os
import shutil
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path

from fogspec.agent import machine_facts
from fogspec.backends.images.registry import NotShown
from fogspec.backends.protocol import DeploymentBackend, NoAnswer
from fogspec.backends.skypilot.client import Client, supported_versions
from fogspec.base import child, host, units
from fogspec.base.clouds import cloud_of, quota_command
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import CloudError, FogspecError, InvalidInput
from fogspec.base.git import check_untracked, tracked_state
from fogspec.base.layout import MOST_BYTES, Layout
from fogspec.base.redaction import check_set
from fogspec.base.text import shell_command
from fogspec.bench.journal import JournalState
from fogspec.catalog.machine import Machine
from fogspec.catalog.table import Catalog
from fogspec.compile.inputs import Inputs, age_warning, catalogs_for, unpriced
from fogspec.compile.links import link_of
from fogspec.compile.tasks import image_use
from fogspec.deploy import link
from fogspec.deploy.state import DeploymentState, WallClock
from fogspec.language.loader import LoadedSpec, SourceFile
from fogspec.language.lock_io import files_sent, read_pins
from fogspec.language.lockfile import ImageUse, image_named, is_pinned, pinned
from fogspec.language.rules.benchmark import PLACEHOLDERS
from fogspec.results.schema import Results

SHOWN = 6  # names of a list
SPARE_BYTES = 256 << 20  # for results, logs and state, besides the copy of the files that are sent
TOOLS = ("ssh", "rsync")  # by which SkyPilot's API server reaches machines

Backends = Callable[[str], DeploymentBackend]
Images = Callable[[str, ImageUse], None]


class Stage(StrEnum):
    """What the requirements are those of."""

    BENCH = "bench"
    APPLY = "apply"


class State(StrEnum):
    """The outcome of a check."""

    OK = "ok"
    PROBLEM = "problem"
    NOT_CHECKED = "not checked"


@dataclass(frozen=True, slots=True)
class Check:
    """One line: what was looked at, how it stands, and what to do. `application` is None for what concerns this computer."""

    application: str | None
    what: str
    state: State
    detail: str
    fixes: tuple[str, ...] = ()


def checks(
    loaded: Sequence[LoadedSpec],
    stage: Stage,
    places: Collection[str],
    times: WallClock,
    backend_for: Backends,
    check_image: Images,
    opened: Inputs | None = None,
    known: dict[Path, SourceFile] | None = None,
    here: Machine | None = None,
) -> Iterator[Check]:
    """Yield the checks of these applications, then those of this computer.

    `places` are where machines may be started, each an `infra`: SkyPilot's access is checked only if one is a cloud.
    `check_image` is `Registry.check`, `opened` are the inputs of the one application if they were read; files that are read
    are added to `known`. `here` is the machine to start if it is a shape of this host.
    Raise DiagnosticError for a damaged lock.
    """
    for one in loaded:
        yield from _application(one, stage, opened, times, check_image, known)
        if here is not None:
            yield _host(one.layout, here, None if opened is None else opened.measured.results)
    if clouds := sorted(place for place in set(places) if cloud_of(place).on_skypilot):
        yield from _skypilot(clouds, backend_for)


def as_dict(check: Check) -> dict[str, object]:
    """Return the check as JSON has it."""
    return {
        "application": check.application,
        "what": check.what,
        "state": str(check.state),
        "detail": check.detail,
        "fixes": list(check.fixes),
    }


def as_lines(one: Check, before: Check | None) -> list[str]:
    """Return the check in lines, below the name of its application if the check before it was another one's."""
    title = [] if before is not None and before.application == one.application else [one.application or "this computer"]
    fixes = [f"{'':26}{fix}" for fix in one.fixes]
    return [*title, f"  {one.state:<11}  {one.what:<9}  {one.detail}", *fixes]


def _application(
    one: LoadedSpec,
    stage: Stage,
    opened: Inputs | None,
    times: WallClock,
    check_image: Images,
    known: dict[Path, SourceFile] | None,
) -> Iterator[Check]:
    application, layout = one.application, one.layout
    name = layout.name

    def tried(what: str, fine: str, check: Callable[[], object]) -> Check:
        return _tried(name, what, fine, check)

    yield from _files(one, layout, measured=stage is Stage.BENCH)
    if stage is Stage.BENCH and not layout.files.exists(layout.plan):
        yield Check(name, "plan", State.NOT_CHECKED, "there is none yet", (_again("compile", layout),))
    if application.spec.secrets:
        yield tried("secrets", "all are in the environment", lambda: check_set(application.spec.secrets))
    yield from _inputs(one, stage, opened, check_image, known)
    if stage is Stage.APPLY and link_of(application).protocol is not None:
        yield tried("link", "the robot's public half is here", lambda: link.environment(application, layout))
    yield tried("state", "not in git", lambda: check_untracked(layout))
    if tracked_state(layout) is None:
        yield from _left_over(layout, stage, times)


def _again(verb: str, layout: Layout) -> str:
    return shell_command("fogspec", verb, layout.argument)


def _tried(name: str | None, what: str, fine: str, check: Callable[[], object]) -> Check:
    """Return the check that a function makes which raises if something is wrong."""
    try:
        check()
    except DiagnosticError as damaged:
        first = damaged.diagnostics[0]
        return Check(
            name,
            what,
            State.PROBLEM,
            f"{first.span.path}:{first.span.line}: {first.message}",
            (first.fix,) if first.fix else (),
        )
    except FogspecError as problem:
        return Check(name, what, State.PROBLEM, problem.message, problem.hints)
    return Check(name, what, State.OK, fine)


def _files(one: LoadedSpec, layout: Layout, measured: bool) -> Iterator[Check]:
    """Check that what the spec names is there, is the user's own, and is sent."""
    invented = [warning for warning in one.warnings if warning.code == PLACEHOLDERS]
    wrong = [*invented, *one.absent(measured)]
    for error in wrong:
        fixes = (error.fix,) if error.fix else ()
        yield Check(layout.name, "files", State.PROBLEM, f"{layout.spec}: {error.code} {error.message}", fixes)
    if not wrong:
        yield Check(layout.name, "files", State.OK, "all that the spec names are there")


def _inputs(
    one: LoadedSpec,
    stage: Stage,
    opened: Inputs | None,
    check_image: Images,
    known: dict[Path, SourceFile] | None,
) -> Iterator[Check]:
    """Check catalog, lock, image and disk."""
    layout = one.layout
    name, again = layout.name, _again("lock", layout.measured)
    try:
        prices = catalogs_for([one], None, known)[0] if opened is None else opened.catalog
        pins = read_pins(layout) if opened is None else opened.pins
        sent = files_sent(one.application, layout) if opened is None else opened.sent
    except FogspecError as problem:
        yield Check(name, "inputs", State.PROBLEM, problem.message, problem.hints)
        return
    yield _catalog(one, name, prices)
    if pins is None:
        yield Check(name, "lock", State.NOT_CHECKED, "catalog and image tags are not frozen", (again,))
    else:
        yield Check(name, "lock", State.OK, f"{layout.lock} holds")
    exact = pinned(one.application, pins)
    if (image := image_named(exact)) is not None:
        use = image_use(one.application.spec, measures=stage is Stage.BENCH)
        yield _image(name, image, stage, again, partial(check_image, image, use))
    yield _disk(layout, sent)


def _catalog(one: LoadedSpec, name: str, catalog: Catalog) -> Check:
    if (missing := unpriced(one, catalog)) is not None:
        detail, fix, again = missing
        state = State.NOT_CHECKED if one.layout.files.exists(one.layout.plan) else State.PROBLEM  # a plan has its own
        return Check(name, "catalog", state, detail, (fix, f"then: {shell_command('fogspec', *again)}"))
    if (old := age_warning(one, catalog)) is not None:
        return Check(name, "catalog", State.NOT_CHECKED, old, ("prices of today: fogspec compile --catalog skypilot",))
    return Check(name, "catalog", State.OK, catalog.about.source)


def _image(name: str, image: str, stage: Stage, again: str, check: Callable[[], None]) -> Check:
    if not is_pinned(image):  # `apply` refuses it
        state = State.PROBLEM if stage is Stage.APPLY else State.NOT_CHECKED
        return Check(name, "image", state, f"{image} is not pinned: it may become another one", (again,))
    try:
        check()
    except (NotShown, CloudError) as unknown:
        there = shell_command("docker", "manifest", "inspect", image)
        return Check(name, "image", State.NOT_CHECKED, f"pinned; {unknown.message}", (*unknown.hints, there))
    except InvalidInput as wrong:
        upgrade = f"push it, or lock what its tag names now: {again} --upgrade all"
        return Check(name, "image", State.PROBLEM, wrong.message, wrong.hints or (upgrade,))
    return Check(name, "image", State.OK, f"{image} is in its registry, and fits the machines")


def _disk(layout: Layout, sent: Collection[str]) -> Check:
    sizes = 0
    for path in sent:
        with contextlib.suppress(OSError):
            sizes += os.lstat(layout.spec.parent / path).st_size
    needed = SPARE_BYTES + sizes
    free = shutil.disk_usage(layout.root).free
    words = f"{free / 2**30:.1f} GiB free, {needed / 2**30:.1f} GiB are enough"
    if free >= needed:
        return Check(layout.name, "disk", State.OK, words)
    return Check(layout.name, "disk", State.PROBLEM, words, ("make room: a full disk ends a bench",))


def _host(layout: Layout, machine: Machine, results: Results | None) -> Check:
    """Check that a shape fits on this host, and that this is such a host as was measured."""
    cpus, memory_gib = host.capacity()
    words = f"this host has {cpus} CPU{'s' * (cpus > 1)} and {units.shown(memory_gib)} GiB"
    if machine.cpus > cpus or machine.memory > memory_gib:
        needed = f"{machine.instance} does not fit: {words}"
        return Check(layout.name, "host", State.PROBLEM, needed, ("apply on a larger host",))
    known = machine_facts.read()
    servers = [one.server for one in (results.spec.samples if results else ()) if one.server is not None]
    if other := sorted(
        {one.cpu for one in servers if (one.cpu, one.threads) != (known.get("cpu"), known.get("threads"))}
    ):
        measured = f"measured on another host ({', '.join(other)}): latency may differ on this one"
        return Check(layout.name, "host", State.NOT_CHECKED, measured, (f"{_again('bench', layout)} --all",))
    return Check(layout.name, "host", State.OK, words)


def _left_over(layout: Layout, stage: Stage, times: WallClock) -> Iterator[Check]:
    """Check the records of machines; whether they still run, only their engine can tell."""
    name, down = layout.name, f"{shell_command('fogspec', 'down', layout.name)} finds what runs, and ends it"
    wrong = list[Check]()
    if layout.files.is_file(layout.journal):
        again = f"{_again('bench', layout.measured)} continues and takes it down, unless one runs now"
        wrong += [
            Check(name, "left over", State.PROBLEM, f"{one} was measuring and is not verified gone", (again, down))
            for one in JournalState.read(layout.files.head(layout.journal, MOST_BYTES)).open
        ]
    serving = 0
    try:
        live = DeploymentState.read(layout, times)
    except DiagnosticError as damaged:
        live, place = None, damaged.diagnostics[0].span.path
        wrong.append(Check(name, "left over", State.PROBLEM, f"{place}: {damaged.diagnostics[0].message}", (down,)))
    if live is not None:
        serving = sum(one.state == "serving" for one in live.machines)
        wrong += [
            Check(name, "left over", State.PROBLEM, f"{one.name} was left {one.state}", (down,))
            for one in live.machines
            if one.state != "serving" and stage is Stage.BENCH  # `apply` resumes or ends it
        ]
        wrong += [
            Check(name, "left over", State.PROBLEM, f"{layout.live}: {one.name} is a machine of another application")
            for one in live.foreign
        ]
    yield from wrong
    if not wrong:
        fine = "fogspec status says what runs" if serving else "no machine is on record"
        yield Check(name, "left over", State.OK, f"{serving} serving: {fine}" if serving else fine)


def _skypilot(places: Sequence[str], backend_for: Backends) -> Iterator[Check]:
    """Check SkyPilot, its tools and its access to the clouds of these places, which may take a while."""
    client = Client()
    version = _tried(None, "SkyPilot", "", lambda: client.version)
    if version.state is State.PROBLEM:
        yield version
        yield Check(None, "access", State.NOT_CHECKED, "SkyPilot checks it, once it is installed")
    else:
        yield _version(client.version)
        yield _access(places, backend_for)
    for tool in TOOLS:
        yield _tool(tool)
    for place in places:
        yield from _quota(place)


def _access(places: Sequence[str], backend_for: Backends) -> Check:
    clouds = ", ".join(sorted({cloud_of(place).name for place in places}))
    try:
        with contextlib.closing(backend_for(places[0])) as backend:
            backend.check_access(places, briefly=True)
    except NoAnswer as lost:
        return Check(None, "access", State.NOT_CHECKED, lost.message, lost.hints)
    except FogspecError as problem:
        return Check(None, "access", State.PROBLEM, problem.message, problem.hints)
    return Check(None, "access", State.OK, f"SkyPilot has access to {clouds}")


def _version(version: str) -> Check:
    supported = supported_versions()
    if version in supported:
        return Check(None, "SkyPilot", State.OK, version)
    words = f"{version} is installed, fogspec is made for {supported}"
    return Check(None, "SkyPilot", State.PROBLEM, words, ("pip install 'fogspec[sky]'",))


def _tool(tool: str) -> Check:
    try:
        return Check(None, tool, State.OK, child.program(tool))
    except FileNotFoundError:
        words = "is not on PATH: SkyPilot reaches machines by it, from where its API server runs"
        return Check(None, tool, State.PROBLEM, words, (f"install {tool}",))


def _quota(place: str) -> Iterator[Check]:
    if (asked := quota_command(place)) is not None:
        yield Check(None, "quota", State.NOT_CHECKED, f"of the account in {place}", (asked,))
