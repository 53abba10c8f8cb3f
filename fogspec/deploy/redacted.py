"""A deployment backend whose messages contain no secrets: they come from machines and clouds."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from fogspec.agent.redaction import Secrets
from fogspec.backends.naming import Owner
from fogspec.backends.protocol import DeploymentBackend, DeploymentStatus, Job, LaunchRefused, Unreachable


class RedactingBackend:
    """Delegates to another backend, and removes the secrets from its messages."""

    def __init__(self, backend: DeploymentBackend, secrets: Secrets) -> None:
        self.name, self.poll_s = backend.name, backend.poll_s
        self._backend, self._secrets = backend, secrets

    def check_access(self, places: Collection[str]) -> None:
        """Raise CloudError if no machine is available."""
        self._backend.check_access(places)

    def start(self, job: Job) -> None:
        """Start the job."""
        with self._redacted():
            self._backend.start(job)

    def poll(self, job: Job) -> DeploymentStatus:
        """Return its status."""
        with self._redacted():
            status = self._backend.poll(job)
        return status if status.detail is None else replace(status, detail=self._secrets.redact(status.detail))

    def labels(self, job: Job) -> Mapping[str, str]:
        """Return its labels, which are digests."""
        with self._redacted():
            return self._backend.labels(job)

    def read_log(self, job: Job) -> bytes:
        """Return what it has printed, from which its machine took the secrets."""
        with self._redacted():
            return self._backend.read_log(job)

    def stop(self, job: Job) -> None:
        """Stop it."""
        with self._redacted():
            self._backend.stop(job)

    def list(self, owner: Owner, directory: Path) -> Sequence[str]:
        """Return the names of the owner's jobs."""
        with self._redacted():
            return self._backend.list(owner, directory)

    @contextmanager
    def _redacted(self) -> Iterator[None]:
        try:
            yield
        except LaunchRefused as no:
            raise LaunchRefused(no.reason, self._secrets.redact(no.detail), again=no.again) from None
        except Unreachable as lost:
            raise Unreachable(self._secrets.redact(str(lost))) from None


def redacting(
    backend_for: Callable[[str], DeploymentBackend], names: Iterable[str]
) -> Callable[[str], DeploymentBackend]:
    """Return the same backends by infra, without the values of these variables in their messages."""
    secrets = Secrets.of(names)
    return lambda infra: RedactingBackend(backend_for(infra), secrets)
