"""The journal of a benchmark: every start is on disk before it can cost anything.

One JSON line per entry, appended and synced. A controller that is killed at any moment leaves at most one torn
last line, which describes nothing that had happened yet and is cut off. Entries:

    campaign  a bench begins: runner, and what had been spent on the results file until then
    start     about to start a machine: its name, its sample, price, lifetime and the clock's reading
    outlived  that machine is still there though its longest time is over
    end       that machine is verified gone: what it cost and, unless it is tried again, its record
    written   that record is in the results file
"""

import contextlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from fogspec.backends.naming import ForeignMachine, Owner
from fogspec.base.clock import Clock
from fogspec.base.clouds import cloud_of
from fogspec.base.errors import OutOfDate
from fogspec.base.layout import MOST_BYTES
from fogspec.base.project_files import ProjectFiles
from fogspec.plan.schema import Sample
from fogspec.results.schema import Measured

UNREADABLE = (ValueError, KeyError, TypeError, AttributeError, RecursionError)
ORPHAN = "unknown"  # the application of a machine that is only taken down
LOOK = "it says which machines were started; look for machines left running, then delete the file"
MOST = 1e12  # of seconds, of USD: more is garbage


@dataclass(frozen=True, slots=True, kw_only=True)
class LaunchRecord:
    """A machine that was started, or was about to be: enough to find it, stop it and bound its cost.

    Its own end comes `lifetime_s` after it was armed, and it is paid for `paid_s` at most; see `fogspec.plan.commitment`.
    `at_s` is the reading of the clock of this `boot`, `at_unix_s` that of the wall clock.
    One that has `outlived` its longest time does not end by itself.
    """

    name: str
    runner: str
    application: str
    sample: Sample
    price_usd_per_hour: float
    lifetime_s: float
    paid_s: float
    at_s: float
    at_unix_s: float
    boot: str
    outlived: bool = False

    @property
    def commitment_usd(self) -> float:
        """The most that it can cost: its price for the longest time that is paid."""
        return self.usd(self.paid_s)

    def usd(self, paid_s: float) -> float:
        """Return what it costs while it is there for so long, as its cloud bills."""
        return self.price_usd_per_hour * cloud_of(self.sample.machine.infra).billed_s(paid_s) / 3600

    def passed_s(self, clock: Clock) -> float:
        """Return the seconds since it was started.

        Over a restart of this host the wall clock tells, and it may be wrong: no less than the longest time is assumed.
        """
        age_s = self.age_s(clock)
        return age_s if self.boot == clock.boot() else max(age_s, self.paid_s)

    def age_s(self, clock: Clock) -> float:
        """Return the seconds since it was started, as far as the clocks tell."""
        if self.boot == clock.boot():
            return clock.now_s() - self.at_s
        return max(clock.unix_s() - self.at_unix_s, 0.0)


@dataclass(slots=True, kw_only=True)
class JournalState:
    """The sum of the journal: machines not verified gone, records not yet in the results, money spent.

    `totals` is what the application has cost so far in USD, by runner: the recorded costs of a replay are no money.
    `ended` are machines that were verified gone, as if they had been started then: should one come back, it is paid from there.
    """

    open: dict[str, LaunchRecord] = field(default_factory=dict)
    ended: dict[str, LaunchRecord] = field(default_factory=dict)
    unwritten: dict[str, tuple[LaunchRecord, Measured]] = field(default_factory=dict)
    totals: dict[str, float] = field(default_factory=dict)
    runner: str = ""
    campaign: dict[str, Any] | None = None
    campaigns: int = 0
    attempts: int = 0

    @classmethod
    def read(cls, content: bytes) -> "JournalState":
        """Return the sum of a journal's content as far as it can be read."""
        state = cls()
        with contextlib.suppress(*UNREADABLE):
            for line in content[: content.rfind(b"\n") + 1].splitlines():
                state.apply(json.loads(line))
        return state

    @property
    def spent_usd(self) -> float:
        """The cost so far with the runner of the latest bench."""
        return self.totals.get(self.runner, 0.0)

    @property
    def committed_usd(self) -> float:
        """The most that the machines not verified gone can cost."""
        return sum(started.commitment_usd for started in self.open.values())

    def apply(self, entry: dict[str, Any]) -> None:
        """Add one entry; raise KeyError, TypeError or ValueError if it is malformed."""
        kind = entry["do"]
        if kind == "campaign":
            _name(entry["application"])
            self.campaign, self.runner = entry, _name(entry["runner"])
            self.totals[self.runner] = _amount(entry["base_usd"])
            self.campaigns += 1
        elif kind == "start":
            self.open[entry["name"]] = _started(entry)
            self.attempts += 1
        elif kind == "outlived":
            self.open[entry["name"]] = replace(self.open[entry["name"]], outlived=True)
        elif kind == "end":
            started = self.open.pop(entry["name"])
            if "at_s" in entry:
                self.ended[started.name] = replace(started, **_moment(entry), application=ORPHAN, outlived=False)
            # Sums of decimal amounts: without the noise of binary fractions.
            self.totals[self.runner] = round(self.spent_usd + _amount(entry["spent_usd"]), 9)
            if entry["record"] is not None:
                self.unwritten[started.name] = started, Measured.model_validate(entry["record"])
        elif kind == "written":
            del self.unwritten[entry["name"]]
        else:
            raise ValueError(kind)


