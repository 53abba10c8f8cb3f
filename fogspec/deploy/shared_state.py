"""The live state that clones share: one record for each application in a store, held under a lease while a command changes it.

The record has lease and machines together, and every write replaces exactly the version that was read. So a command that
was cut off for so long that another one took over writes nothing more: its next write fails before the next step.
Clocks of several computers are not compared: a lease has ended if it did not change for `LEASE_S` seconds of the observer's
own clock, or if its process was on this computer and is gone.
"""

import contextlib
import os
import secrets
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import timedelta
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from fogspec.backends.naming import IN_NAME, Owner
from fogspec.backends.registry import owner_of
from fogspec.base.clock import SystemClock
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import Busy, FogspecError, InvalidInput, Refused
from fogspec.base.layout import Layout
from fogspec.base.locks import application_lock, start_ticks
from fogspec.base.repository import origin_of
from fogspec.base.text import shell_command
from fogspec.base.yaml.writer import yaml_text
from fogspec.deploy.git_store import GitStore
from fogspec.deploy.schema import DeploymentBody, Lease, Project, SharedBody, SharedState, date_of
from fogspec.deploy.stores import Overtaken, Store, Stored, StoreUnavailable
from fogspec.language.loader import SourceFile, read_document
from fogspec.plan.schema import EnvironmentMetadata

if TYPE_CHECKING:
    from fogspec.deploy.state import WallClock

VARIABLE = "FOGSPEC_STATE"
LEASE_S = 60.0
RENEW_S = 15.0
LOOK_S = 3.0
TRIES = 3
KEPT_S = 5.0  # verbs that only read look once for all applications


def store_of(layout: Layout) -> Store | None:
    """Return the store that the applications of a project share; None if their state is in the folder `.fogspec`.

    `FOGSPEC_STATE` goes before `fogspec.yaml`. Raise DiagnosticError for an invalid file, InvalidInput for an invalid value.
    """
    given = os.environ.get(VARIABLE)
    where, setting = VARIABLE, given or ""
    if not given:
        if not layout.files.exists(layout.project):
            return None
        where, setting = (
            f"{layout.project}: spec.state",
            read_document(layout.project, Project, layout.files).spec.state,
        )
    if setting == "folder":
        return None
    return _store(os.path.abspath(layout.root), setting, where)


@cache
def _store(root: str, setting: str, where: str) -> Store:
    found = origin_of(Path(root))
    if setting.startswith("git+"):
        return GitStore(setting.removeprefix("git+"), found[1] if found else Path(root), Path(root))
    if setting != "git":
        raise InvalidInput(f"{where}: {setting} is not a place for live state", "write folder, git or git+URL")
    if found is None:
        raise InvalidInput(
            f"{where}: git needs a remote named origin, and {root} has none",
            "add one: git remote add origin URL",
            "or keep the state in this clone: FOGSPEC_STATE=folder",
        )
    return GitStore(found[0], found[1], Path(root))


def key_of(owner: Owner) -> str:
    """Return the key of an owner's record."""
    return f"{owner.name}-{owner.digest[:IN_NAME]}"


@dataclass(slots=True)
class Recent:
    """What a store had a moment ago."""

    at_s: float
    records: Mapping[str, Stored]


_recent: dict[Store, Recent] = {}


def look(store: Store, layout: Layout) -> SharedState | None:
    """Return an application's record without a lease, as it was a few seconds ago at most; None if there is none.

    Raise StoreUnavailable, DiagnosticError for a damaged record, Refused for one of another repository.
    """
    owner = owner_of(layout)
    return parsed(_records(store).get(key_of(owner), Stored()), store.path(key_of(owner)), owner)


def shared_layouts(store: Store, root: Path) -> list[Layout]:
    """Return the layouts of the applications below a root that have a record; raise StoreUnavailable."""
    names = [key.rpartition("-")[0] for key in sorted(_records(store))]
    layouts = [Layout.named(root, name) for name in names if name]
    return [one for one in layouts if key_of(owner_of(one)) in _records(store)]


def _records(store: Store) -> Mapping[str, Stored]:
    now_s = SystemClock().now_s()
    known = _recent.get(store)
    if known is None or now_s - known.at_s > KEPT_S:
        known = _recent[store] = Recent(now_s, store.read_all())
    return known.records


def parsed(stored: Stored, path: str, owner: Owner) -> SharedState | None:
    """Return a record, None for none; raise DiagnosticError if it is damaged, Refused if it is of another repository."""
    if stored.version is None:
        return None
    found = SourceFile(path, stored.content).document(SharedState)
    if found.spec.owner != owner.digest:
        raise Refused(
            f"{path} is the state of {found.metadata.name} of {found.spec.repository}, not of {owner}: nothing was touched",
            "find out who wrote it; FOGSPEC_STATE=folder runs a command without it",
        )
    return found


