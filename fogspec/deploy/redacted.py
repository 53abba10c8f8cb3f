"""A deployer whose words have no secrets in them: machines and clouds say what they like."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from fogspec.agent.secrecy import Secrets
from fogspec.backends.protocol import Deployer, DeploymentStatus, Launch, LaunchRefused, Unreachable


class RedactingDeployer:
    """Does what another deployer does, and passes on what it says without the secrets."""

    def __init__(self, deployer: Deployer, secrets: Secrets) -> None:
        self.name, self.poll_s = deployer.name, deployer.poll_s
        self._deployer, self._secrets = deployer, secrets

    def start(self, launch: Launch) -> None:
        """Start it."""
        with self._discreetly():
            self._deployer.start(launch)

    def look(self, launch: Launch) -> DeploymentStatus:
        """How it is."""
        with self._discreetly():
            live = self._deployer.look(launch)
        return live if live.detail is None else replace(live, detail=self._secrets.out_of(live.detail))

    def end(self, launch: Launch) -> None:
        """End it."""
        with self._discreetly():
            self._deployer.end(launch)

    def names(self, application: str, state: Path) -> Sequence[str]:
        """What runs of an application."""
        with self._discreetly():
            return self._deployer.names(application, state)

    @contextmanager
    def _discreetly(self) -> Iterator[None]:
        try:
            yield
        except LaunchRefused as no:
            raise LaunchRefused(no.reason, self._secrets.out_of(no.detail), again=no.again) from None
        except Unreachable as lost:
            raise Unreachable(self._secrets.out_of(str(lost))) from None


def redacting(deployer_for: Callable[[str], Deployer], names: Iterable[str]) -> Callable[[str], Deployer]:
    """The same deployers by infra, without the values of these variables in what they say."""
    secrets = Secrets.of(names)
    return lambda infra: RedactingDeployer(deployer_for(infra), secrets)
