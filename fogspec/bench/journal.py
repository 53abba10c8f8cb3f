"""The journal of a benchmark: what was started is on disk before it costs anything.

One JSON line an entry, appended and synced. A controller that is killed at any moment leaves at most one torn
last line, which says nothing that had happened yet and is cut off. Entries:

    campaign  a bench begins: runner, and what had been spent on the results file until then
    start     about to start a machine: its name, its sample, price, lifetime and the clock's reading
    end       that machine is verified gone: what it cost and, unless it is tried again, its record
    written   that record is in the results file
"""

import contextlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fogspec.base.errors import OutOfDate
from fogspec.base.regular import check_file
from fogspec.plan.schema import Sample
from fogspec.results.schema import Measured

MOST = 1e12  # of seconds, of USD: more is garbage


@dataclass(frozen=True, slots=True)
class LaunchRecord:
    """A machine that was started, or was about to be: enough to find it, end it and know its worst bill."""

    name: str
    runner: str
    application: str
    sample: Sample
    price_usd_per_hour: float
    lifetime_s: float
    at_s: float
    boot: str
    substitute_for: str | None = None

    @property
    def commitment_usd(self) -> float:
        """The most it can cost: its price until the moment it ends by itself."""
        return self.price_usd_per_hour * self.lifetime_s / 3600


@dataclass(slots=True)
class JournalState:
    """What the journal adds up to: machines not known to be gone, records not yet written, money spent."""

    open: dict[str, LaunchRecord] = field(default_factory=dict)
    unwritten: dict[str, tuple[LaunchRecord, Measured]] = field(default_factory=dict)
    spent_usd: float = 0.0
    campaign: dict[str, Any] | None = None
    campaigns: int = 0
    attempts: int = 0

    @property
    def committed_usd(self) -> float:
        """The most that the machines not known to be gone can cost."""
        return sum(started.commitment_usd for started in self.open.values())

    def take(self, entry: dict[str, Any]) -> None:
        """Add one entry; raises KeyError, TypeError or ValueError for one that nobody wrote like this."""
        kind = entry["do"]
        if kind == "campaign":
            _name(entry["application"])
            self.campaign, self.spent_usd = entry, _amount(entry["base_usd"])
            self.campaigns += 1
        elif kind == "start":
            self.open[entry["name"]] = _started(entry)
            self.attempts += 1
        elif kind == "end":
            started = self.open.pop(entry["name"])
            self.spent_usd += _amount(entry["spent_usd"])
            if entry["record"] is not None:
                self.unwritten[started.name] = started, Measured.model_validate(entry["record"])
        elif kind == "written":
            del self.unwritten[entry["name"]]
        else:
            raise ValueError(kind)


def _started(entry: Mapping[str, Any]) -> LaunchRecord:
    substitute_for = entry.get("substitute_for")
    return LaunchRecord(
        _name(entry["name"]), _name(entry["runner"]), _name(entry["application"]), Sample.model_validate(entry["sample"]),
        _amount(entry["price_usd_per_hour"]), _amount(entry["lifetime_s"]), _amount(entry["at_s"]), _name(entry["boot"]),
        None if substitute_for is None else _name(substitute_for),
    )  # fmt: skip


def _amount(value: Any) -> float:
    """Seconds or USD; raises ValueError for what is no such number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value <= MOST:
        raise ValueError(value)
    return float(value)


def _name(value: Any) -> str:
    """A word that may be a folder's name; raises ValueError for any other."""
    if not isinstance(value, str) or not value.isprintable() or "/" in value or value in (".", ".."):
        raise ValueError(value)
    return value


class Journal:
    """An append-only file, held open; `book` is what it says so far."""

    def __init__(self, path: Path, sync: Callable[[int], None] = os.fsync) -> None:
        """Read what is there and cut off a torn last line; raises OutOfDate for a journal that was damaged."""
        self.path, self._sync = path, sync
        self.book = JournalState()
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            check_file(path)
        self._file = open(path, "ab+", buffering=0)  # noqa: SIM115 -- held until close
        self._sync_folder()
        self._file.seek(0)
        content = self._file.read()
        whole = content.rfind(b"\n") + 1
        for number, line in enumerate(content[:whole].splitlines(), 1):
            self._replay(number, line)
        self._file.truncate(whole)

    def _replay(self, number: int, line: bytes) -> None:
        try:
            self.book.take(json.loads(line))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as wrong:
            raise OutOfDate(
                f"{self.path}:{number}: this line of the journal cannot be read",
                "it says which machines were started; look for machines left running, then delete the file",
            ) from wrong

    def append(self, **entry: Any) -> None:
        """Write one entry and return when it is on disk; on OSError (a full disk) nothing was written."""
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
        self.book.take(json.loads(line))

    def begin(self, runner: str, application: str, plan: str, results_usd: float) -> None:
        """A bench begins on a results file that says it has cost `results_usd` so far.

        Machines that were ended without a record are in the journal's sum only.
        """
        goes_on = self.book.campaign is not None and self.book.campaign["application"] == application
        base_usd = max(results_usd, self.book.spent_usd) if goes_on else results_usd
        self.append(do="campaign", runner=runner, application=application, plan=plan, base_usd=base_usd)

    def start(self, started: LaunchRecord) -> None:
        """Call before a machine is started."""
        facts = {key: getattr(started, key) for key in LaunchRecord.__slots__}
        self.append(do="start", **{**facts, "sample": started.sample.model_dump(mode="json")})

    def end(self, name: str, spent_usd: float, record: Measured | None) -> None:
        """Call when a machine is verified gone; without a record it is measured again."""
        dumped = None if record is None else record.model_dump(mode="json")
        self.append(do="end", name=name, spent_usd=spent_usd, record=dumped)

    def written(self, name: str) -> None:
        """Call when the record is in the results file."""
        self.append(do="written", name=name)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _sync_folder(self) -> None:
        folder = os.open(self.path.parent, os.O_RDONLY)
        try:
            self._sync(folder)
        finally:
            os.close(folder)
