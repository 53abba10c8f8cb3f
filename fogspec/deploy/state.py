"""The live state: one record that is written whole before each step, and a directory per machine.

The record is a file of this clone, or where clones share it what `fogspec.deploy.shared_state` holds.
"""

import contextlib
import dataclasses
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, Protocol

from fogspec.backends.naming import FALLBACK_LABEL, MANIFEST_LABEL, RUNS_LABEL, ForeignMachine, Owner
from fogspec.backends.protocol import Job, Work
from fogspec.backends.registry import owner_of
from fogspec.base import digest
from fogspec.base.clock import SystemClock
from fogspec.base.clouds import LOCAL
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import CloudError, FogspecError
from fogspec.base.git import check_untracked
from fogspec.base.layout import Layout
from fogspec.base.project_files import ProjectFiles
from fogspec.base.repository import actor_of, head_of
from fogspec.base.text import line, shell_command
from fogspec.base.yaml.reader import MOST_BYTES_OF_CANONICAL
from fogspec.deploy.schema import Act, Applied, DeployedMachine, DeploymentBody, LiveState, Place, SharedState, date_of
from fogspec.deploy.shared_state import SharedRecord, key_of, look, store_of
from fogspec.language.loader import read_document
from fogspec.plan.schema import EnvironmentMetadata

