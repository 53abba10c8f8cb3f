"""One bench of an application at a time, also from two clones: only who holds the claim starts more than one machine.

A list of what runs decides, where it shows the machines of both: on clouds, if both use one SkyPilot API server. A bench starts
one machine and, once a list shows that machine and none of another bench, holds the claim for as long as it has a machine that
was seen. Who sees another bench's machine before that does not hold it. So of two benches at most one holds it, however late
machines appear in lists: whose list comes second sees the other's machine. The one with the higher token ends its machine at
once; the other waits for that, and ends its own if it waits in vain.
"""

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from fogspec.backends.naming import Owner
from fogspec.backends.protocol import Costs, Job, SampleBackend, SampleStatus, Unreachable
from fogspec.base.errors import Busy

LIST_S = 2.0  # between lists while the claim is open
PATIENCE_S = 300.0  # for the other bench to end its machine


class ClaimingBackend:
    """Delegates to another backend; `ours` are the machines of this bench, `token` is in the names of those that it starts."""

    def __init__(
        self,
        backend: SampleBackend,
        *,
        owner: Owner,
        directory: Path,
        token: str,
        ours: Callable[[], Collection[str]],
        now_s: Callable[[], float],
    ) -> None:
        self.name, self.source, self.notes = backend.name, backend.source, backend.notes
        self.poll_s, self.costs = backend.poll_s, backend.costs
        self._backend, self._owner, self._directory = backend, owner, directory
        self._token, self._ours, self._now_s = token, ours, now_s
        self._seen: set[str] = set()
        self._due_s = 0.0
        self._until_s: float | None = None

    @property
    def held(self) -> bool:
        """Whether this bench holds the claim. Without real money every bench does."""
        return bool(self._seen) or self.costs != Costs.REAL

    @property
    def at_once(self) -> int:
        """The largest number of jobs at the same time: one until the claim is held."""
        return self._backend.at_once if self.held else 1

    @at_once.setter
    def at_once(self, count: int) -> None:
        self._backend.at_once = count

    def check_access(self, places: Collection[str]) -> None:
        """Raise CloudError if no machine is available."""
        self._backend.check_access(places)

    def start(self, job: Job) -> None:
        """Start the job."""
        self._backend.start(job)

    def poll(self, job: Job) -> SampleStatus:
        """Return its status; raise Busy if another bench of the application has a machine."""
        status = self._backend.poll(job)
        if not status.running:
            self._seen.discard(job.name)
        elif not self.held and self._now_s() >= self._due_s:
            self._claim()
        return status

    def stop(self, job: Job) -> int | None:
        """Stop it."""
        self._seen.discard(job.name)
        return self._backend.stop(job)

    def list(self, owner: Owner, directory: Path) -> Sequence[str]:
        """Return the names of the owner's jobs."""
        return self._backend.list(owner, directory)

    def _claim(self) -> None:
        now_s = self._now_s()
        self._due_s = now_s + LIST_S
        try:
            found = [name for name in self._backend.list(self._owner, self._directory) if self._owner.has_sample(name)]
        except Unreachable:
            return
        mine = set(self._ours())
        # A machine of this bench that has just ended may be listed for a while.
        others = [name for name in found if name not in mine and _token_of(name) != self._token]
        if not others:
            self._seen = mine & set(found)
            self._until_s = None
            return
        self._until_s = now_s + PATIENCE_S if self._until_s is None else self._until_s
        if now_s >= self._until_s or min(map(_token_of, others)) < self._token:
            raise Busy(
                "another bench of this application started at the same time: this one ends its machine",
                *others,
                "let that bench finish where it runs, then run this one again",
            )


def _token_of(name: str) -> str:
    """Return the token in the name of a sample's machine."""
    parts = name.rsplit("-", 2)
    return parts[1] if len(parts) == 3 else ""