@dataclass(slots=True, kw_only=True)
class SharedRecord:
    """An application's record, held by this process; `owner` is the owner of its machines."""

    store: Store
    layout: Layout
    times: "WallClock"
    what: str
    report: Callable[[str], None]
    state: SharedState | None = None
    damaged: bytes | None = None
    owner: Owner
    holder: str = field(default_factory=lambda: secrets.token_hex(8))
    overtaken: bool = False
    _version: str | None = None
    _lease: Lease | None = None
    _mutex: threading.RLock = field(default_factory=threading.RLock)

    @property
    def path(self) -> str:
        """Where the record is, for people."""
        return self.store.path(key_of(self.owner))

    def take(self, salvage: bool = False) -> None:
        """Take the lease; raise Busy, naming the holder, if another command has it.

        With `salvage` a damaged record is kept as `damaged`, and stays in its place, without a lease, until another one or
        none is written; without, raise DiagnosticError.
        """
        stored, waited_s, told = self.store.read(key_of(self.owner)), 0.0, False
        while True:
            state = self._parsed(stored, salvage)
            lease = None if state is None else state.spec.lease
            gone = lease is None or _has_ended(lease)
            if gone or waited_s >= LEASE_S:
                if lease is not None and not gone:
                    self.report(f"{lease.what} on {lease.host} has not been heard of for {LEASE_S:g} s: taken over")
                self.state, self._version = state, stored.version
                self._lease = Lease(
                    holder=self.holder,
                    what=self.what,
                    host=os.uname().nodename,
                    process=_process(),
                    until=self._until(),
                )
                if self.damaged is not None:
                    return None
                try:
                    return self._write()
                except Overtaken:
                    stored, waited_s = self.store.read(key_of(self.owner)), 0.0
                    continue
            if lease is None or _is_here(lease):
                raise self._held(lease)
            if not told:
                self.report(
                    f"{lease.what} on {lease.host} holds the state until {lease.until}: seeing whether it still runs"
                )
                told = True
            self.times.sleep(LOOK_S)
            waited_s += LOOK_S
            now = self.store.read(key_of(self.owner))
            if now.version != stored.version:
                after = self._parsed(now, salvage)
                if after is not None and after.spec.lease is not None and after.spec.lease.holder == lease.holder:
                    raise self._held(lease)
                stored, waited_s = now, 0.0

    def _held(self, lease: Lease | None) -> Busy:
        who = "another command" if lease is None else f"{lease.what} on {lease.host}"
        return Busy(f"{self.what} must wait: {who} has not ended", "wait for it, or stop it with Ctrl-C there")

    def _parsed(self, stored: Stored, salvage: bool) -> SharedState | None:
        self.damaged = None
        try:
            return parsed(stored, self.path, self.owner)
        except DiagnosticError:
            if not salvage:
                raise
            self.damaged = stored.content
            return None

    def save(self, body: DeploymentBody, manifests: Mapping[str, str]) -> None:
        """Write the machines; raise Busy if another command took over meanwhile, StoreUnavailable if it is not written."""
        with self._mutex:
            before = self.state
            self.state = self._document(body, manifests)
            try:
                self._insist()
            except BaseException:
                self.state = before
                raise

    def renew(self) -> None:
        """Renew the lease; an unreachable store is asked again the next time."""
        with self._mutex:
            if self._lease is None or self.overtaken or self.damaged is not None:
                return
            count = self._lease.renewed + 1
            self._lease = self._lease.model_copy(update={"renewed": count, "until": self._until()})
            try:
                self._write()
            except Overtaken:
                self.overtaken = not self._is_mine()
            except StoreUnavailable:
                pass

    def clear(self) -> bool:
        """Remove the record; return whether there was one."""
        with self._mutex:
            had = self._version is not None
            self._insist(remove=True)
            self.state, self._lease = None, None
            return had

    def give_back(self) -> None:
        """End the lease; a record without machines, cost and history goes."""
        with self._mutex:
            if self._lease is None or self.overtaken or self.damaged is not None:
                return
            self._lease = None
            try:
                body = None if self.state is None else self.state.spec
                self._insist(remove=body is None or not (body.machines or body.spent or body.history))
            except FogspecError as failed:
                self.report(f"{failed.message}: the lease of {self.what} ends by itself after {LEASE_S:g} s")

    def _insist(self, remove: bool = False) -> None:
        """Write, again if it did not arrive; raise Busy if another command took over."""
        for left in reversed(range(TRIES)):
            try:
                return self._write(remove)
            except Overtaken:
                if self.overtaken or not self._is_mine():
                    self.overtaken = True
                    raise self.lost() from None
            except StoreUnavailable:
                if not left:
                    raise
                self.times.sleep(1.0)
        raise self.lost()

    def lost(self) -> Busy:
        """Return the error of a command whose lease another one took over."""
        return Busy(
            f"{self.what}: another command took over its state while this one had no contact: it stops here",
            f"see what runs, then run it again: {shell_command('fogspec', 'status', self.layout.name)}",
        )

    def _is_mine(self) -> bool:
        """Return whether the record is one that this process wrote without hearing of it, and go on from that."""
        with contextlib.suppress(StoreUnavailable, DiagnosticError, Refused):
            now = self.store.read(key_of(self.owner))
            state = parsed(now, self.path, self.owner)
            if state is not None and state.spec.lease is not None and state.spec.lease.holder == self.holder:
                self._version = now.version
                return True
        return False

    def _write(self, remove: bool = False) -> None:
        content = None
        if not remove:
            body = self.state.spec if self.state is not None else None
            whole = self._document(body or DeploymentBody(machines=[]), {} if body is None else body.manifests)
            made = f"fogspec status {self.layout.name}"
            content = yaml_text(whole.model_dump(mode="json"), made).encode()
        elif self._version is None:
            return
        why = f"{self.what} on {os.uname().nodename}"
        self._version = self.store.write(key_of(self.owner), content, self._version, why)
        self.damaged = None

    def _document(self, body: DeploymentBody, manifests: Mapping[str, str]) -> SharedState:
        names = {one.name for one in body.machines}
        return SharedState(
            metadata=EnvironmentMetadata(name=self.layout.name),
            spec=SharedBody(
                repository=self.owner.repository,
                owner=self.owner.digest,
                machines=body.machines,
                spent=body.spent,
                history=body.history,
                manifests={name: text for name, text in manifests.items() if name in names},
                lease=self._lease,
            ),
        )

    def _until(self) -> str:
        return date_of((self.times.date() + timedelta(seconds=LEASE_S)).timestamp())


