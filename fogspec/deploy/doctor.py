"""What is wrong on this side before a bench or an apply: the checks that they make themselves, and what they would meet later.

Nothing is started or written. What only the provider can tell is `NOT_CHECKED`, with the provider's own command.
"""

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial

from fogspec.backends.images.registry import NotShown
from fogspec.backends.protocol import DeploymentBackend
from fogspec.backends.skypilot.client import Client, supported_versions
from fogspec.base import child
from fogspec.base.clouds import cloud_of, quota_command
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import CloudError, FogspecError, InvalidInput
from fogspec.base.git import check_untracked, tracked_state
from fogspec.base.layout import Layout
from fogspec.base.redaction import check_set
from fogspec.base.text import shell_command
from fogspec.bench.journal import JournalState
from fogspec.catalog.table import Catalog
from fogspec.compile.inputs import Inputs, age_warning, unpriced
from fogspec.compile.links import link_of
from fogspec.compile.tasks import login_of_machines
from fogspec.deploy import link
from fogspec.deploy.engines import engines_of
from fogspec.deploy.state import DeploymentState, WallClock
from fogspec.spec.loader import LoadedSpec
from fogspec.spec.lock_io import check_sent
from fogspec.spec.lockfile import image_named, is_pinned, listed, pinned
from fogspec.spec.rules.benchmark import PLACEHOLDERS

SHOWN = 6  # names of a list
SPARE_BYTES = 256 << 20  # for results, logs and state, besides the copy of the files that are sent
TOOLS = ("ssh", "rsync")  # by which SkyPilot's API server reaches machines

Backends = Callable[[str], DeploymentBackend]
Images = Callable[[str, Sequence[str], Sequence[str]], None]


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
    loaded: Sequence[LoadedSpec], catalog: str | None, times: WallClock, backend_for: Backends, check_image: Images
) -> list[Check]:
    """Return the checks of these applications, then those of this computer.

    `check_image` is `Registry.check`. SkyPilot is requested its access only if a place of theirs is a cloud.
    Raise DiagnosticError for a damaged lock.
    """
    found = [check for one in loaded for check in _application(one, catalog, times, check_image)]
    places = sorted({place for one in loaded for place in one.application.spec.infra if cloud_of(place).on_skypilot})
    return [*found, *(_skypilot(places, backend_for) if places else ())]


def as_dict(check: Check) -> dict[str, object]:
    """Return the check as JSON has it."""
    return {
        "application": check.application,
        "what": check.what,
        "state": str(check.state),
        "detail": check.detail,
        "fixes": list(check.fixes),
    }


def as_text(found: Sequence[Check]) -> list[str]:
    """Return the lines, under the name of each application."""
    lines, heading = list[str](), ""
    for one in found:
        if (title := one.application or "this computer") != heading:
            heading = title
            lines.append(title)
        lines.append(f"  {one.state:<11}  {one.what:<9}  {one.detail}")
        lines += [f"{'':26}{fix}" for fix in one.fixes]
    return lines


def _application(one: LoadedSpec, catalog: str | None, times: WallClock, check_image: Images) -> Iterator[Check]:
    application, layout = one.application, one.layout
    name = layout.name

    def tried(what: str, fine: str, check: Callable[[], object]) -> Check:
        return _tried(name, what, fine, check)

    yield from _files(one, layout)
    if application.spec.secrets:
        yield tried("secrets", "all are in the environment", lambda: check_set(application.spec.secrets))
    yield from _inputs(one, layout, catalog, check_image)
    if link_of(application).protocol is not None:
        yield tried("link", "the robot's public half is here", lambda: link.environment(application, layout))
    yield tried("state", "not in git", lambda: check_untracked(layout))
    if tracked_state(layout) is None:
        yield from _left_over(layout, times)


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


def _files(one: LoadedSpec, layout: Layout) -> Iterator[Check]:
    """Check that what the spec names is there, is the user's own, and is sent."""
    invented = [warning for warning in one.warnings if warning.code == PLACEHOLDERS]
    wrong = [*invented, *one.absent()]
    for error in wrong:
        fixes = (error.fix,) if error.fix else ()
        yield Check(layout.name, "files", State.PROBLEM, f"{layout.spec}: {error.code} {error.message}", fixes)
    if not wrong:
        sent = "all that the spec names are there"
        yield _tried(layout.name, "files", sent, lambda: check_sent(one.application, layout, measured=True))