MANIFEST = "manifest.yaml"  # in a machine's directory: what it was started for
MOST_ACTS = 50  # of the history, the latest
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
    `unreadable` tells that there is a file that cannot be read. Where clones share the state, `record` holds it for a command
    that changes it, and `manifests` are the texts of the machines' manifests in it; `where` is the record's place for people.
    `verb` is what the history is to name.
    """

    layout: Layout
    times: WallClock
    machines: list[DeployedMachine]
    spent_usd: float = 0.0
    history: list[Act] = field(default_factory=list)
    verb: str = ""
    foreign: list[DeployedMachine] = field(default_factory=list)
    unreadable: bool = False
    record: SharedRecord | None = None
    manifests: dict[str, str] | None = None
    where: str = ""
    _owner: Owner | None = None

    def __post_init__(self) -> None:
        """Divide the machines into those of the application and others."""
        self.where = self.where or str(self.layout.live)
        self.foreign += [one for one in self.machines if not self.owner.has(one.name)]
        self.machines = [one for one in self.machines if self.owner.has(one.name)]

    @classmethod
    def read(
        cls, layout: Layout, times: WallClock, record: SharedRecord | None = None, owner: Owner | None = None
    ) -> "DeploymentState":
        """Return the state, empty if there is none; raise DiagnosticError if it was damaged.

        `owner` is another one than the application of this repository. Where clones share the state, a command that changes it
        holds the `record`. Raise StoreUnavailable, and Refused for a record of another repository.
        """
        if record is not None:
            return cls._shared(layout, times, record.state, record.path, record)
        if (store := store_of(layout)) is not None:
            try:
                return cls._shared(layout, times, look(store, layout), store.path(key_of(owner_of(layout))))
            except DiagnosticError as wrong:
                raise _ended_by_name(wrong, layout) from None
        if not layout.files.exists(layout.live):
            return cls(layout, times, [], _owner=owner)
        try:
            body = read_document(layout.live, LiveState, layout.files).spec
        except DiagnosticError as wrong:
            raise _ended_by_name(wrong, layout) from None
        return cls(layout, times, list(body.machines), body.spent, list(body.history), _owner=owner)

    @classmethod
    def _shared(
        cls, layout: Layout, times: WallClock, state: SharedState | None, where: str, record: SharedRecord | None = None
    ) -> "DeploymentState":
        owner = None if record is None else record.owner
        body = DeploymentBody(machines=[]) if state is None else state.spec
        manifests = {} if state is None else dict(state.spec.manifests)
        return cls(
            layout,
            times,
            list(body.machines),
            body.spent,
            list(body.history),
            record=record,
            manifests=manifests,
            where=where,
            _owner=owner,
        )

    @classmethod
    def look(cls, layout: Layout, times: WallClock) -> "DeploymentState":
        """Return the same for a verb that only reads; raise Refused for state that git tracks."""
        check_untracked(
            layout, f"{shell_command('fogspec', 'down', layout.name)} ends what runs of it here, found by name"
        )
        return cls.read(layout, times)

    @property
    def owner(self) -> Owner:
        """The owner of the application's machines."""
        if self._owner is None:
            self._owner = owner_of(self.layout)
        return self._owner

    def check_owned(self) -> None:
        """Raise ForeignMachine if there are records of machines that are not this application's."""
        if self.foreign:
            raise ForeignMachine([one.name for one in self.foreign], self.owner, self.where)

    def put(self, machine: DeployedMachine, *, ends: bool = False) -> None:
        """Add the machine, or change its record; with `ends` mark all others for stopping, in the same write."""
        others = [one for one in self.machines if one.name != machine.name]
        before = next((one for one in self.machines if one.name == machine.name), None)
        acts = list[Act]()
        if before is None or before.manifest != machine.manifest:
            acts = [self._act("started" if machine.state == "starting" else "kept", machine, machine.applied)]
        if ends:
            others = [one.model_copy(update={"state": "ending"}) for one in others]
        self._write([*others, machine], acts=acts)

    def gone(self, name: str) -> None:
        """Add the cost of a machine that is verified gone, and remove its record and directory."""
        ended = [one for one in self.machines if one.name == name]
        rest, spent = [one for one in self.machines if one.name != name], self.spent_usd + sum(map(self.spent, ended))
        self._write(rest, spent, [self._act("ended", one, spent=self.spent(one)) for one in ended])
        folders = [self.folder(name), *(self._place(one)[1] for one in ended if one.place is not None)]
        for folder in folders:
            with contextlib.suppress(OSError, FogspecError):
                ProjectFiles(folder.parents[3]).remove_tree(folder)

    def gone_by_name(self, name: str) -> None:
        """Record the end of a machine that no record here has; beside one that cannot be read, once that is set aside."""
        act = Act(verb=self.verb, did="ended", by=self.applied(head_of(self.layout.root), 0), name=name)
        if self.unreadable:
            self.history = [*self.history, act][-MOST_ACTS:]
        else:
            self._write(self.machines, acts=[act])

    def applied(self, commit: str | None, generation: int | None = None) -> Applied:
        """Return the record of a command on a commit from this checkout, by the user of CI or of git, now.

        It is the next generation unless another is given.
        """
        last = [one.applied.generation for one in self.machines if one.applied]
        last += [one.by.generation for one in self.history]
        actor = actor_of(self.layout.root)
        return Applied(
            generation=1 + max(last, default=0) if generation is None else generation,
            commit=commit,
            actor=actor and line(actor)[:100],
            date=date_of(self.times.date().timestamp()),
        )

    def _act(
        self,
        did: Literal["started", "kept", "ended"],
        machine: DeployedMachine,
        by: Applied | None = None,
        spent: float | None = None,
    ) -> Act:
        now = self.applied(head_of(self.layout.root), machine.applied.generation if machine.applied else 0)
        return Act(
            verb=self.verb,
            did=did,
            by=now if by is None else by.model_copy(update={"date": now.date}),
            name=machine.name,
            machine=f"{machine.machine.infra}/{machine.machine.instance}",
            manifest=machine.manifest,
            price=machine.machine.price,
            spent=None if spent is None else round(spent, 6),
        )

    def set_aside(self) -> Path | None:
        """Keep a file that cannot be read under another name, and return that; None if there is no such.

        A file stays in its place too, until another one is written over it.
        """
        if not self.unreadable:
            return None
        damaged = None if self.record is None else self.record.damaged
        files, number = self.layout.files, 1
        while files.exists(path := self.layout.state / f"{self.layout.live.name}.unreadable-{number}"):
            number += 1
        if damaged is None:
            files.set_aside(self.layout.live, path)
        else:
            files.write(path, damaged)
        return path

    def clear(self) -> Iterator[str]:
        """Remove what is left next to the file, once no machine is left, and the file if it has no history; yield each.

        Raise OSError if that fails.
        Of `deployed`, only what belongs to machines of the application goes: other things there belong to others.
        """
        if self.machines or self.foreign:
            raise ValueError("machines are left")
        if self.history:
            self._write([], 0.0)
        elif self.record is not None and self.record.clear():
            yield self.where
        # A process that was killed in the middle of a write leaves a part.
        layout, files = self.layout, self.layout.files
        parts = [name for name in files.names(layout.state) if name.startswith(f".{layout.live.name}.")]
        ours = [layout.last_words, *(layout.state / name for name in parts)]
        if not self.history or self.record is not None:
            ours.append(layout.live)
        yield from (str(path) for path in ours if files.remove(path))
        folders = [self.folder(name) for name in files.names(layout.deployed) if self.owner.has(name)]
        yield from (str(path) for path in folders if files.remove_tree(path))
        files.remove_folder(layout.deployed)

    def spent(self, machine: DeployedMachine) -> float:
        """Return the cost of the machine so far, in USD, at the price it was started for, disk and address included."""
        return machine.machine.usd(self.up_s(machine))

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
        self,
        machine: DeployedMachine,
        work: Work | None = None,
        task: Mapping[str, Any] | None = None,
        cap_usd_per_hour: float | None = None,
        lifetime_s: float | None = None,
    ) -> Job:
        """Return the machine's job; only starting it needs the work and task, its highest cost and longest time."""
        root, directory = self._place(machine)
        tree = directory / SENT
        return Job(
            name=machine.name,
            owner=self.owner,
            work=work,
            task=task or {},
            root=root,
            directory=directory,
            tree=tree if ProjectFiles(root).is_folder(tree) else None,
            machine=machine.machine,
            lifetime_s=lifetime_s,
            cap_usd_per_hour=cap_usd_per_hour,
            labels=labels_of(machine),
        )

    def place(self, deployer: str) -> Place | None:
        """Return where a machine of this deployer is recorded to run: clones share what runs on this computer, too."""
        if self.record is None or deployer != LOCAL:
            return None
        return Place(host=os.uname().nodename, root=os.path.realpath(self.layout.root))

    def _place(self, machine: DeployedMachine) -> tuple[Path, Path]:
        """Return the root and the directory of a machine's job; raise CloudError for one on another computer."""
        if machine.place is None or machine.place.root == os.path.realpath(self.layout.root):
            root = self.layout.root
        elif machine.place.host != os.uname().nodename:
            raise CloudError(f"{machine.name} runs on the computer {machine.place.host}", "run this command there")
        else:
            root = Path(machine.place.root)
        return root, dataclasses.replace(self.layout, root=root).deployed / machine.name

    def keep_manifest(self, name: str, content: bytes) -> None:
        """Keep the manifest that a machine is started for, for later comparisons."""
        if self.manifests is None:
            self.layout.files.write(self.folder(name) / MANIFEST, content)
            return
        self.manifests[name] = content.decode("utf-8", "surrogateescape")
        self._write(self.machines)

    def manifest_of(self, name: str) -> bytes | None:
        """Return the manifest that a machine was started for; None if it was not started yet, or it is lost.

        The nodes on this host can write where it is kept: what no manifest can be is not read.
        """
        if self.manifests is not None:
            text = self.manifests.get(name)
            return None if text is None else text.encode("utf-8", "surrogateescape")
        path = self.folder(name) / MANIFEST
        if not self.layout.files.is_file(path):
            return None
        content = self.layout.files.head(path, MOST_BYTES_OF_CANONICAL + 1)
        return content if len(content) <= MOST_BYTES_OF_CANONICAL else None

    def _write(self, machines: list[DeployedMachine], spent_usd: float | None = None, acts: Sequence[Act] = ()) -> None:
        spent = round(self.spent_usd if spent_usd is None else spent_usd, 6)
        history = [*self.history, *acts][-MOST_ACTS:]
        body = DeploymentBody(machines=[*self.foreign, *machines], spent=spent, history=history)
        if self.record is not None:
            self.record.save(body, self.manifests or {})
        else:
            self._save(body)
        self.machines, self.spent_usd, self.history = machines, spent, history

    def _save(self, body: DeploymentBody) -> None:
        state = LiveState(metadata=EnvironmentMetadata(name=self.layout.name), spec=body)
        apply = shell_command("fogspec", "apply", self.layout.relative(self.layout.manifest))
        self.layout.files.write_yaml(
            self.layout.live,
            state.model_dump(mode="json"),
            f"fogspec down {self.layout.name}; {apply}",
        )


def labels_of(machine: DeployedMachine) -> dict[str, str]:
    """Return the labels that a machine is started with: what it was started for, and all that it was given."""
    found = {MANIFEST_LABEL: digest.as_label(machine.manifest), RUNS_LABEL: digest.as_label(machine.runs)}
    return {name: text for name, text in found.items() if text is not None} | {FALLBACK_LABEL: str(machine.fallback)}


def _ended_by_name(wrong: DiagnosticError, layout: Layout) -> DiagnosticError:
    fix = f"fogspec down {layout.name} finds what runs by its name and ends it, fogspec apply {layout.name} --adopt keeps it"
    return DiagnosticError([dataclasses.replace(one, fix=fix) for one in wrong.diagnostics])