@contextlib.contextmanager
def holding(
    layout: Layout,
    what: str,
    times: "WallClock",
    report: Callable[[str], None],
    salvage: bool = False,
    owner: Owner | None = None,
    ends: bool = False,
) -> Iterator[SharedRecord | None]:
    """Hold the application's lease for `what`: the lock on this computer and, where clones share the state, its record.

    The record is renewed while it is held; it is None where the state is in the folder `.fogspec`. `owner` is another one
    than the application of this repository. With `ends` state that git tracks is accepted, and the lock's file goes.
    Raise Busy if another command holds the lease, StoreUnavailable, and the errors of `application_lock`, `store_of` and
    `SharedRecord.take`.
    """
    with application_lock(layout, what, remove=ends, tracked=ends):
        store = store_of(layout)
        if store is None:
            yield None
            return
        with _shared(store, layout, what, times, report, salvage, owner) as record:
            yield record


@contextlib.contextmanager
def _shared(
    store: Store,
    layout: Layout,
    what: str,
    times: "WallClock",
    report: Callable[[str], None],
    salvage: bool,
    owner: Owner | None,
) -> Iterator[SharedRecord]:
    owner = owner or owner_of(layout)
    record = SharedRecord(store=store, layout=layout, times=times, what=what, report=report, owner=owner)
    record.take(salvage)
    over = threading.Event()

    def renewing() -> None:
        while not over.wait(RENEW_S):
            record.renew()

    thread = threading.Thread(target=renewing, name="fogspec lease", daemon=True)
    thread.start()
    try:
        yield record
    finally:
        over.set()
        record.give_back()
        _recent.pop(store, None)


def _process() -> str:
    """Return what identifies this process among all that run and ran on this computer."""
    space = ""
    with contextlib.suppress(OSError):
        space = os.readlink("/proc/self/ns/pid")
    return f"{SystemClock().boot()} {space} {os.getpid()} {start_ticks(os.getpid())}"


def _is_here(lease: Lease) -> bool:
    """Return whether the holder is, or was, a process among those that this one can see."""
    return lease.process.split(" ")[:2] == _process().split(" ")[:2]


def _has_ended(lease: Lease) -> bool:
    """Return whether the holder is known to have ended."""
    words = lease.process.split(" ")
    if not _is_here(lease) or len(words) != 4 or not words[2].isdigit():
        return False
    return str(start_ticks(int(words[2]))) != words[3]
