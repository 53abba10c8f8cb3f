"""The live state on disk: one file that is written whole before each step, and a directory per machine."""

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from fogspec.backends.naming import ForeignMachine, Owner
from fogspec.backends.protocol import Job
from fogspec.backends.registry import owner_of
from fogspec.base.clock import SystemClock
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.git import tracked_state
from fogspec.base.layout import Layout
from fogspec.base.text import shell_command
from fogspec.deploy.schema import DeployedMachine, DeploymentBody, LiveState
from fogspec.plan.schema import PlanMetadata
from fogspec.spec.loader import read_document

SENT = "sent"  # in a machine's directory: the snapshot of the files that it was sent


class WallClock(Protocol):
    """A monotonic clock, and the date."""

    def now_s(self) -> float:
        """Return seconds since some moment of this boot."""
        ...

    def boot(self) -> str:
        """Return the name of this boot."""
        ...

    def date(self) -> datetime:
        """Return the date in UTC; it may jump."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait."""
        ...


class SystemWallClock(SystemClock):
    """The host's clocks."""

    def date(self) -> datetime:
        """Return the date in UTC."""
        return datetime.now(UTC)


@dataclass(slots=True)
class DeploymentState:
    """The machines of one application, as on disk: every change is written before it takes effect.

    `foreign` are records of machines that are not this application's: they are kept as they are, and nothing acts on them.
    `unreadable` tells that there is a file that cannot be read.
    """

    layout: Layout
    times: WallClock
    machines: list[DeployedMachine]
    spent_usd: float = 0.0
    foreign: list[DeployedMachine] = field(default_factory=list)
    unreadable: bool = False
    _owner: Owner | None = None

    def __post_init__(self) -> None:
        """Divide the machines into those of the application and others."""
        self.foreign += [one for one in self.machines if not self.owner.has(one.name)]
        self.machines = [one for one in self.machines if self.owner.has(one.name)]

    @classmethod
    def read(cls, layout: Layout, times: WallClock) -> "DeploymentState":
        """Return the state in the file, empty if there is none; raise DiagnosticError if it was damaged."""
        if not layout.files.exists(layout.live):
            return cls(layout, times, [])
        try:
            body = read_document(layout.live, LiveState, layout.files).spec
        except DiagnosticError as wrong:
            fix = f"fogspec down {layout.name} finds what runs by its name and ends it"
            raise DiagnosticError([dataclasses.replace(one, fix=fix) for one in wrong.diagnostics]) from None
        return cls(layout, times, list(body.machines), body.spent)

    @classmethod
    def look(cls, layout: Layout, times: WallClock) -> "DeploymentState":
        """Return the same for a verb that only reads: state that came with the checkout is ignored, see `tracked_note`."""
        return cls.read(layout, times) if tracked_state(layout) is None else cls(layout, times, [])

    @property
    def owner(self) -> Owner:
        """The owner of the application's machines."""
        if self._owner is None:
            self._owner = owner_of(self.layout)
        return self._owner

    def check_owned(self) -> None:
        """Raise ForeignMachine if there are records of machines that are not this application's."""
        if self.foreign:
            raise ForeignMachine([one.name for one in self.foreign], self.owner, str(self.layout.live))

    def put(self, machine: DeployedMachine, *, ends: bool = False) -> None:
        """Add the machine, or change its record; with `ends` mark all others for stopping, in the same write."""
        others = [one for one in self.machines if one.name != machine.name]
        if ends:
            others = [one.model_copy(update={"state": "ending"}) for one in others]
        self._write([*others, machine])

    def gone(self, name: str) -> None:
        """Add the cost of a machine that is verified gone, and remove its record and directory."""
        spent = sum(self.spent(one) for one in self.machines if one.name == name)
        self._write([one for one in self.machines if one.name != name], self.spent_usd + spent)
        with contextlib.suppress(OSError):
            self.layout.files.remove_tree(self.folder(name))

    def set_aside(self) -> Path | None:
        """Rename a file that cannot be read, and return its new path; None if there is no such."""
        if not self.unreadable:
            return None
        files, number = self.layout.files, 1
        while files.exists(path := self.layout.state / f"{self.layout.live.name}.unreadable-{number}"):
            number += 1
        files.move(self.layout.live, path)
        return path

    def clear(self) -> Iterator[Path]:
        """Remove the file and what is left next to it, once no machine is left, and yield each; raise OSError if that fails.

        Of `deployed`, only what belongs to machines of the application goes: other things there belong to others.
        """
        if self.machines or self.foreign:
            raise ValueError("machines are left")
        # A process that was killed in the middle of a write leaves a part.
        layout, files = self.layout, self.layout.files
        parts = [name for name in files.names(layout.state) if name.startswith(f".{layout.live.name}.")]
        ours = (layout.live, layout.last_words, *(layout.state / name for name in parts))
        yield from (path for path in ours if files.remove(path))
        folders = [self.folder(name) for name in files.names(layout.deployed) if self.owner.has(name)]
        yield from (path for path in folders if files.remove_tree(path))
        files.remove_folder(layout.deployed)

    def spent(self, machine: DeployedMachine) -> float:
        """Return the cost of the machine so far, in USD, at the price it was started for."""
        return machine.machine.price * self.up_s(machine) / 3600

    def up_s(self, machine: DeployedMachine) -> float:
        """Return the seconds since its start."""
        return machine.up_s(self.times.now_s(), self.times.boot(), self.times.date())

    def total_usd(self) -> float:
        """Return the cost so far, in USD, machines that are gone included."""
        return self.spent_usd + sum(map(self.spent, self.machines))

    def folder(self, name: str) -> Path:
        """Return the directory of one machine."""
        return self.layout.deployed / name

    def job(
        self, machine: DeployedMachine, task: Mapping[str, Any] | None = None, cap_usd_per_hour: float | None = None
    ) -> Job:
        """Return the machine's job; only starting it needs the task, and the most that it may cost."""
        root, directory = self.layout.root, self.folder(machine.name)
        tree = directory / SENT
        return Job(
            name=machine.name,
            owner=self.owner,
            task=task or {},
            root=root,
            directory=directory,
            tree=tree if self.layout.files.is_folder(tree) else None,
            machine=machine.machine,
            cap_usd_per_hour=cap_usd_per_hour,
        )

    def keep_manifest(self, name: str, content: bytes) -> None:
        """Keep the manifest that a machine is started for, for later comparisons."""
        self.layout.files.write(self.folder(name) / "manifest.yaml", content)

    def _write(self, machines: list[DeployedMachine], spent_usd: float | None = None) -> None:
        spent = round(self.spent_usd if spent_usd is None else spent_usd, 6)
        state = LiveState(
            metadata=PlanMetadata(name=self.layout.name),
            spec=DeploymentBody(machines=[*self.foreign, *machines], spent=spent),
        )
        apply = shell_command("fogspec", "apply", self.layout.relative(self.layout.manifest))
        self.layout.files.write_yaml(
            self.layout.live,
            state.model_dump(mode="json"),
            f"fogspec down {self.layout.name}; {apply}",
        )
        self.machines, self.spent_usd = machines, spent