def _inputs(one: LoadedSpec, layout: Layout, catalog: str | None, check_image: Images) -> Iterator[Check]:
    """Check catalog, lock, image and disk."""
    name, again = layout.name, shell_command("fogspec", "lock", layout.spec)
    try:
        inputs = Inputs.load([], loaded=[one], catalog=catalog, audit=True)[0]
    except FogspecError as problem:
        yield Check(name, "inputs", State.PROBLEM, problem.message, problem.hints)
        return
    yield _catalog(one, name, inputs.catalog)
    if inputs.pins is None:
        yield Check(name, "lock", State.NOT_CHECKED, "nothing is locked, so a change is not noticed", (again,))
    elif inputs.drifted:
        changed = "; ".join(listed(inputs.drifted, "{} is not what the lock says", SHOWN))
        yield Check(name, "lock", State.PROBLEM, changed, (f"if the change is meant: {again}",))
    else:
        yield Check(name, "lock", State.OK, f"{layout.lock} holds")
    exact = pinned(one.application, inputs.pins)
    if (image := image_named(exact)) is not None:
        spec = one.application.spec
        yield _image(name, image, again, partial(check_image, image, spec.hardware.arch, login_of_machines(spec)))
    yield _disk(inputs)


def _catalog(one: LoadedSpec, name: str, catalog: Catalog) -> Check:
    if (missing := unpriced(one, catalog)) is not None:
        detail, fix, again = missing
        return Check(name, "catalog", State.PROBLEM, detail, (fix, f"then: {shell_command('fogspec', *again)}"))
    if (old := age_warning(one, catalog)) is not None:
        return Check(name, "catalog", State.PROBLEM, old, ("prices of today: --catalog skypilot",))
    return Check(name, "catalog", State.OK, catalog.about.source)


def _image(name: str, image: str, again: str, check: Callable[[], None]) -> Check:
    if not is_pinned(image):
        return Check(name, "image", State.PROBLEM, f"{image} is not pinned: it may become another one", (again,))
    try:
        check()
    except (NotShown, CloudError) as unknown:
        there = shell_command("docker", "manifest", "inspect", image)
        return Check(name, "image", State.NOT_CHECKED, f"pinned; {unknown.message}", (*unknown.hints, there))
    except InvalidInput as wrong:
        upgrade = f"push it, or lock what its tag names now: {again} --upgrade all"
        return Check(name, "image", State.PROBLEM, wrong.message, wrong.hints or (upgrade,))
    return Check(name, "image", State.OK, f"{image} is in its registry, for the CPUs of spec.hardware.arch")


def _disk(inputs: Inputs) -> Check:
    layout = inputs.layout
    sizes = (layout.files.stat(layout.spec.parent / path) for path in inputs.sent)
    needed = SPARE_BYTES + sum(size.st_size for size in sizes if size is not None)
    free = shutil.disk_usage(layout.root).free
    words = f"{free / 2**30:.1f} GiB free, {needed / 2**30:.1f} GiB are enough"
    if free >= needed:
        return Check(layout.name, "disk", State.OK, words)
    return Check(layout.name, "disk", State.PROBLEM, words, ("make room: a full disk ends a bench",))


def _left_over(layout: Layout, times: WallClock) -> Iterator[Check]:
    """Check the records of machines; whether they still run, only their engine can tell."""
    name, down = layout.name, f"{shell_command('fogspec', 'down', layout.name)} finds what runs, and ends it"
    wrong = [
        Check(name, "left over", State.PROBLEM, doubt, (down,))
        for doubt in engines_of(layout).doubts
        if doubt.startswith((str(layout.journal), str(layout.live)))
    ]
    if layout.files.is_file(layout.journal):
        again = f"{shell_command('fogspec', 'bench', layout.spec)} continues and takes it down, unless one runs now"
        wrong += [
            Check(name, "left over", State.PROBLEM, f"{one} was measuring and is not verified gone", (again, down))
            for one in JournalState.read(layout.files.read(layout.journal)).open
        ]
    serving = 0
    try:
        live = DeploymentState.read(layout, times)
    except DiagnosticError:
        live = None  # a doubt above
    if live is not None:
        serving = sum(one.state == "serving" for one in live.machines)
        wrong += [
            Check(name, "left over", State.PROBLEM, f"{one.name} was left {one.state}", (down,))
            for one in live.machines
            if one.state != "serving"
        ]
        wrong += [
            Check(name, "left over", State.PROBLEM, f"{layout.live}: {one.name} is a machine of another application")
            for one in live.foreign
        ]
    yield from wrong
    if not wrong:
        fine = "fogspec ps says what runs" if serving else "no machine is on record"
        yield Check(name, "left over", State.OK, f"{serving} serving: {fine}" if serving else fine)


def _skypilot(places: Sequence[str], backend_for: Backends) -> Iterator[Check]:
    """Check SkyPilot, its tools and its access to the clouds of these places."""
    client = Client()
    version = _tried(None, "SkyPilot", "", lambda: client.version)
    if version.state is State.PROBLEM:
        yield version
        yield Check(None, "access", State.NOT_CHECKED, "SkyPilot tells, once it is installed")
    else:
        yield _version(client.version)
        clouds = ", ".join(sorted({cloud_of(place).name for place in places}))
        access = f"SkyPilot has access to {clouds}"
        yield _tried(None, "access", access, lambda: backend_for(places[0]).check_access(places))
    for tool in TOOLS:
        yield _tool(tool)
    for place in places:
        yield from _quota(place)


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