def _started(entry: Mapping[str, Any]) -> LaunchRecord:
    return LaunchRecord(
        name=_name(entry["name"]),
        runner=_name(entry["runner"]),
        application=_name(entry["application"]),
        sample=Sample.model_validate(entry["sample"]),
        price_usd_per_hour=_amount(entry["price_usd_per_hour"]),
        lifetime_s=_amount(entry["lifetime_s"]),
        paid_s=_amount(entry["paid_s"]),
        **_moment(entry),
        outlived=entry.get("outlived") is True,
    )


def _moment(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return the readings of the clocks in an entry."""
    return {
        "at_s": _amount(entry["at_s"]),
        "at_unix_s": _amount(entry["at_unix_s"]),
        "boot": _name(entry["boot"]),
    }


def _amount(value: Any) -> float:
    """Return seconds or USD; raise ValueError if the value is out of range."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value <= MOST:
        raise ValueError(value)
    return float(value)


def _name(value: Any) -> str:
    """Return a text that can be a directory's name; raise ValueError for any other."""
    if not isinstance(value, str) or not value.isprintable() or "/" in value or value in (".", ".."):
        raise ValueError(value)
    return value


class Journal:
    """An append-only file, held open; `book` is what it says so far."""

    def __init__(self, path: Path, sync: Callable[[int], None] = os.fsync, files: ProjectFiles | None = None) -> None:
        """Read the file of a project's `files` and cut off a torn last line; raise OutOfDate if it was damaged.

        Without `files`, its folder is the user's own word.
        """
        self.path, self._sync = path, sync
        self.state = JournalState()
        self._file = (files or ProjectFiles(path.parent)).append(path)
        if os.fstat(self._file.fileno()).st_size > MOST_BYTES:
            raise OutOfDate(f"{path}: it has more than {MOST_BYTES >> 20} MiB, as no journal has", LOOK)
        self._file.seek(0)
        content = self._file.read()
        whole = content.rfind(b"\n") + 1
        for number, line in enumerate(content[:whole].splitlines(), 1):
            self._replay(number, line)
        self._file.truncate(whole)

    def _replay(self, number: int, line: bytes) -> None:
        try:
            self.state.apply(json.loads(line))
        except UNREADABLE as wrong:
            raise OutOfDate(
                f"{self.path}:{number}: this line of the journal cannot be read",
                LOOK,
            ) from wrong

    def check_owned(self, owner: Owner) -> None:
        """Raise ForeignMachine if a machine that may run, or a record not yet written, is not one of the owner's."""
        names = [*self.state.open, *self.state.unwritten]
        if foreign := [name for name in names if not owner.has(name)]:
            raise ForeignMachine(foreign, owner, str(self.path))

    def append(self, **entry: Any) -> None:
        """Write one entry and sync it; on OSError (a full disk) nothing was written."""
        size = os.fstat(self._file.fileno()).st_size
        line = json.dumps(entry, sort_keys=True).encode() + b"\n"
        try:
            written = self._file.write(line)
            if written != len(line):
                raise OSError(28, os.strerror(28), str(self.path))
            self._sync(self._file.fileno())
        except OSError:
            with contextlib.suppress(OSError):
                self._file.truncate(size)
            raise
        self.state.apply(json.loads(line))

    def begin(self, runner: str, application: str, plan: str, results_usd: float) -> None:
        """Begin a bench of an application that has cost `results_usd` so far, by other records than this journal.

        Only the journal's sum has machines that were stopped without a record. It continues whatever has changed in what is
        measured: the budget is the application's.
        """
        base_usd = max(results_usd, self.state.totals.get(runner, 0.0))
        self.append(do="campaign", runner=runner, application=application, plan=plan, base_usd=base_usd)

    def start(self, started: LaunchRecord) -> None:
        """Record a machine, before it is started."""
        facts = {key: getattr(started, key) for key in LaunchRecord.__slots__}
        self.append(do="start", **{**facts, "sample": started.sample.model_dump(mode="json")})

    def outlived(self, name: str) -> LaunchRecord:
        """Record that a machine is still there though its longest time is over, and return what is known of it."""
        self.append(do="outlived", name=name)
        return self.state.open[name]

    def end(
        self,
        name: str,
        spent_usd: float,
        record: Measured | None,
        clock: Clock | None = None,
    ) -> None:
        """Record that a machine is verified gone, now; without a record its sample is measured again."""
        dumped = None if record is None else record.model_dump(mode="json")
        now = {} if clock is None else {"at_s": clock.now_s(), "at_unix_s": clock.unix_s(), "boot": clock.boot()}
        self.append(do="end", name=name, spent_usd=spent_usd, record=dumped, **now)

    def written(self, name: str) -> None:
        """Record that the sample is in the results file."""
        self.append(do="written", name=name)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
