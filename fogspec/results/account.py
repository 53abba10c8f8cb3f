"""The account of the requests that a node started: each has ended, is under way, or is lost."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from fogspec.results.hangs import LEAST_S, PAUSES
from fogspec.results.join import Request

PROCESSES = 10_000  # that are told apart

Key = tuple[str, int]


@dataclass(slots=True)
class _Process:
    first: int
    last: int
    known: int = 0
    command: str = ""


@dataclass(frozen=True, slots=True)
class Balance:
    """What an account tells at its end.

    `lost` requests never ended. Those `under_way_s` had been open for so long, longer than any that ended. Of `guessed` ones it
    is not known which of several ended. Since the start of a request that has been open for `waited_s`, none has ended; None
    where that is no longer than a pause.
    """

    lost: int = 0
    under_way_s: tuple[float, ...] = ()
    guessed: int = 0
    waited_s: float | None = None


@dataclass(slots=True)
class Account:
    """The starts of one name, and the requests that ended, as their lines come; times in seconds of one clock."""

    processes: dict[str, _Process] = field(default_factory=dict)
    opened: dict[Key, float] = field(default_factory=dict)
    until_s: float = float("-inf")
    last_end_s: float = float("-inf")

    def start(self, process: str, number: int, start_s: float, command: str) -> None:
        """Take the line of a start."""
        self.opened[process, number] = start_s
        self.until_s = max(self.until_s, start_s)
        if (known := self._process(process, number)) is not None:
            known.known, known.command = known.known + 1, command or known.command

    def end(self, one: Request) -> None:
        """Take a request that ended; one without a number is not of this account."""
        if one.start_s is not None:
            self.last_end_s = max(self.last_end_s, one.start_s + one.latency_s)
            self.until_s = max(self.until_s, self.last_end_s)
        if one.number is not None:
            self.opened.pop((one.process, one.number), None)
            self._process(one.process, one.number)

    def _process(self, process: str, number: int) -> _Process | None:
        if process not in self.processes and len(self.processes) >= PROCESSES:
            return None
        known = self.processes.setdefault(process, _Process(number, number))
        known.first, known.last = min(known.first, number), max(known.last, number)
        return known

    def command(self, one: Request) -> str:
        """Return the command of the spec that made the request, empty if it is not known."""
        known = self.processes.get(one.process)
        return "" if known is None else known.command

    def commands(self) -> list[str]:
        """Return the commands that started requests."""
        return sorted({one.command for one in self.processes.values() if one.command})

    def balance(self, finished: Sequence[Request], warmup: int, timeout_s: float | None) -> Balance:
        """Return the balance: starts = ended + open, and what became of the open ones.

        As many may be under way as ever were at the same time, the youngest; at least one.
        """
        longest_s = max((one.latency_s for one in finished), default=0.0)
        ages_s = [self.until_s - start_s for (_, number), start_s in self.opened.items() if number > warmup]
        old_s = sorted(age_s for age_s in ages_s if age_s > longest_s)
        most_s = min(PAUSES * longest_s, float("inf") if timeout_s is None else timeout_s)
        together = _most_together(finished)
        under_way_s = tuple(age_s for age_s in old_s[:together] if age_s <= most_s)
        # Lines of threads may change places where a file begins and ends.
        unknown = sum(max(0, one.last - one.first + 1 - one.known - together) for one in self.processes.values())
        guessed = sum(one.above is not None for one in finished)
        waiting_s = max(
            (self.until_s - start_s for start_s in self.opened.values() if start_s >= self.last_end_s), default=0.0
        )
        waited_s = waiting_s if finished and waiting_s > max(most_s, LEAST_S) else None
        return Balance(len(old_s) - len(under_way_s) + unknown, under_way_s, guessed, waited_s)


def _most_together(finished: Sequence[Request]) -> int:
    """Return how many requests were open at the same time at most; 1 where nothing is known."""
    starts = sorted(one.start_s for one in finished if one.start_s is not None)
    ends = sorted(one.start_s + one.latency_s for one in finished if one.start_s is not None)
    most = ended = 0
    for begun, start_s in enumerate(starts, 1):
        while ends[ended] <= start_s and ended < begun - 1:
            ended += 1
        most = max(most, begun - ended)
    return max(1, most)
