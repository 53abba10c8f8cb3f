"""The applications of a project that have live state, and what their nodes print."""

import re
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path

from fogspec.backends.agent_state import printed
from fogspec.backends.protocol import DeploymentBackend, LaunchRefused, Unreachable
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import CloudError, FogspecError, InvalidInput, Refused
from fogspec.base.layout import MOST_BYTES, Layout
from fogspec.base.text import shell_command
from fogspec.compile.tasks import label
from fogspec.deploy.schema import DeployedMachine
from fogspec.deploy.shared_state import shared_layouts, store_of
from fogspec.deploy.state import DeploymentState, WallClock
from fogspec.language.loader import load

FOLLOW_EVERY_S = 1.0
MARK = re.compile(r"\[([^\[\]]+)\] ")
LEVELS = ("DEBUG", "INFO", "WARN", "WARNING", "ERROR", "FATAL", "CRITICAL")

Backends = Callable[[str], DeploymentBackend]


def layouts(root: Path) -> list[Layout]:
    """Return the layout of each application below a root with live state; raise StoreUnavailable, and as `store_of` does."""
    any_one = Layout.named(root, "any")
    if (store := store_of(any_one)) is not None:
        return shared_layouts(store, root)
    found = [Layout.named(root, name) for name in any_one.files.names(root / ".fogspec")]
    return [one for one in found if any_one.files.is_file(one.live)]


def without_spec(root: Path, names: Collection[str], times: WallClock) -> list[str]:
    """Return a sentence for each application below a root that runs and has no spec, by its live state alone.

    Raise StoreUnavailable.
    """
    found = []
    for layout in (one for one in layouts(root) if one.name not in names):
        try:
            live = DeploymentState.look(layout, times)
        except (DiagnosticError, Refused):
            found.append(f"{layout.name}: no spec has an application of this name, and {layout.live} cannot be read")
            continue
        if live.machines:
            machines = ", ".join(one.name for one in live.machines)
            found.append(f"{layout.name}: no spec has an application of this name, and {machines} runs")
    return [f"{text}; {shell_command('fogspec', 'down', text.partition(':')[0])} ends it" for text in found]


def _answers(live: DeploymentState, machine: DeployedMachine, backend_for: Backends) -> str:
    try:
        return backend_for(machine.machine.infra).poll(live.job(machine)).state
    except (Unreachable, LaunchRefused, CloudError):
        return "no contact"


def log_lines(layout: Layout, times: WallClock, backend_for: Backends) -> tuple[DeployedMachine | None, list[str]]:
    """Return the lines that the newest machine of an application printed, or the last words of one that never answered.

    Raise InvalidInput if nothing runs and nothing is kept, CloudError for a machine that cannot be asked now, DiagnosticError
    for damaged live state.
    """
    live = DeploymentState.look(layout, times)
    live.check_owned()
    if not live.machines:
        if not layout.files.is_file(layout.last_words):
            apply = shell_command("fogspec", "apply", layout.manifest)
            raise InvalidInput(f"{layout.name}: nothing runs, and no start that failed is on record", apply)
        return None, printed(layout.files.head(layout.last_words, MOST_BYTES))
    machine = live.machines[-1]
    try:
        return machine, printed(backend_for(machine.machine.infra).read_log(live.job(machine)))
    except Unreachable as lost:
        raise CloudError(f"{machine.name}: no contact just now: {lost}", "safe to run again") from None


def followed(layout: Layout, times: WallClock, backend_for: Backends) -> Iterator[list[str]]:
    """Yield the lines so far and then each time those that are new, until no machine is left or its nodes have ended."""
    before: list[str] = []
    while True:
        machine, lines = log_lines(layout, times, backend_for)
        yield lines[_common(before, lines) :]
        if machine is None:
            return
        before, live = lines, DeploymentState.look(layout, times)
        if _answers(live, machine, backend_for) in ("ended", "gone"):
            return
        times.sleep(max(FOLLOW_EVERY_S, backend_for(machine.machine.infra).poll_s))


def names_of_nodes(layout: Layout) -> list[str]:
    """Return the names of an application's cloud nodes as its logs have them, by its spec; none without a valid one."""
    try:
        found = [one for one in load([layout.spec]) if one.name == layout.name.partition("@")[0]]
    except (DiagnosticError, FogspecError, OSError):
        return []
    return list(dict.fromkeys(label(node) for one in found for node in one.application.spec.cloud))


def names_in(lines: Sequence[str]) -> list[str]:
    """Return the names that stand in front of lines, in the order of their first."""
    found = (MARK.match(line) for line in lines)
    return list(dict.fromkeys(one[1] for one in found if one is not None and one[1] not in LEVELS))


def of_node(lines: Sequence[str], node: str) -> list[str]:
    """Return the lines that a node printed, and launch's own about it; a script is named with or without its interpreter."""
    name = rf"(?:\S+ )?{re.escape(node)}(?:[ -]\d+)?"
    wanted = re.compile(rf"\[{name}\] |\[(?:{'|'.join(LEVELS)})\] \[{name}\]: ")
    return [line for line in lines if wanted.match(line)]


def _common(before: Sequence[str], now: Sequence[str]) -> int:
    """Return how many of the first lines now are the last ones of before."""
    return next((size for size in range(min(len(before), len(now)), 0, -1) if before[-size:] == now[:size]), 0)
