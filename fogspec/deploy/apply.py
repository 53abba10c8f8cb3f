"""From an approved manifest to nodes that answer: nothing is started before it is on disk, nothing is left behind.

The live state is written whole before each step, so that whoever comes after a process that was killed between any two
steps knows every machine there may be, and ends or keeps it. The old machine goes when the new one has answered.
"""

import contextlib
import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from fogspec.backends.naming import deployment_name, is_deployment_of
from fogspec.backends.protocol import DeploymentBackend, DeploymentStatus, LaunchRefused, Unreachable
from fogspec.base.errors import CloudError, Interrupted, InvalidInput, Refused
from fogspec.deploy.candidates import Candidate
from fogspec.deploy.schema import DeployedMachine, date_of
from fogspec.deploy.state import DeploymentState

NO_CAPACITY = ("capacity", "quota")
STOPPED = "interrupted: what was being started is gone, what served before still does"


class _MachineLost(Exception):
    """A machine went away before its nodes answered."""


@dataclass(slots=True)
class Rollout:
    """One application of a manifest.

    `backend_of` finds who keeps a machine by its infra; `linked` joins robot and cloud once the nodes are ready, and
    says why the link does not answer yet.
    """

    live: DeploymentState
    manifest: bytes
    digest: str
    candidates: Sequence[Candidate]
    image: str | None
    files: Mapping[str, str]
    patience_s: float
    backend_of: Callable[[str], DeploymentBackend]
    tell: Callable[[str], None] = lambda _text: None
    stopping: Callable[[], bool] = lambda: False
    linked: Callable[[DeployedMachine, DeploymentStatus], str | None] = lambda _machine, _live: None

    def current(self) -> DeployedMachine | None:
        """The machine that serves this manifest already; None where there is none, or its nodes have ended.

        None also where files beside the spec have changed since. Raises CloudError where nobody can say: another one
        beside it would cost twice.
        """
        for machine in self.live.machines:
            same = machine.manifest == self.digest and self._runs(machine) == machine.runs
            if machine.state == "serving" and same and self._lives(machine):
                return machine
        return None

    def _runs(self, machine: DeployedMachine) -> str:
        """What the machine would be given now; where it is not offered any more, what it was given."""
        return next((one.runs for one in self.candidates if one.number == machine.fallback), machine.runs)

    def kept(self) -> DeployedMachine | None:
        """The machine that serves an older manifest and is given the same by this one: it goes on under the new manifest.

        None where there is none. Raises CloudError where nobody can say.
        """
        first = self.candidates[0]
        for machine in self.live.machines:
            same = machine.runs == first.runs and machine.image == self.image
            if machine.state == "serving" and same and self._lives(machine):
                self.live.keep_manifest(machine.name, self.manifest)
                now = machine.machine.model_copy(update={"price": first.price_usd_per_hour})
                machine = machine.model_copy(update={"manifest": self.digest, "machine": now, "fallback": 0})
                self.live.put(machine, ends=True)
                return machine
        return None

    def _lives(self, machine: DeployedMachine) -> bool:
        """Whether its nodes run; raises CloudError where nobody can say."""
        try:
            live = self.backend_of(machine.machine.infra).poll(self.live.job(machine))
        except LaunchRefused:
            return False
        except Unreachable as lost:
            raise CloudError(f"{machine.name}: nobody can say how it is: {lost}", "safe to run again") from None
        return live.state in ("starting", "ready")

    def strangers(self) -> list[str]:
        """Machines that were started to serve this application and that the live state does not have.

        Raises CloudError where nobody can say: another one beside them would cost twice.
        """
        layout, known = self.live.layout, {machine.name for machine in self.live.machines}
        backends = {one.name: one for one in (self.backend_of(c.machine.infra) for c in self.candidates)}
        try:
            found = [name for one in backends.values() for name in one.list(layout.name, layout.state)]
        except Unreachable as lost:
            raise CloudError(f"{layout.name}: nobody can say what runs of it: {lost}", "safe to run again") from None
        return sorted(name for name in set(found) - known if is_deployment_of(name, layout.name))

    def tidy(self, keep: Sequence[str]) -> bool:
        """End all machines but these; whether there were any. Raises CloudError for one not verified gone."""
        others = [machine for machine in self.live.machines if machine.name not in keep]
        for machine in others:
            end(self.live, machine, self.backend_of(machine.machine.infra), self.tell)
        return bool(others)

    def unfinished(self) -> DeployedMachine | None:
        """A machine that an earlier apply of this manifest started and did not see through, if it is still there."""
        for machine in self.live.machines:
            if machine.state == "starting" and machine.manifest == self.digest and machine.runs == self._runs(machine):
                with contextlib.suppress(LaunchRefused):
                    if self._look(machine).state in ("starting", "ready"):
                        return machine
                self._end(machine)
        return None

    def run(self) -> DeployedMachine:
        """Start the machine, or the next one where it cannot be had; wait until it answers; end the old one.

        Raises CloudError when none could be had or the nodes do not answer in time, Refused for a price that rose,
        InvalidInput when a node ended, Interrupted when the user stopped it: what served before still does.
        """
        begun = self.unfinished()
        for one in self.candidates:
            if begun is not None and one.number < begun.fallback:
                continue
            served, begun = self._tried(one, begun), None
            if served is not None:
                self.live.put(served, ends=True)
                self.tidy([served.name])
                return served
        raise CloudError("the manifest names no machine that may be started")

    def _tried(self, one: Candidate, begun: DeployedMachine | None) -> DeployedMachine | None:
        """The machine once it answers, or None where the next is to be tried.

        One that goes away before it answers, or whose launch is forgotten, is started once more: verified gone before.
        """
        again = True
        while True:
            machine, begun = begun or self._journaled(one), None
            try:
                return self._wait(self._started(machine, one))
            except LaunchRefused as no:
                self._end(machine)
                self._next(one, no)
                return None
            except _MachineLost as gone:
                self._end(machine)
                if self.stopping():
                    raise Interrupted(STOPPED) from None
                why = f"{machine.name}: its machine is gone: {gone}"
                if not again:
                    raise CloudError(why, "safe to run again") from None
                again = False
                self.tell(f"{why}; it is started once more")

    def _journaled(self, one: Candidate) -> DeployedMachine:
        """The machine's record, on disk before anything is started."""
        times, backend = self.live.times, self.backend_of(one.machine.infra)
        machine = DeployedMachine(
            name=deployment_name(self.live.layout.name, self.digest, secrets.token_hex(3)),
            deployer=backend.name, state="starting", manifest=self.digest,
            machine=one.machine.model_copy(update={"price": one.price_usd_per_hour}), runs=one.runs, fallback=one.number,
            image=self.image, files=dict(self.files), at=times.now_s(), boot=times.boot(),
            since=date_of(times.date().timestamp()),
        )  # fmt: skip
        self.live.put(machine)
        return machine

    def _started(self, machine: DeployedMachine, one: Candidate) -> DeployedMachine:
        """Start it, unless an earlier apply did."""
        if (self.live.folder(machine.name) / "manifest.yaml").exists():
            return machine
        self.tell(f"{one.machine.instance} in {one.machine.infra}: starting {machine.name}")
        backend = self.backend_of(one.machine.infra)
        self.live.keep_manifest(machine.name, self.manifest)
        try:
            backend.start(self.live.job(machine, one.task))
        except Unreachable as lost:
            self.tell(f"lost contact: {lost}")
        return machine

    def _next(self, one: Candidate, no: LaunchRefused) -> None:
        """Say that the next machine is tried; raises CloudError where there is none, or none would help.

        Raises Refused for a price that rose between the look-up here and the launch.
        """
        what = f"{one.machine.instance} in {one.machine.infra}"
        if no.reason in NO_CAPACITY and one is not self.candidates[-1]:
            self.tell(f"{what} cannot be had: {no.detail}; the next is tried")
            return
        if no.reason == "budget":
            raise Refused(f"{what}: {no.detail}", "compile again with these prices, or allow it: --max")
        hints: tuple[str, ...] = ()
        if no.reason in NO_CAPACITY and len(self.candidates) > 1:
            hints = (f"none of {len(self.candidates)} machines can be had now: safe to run again",)
        elif no.reason in NO_CAPACITY:
            hints = ("spec.deployment.fallbacks lets other machines take its place", "safe to run again")
        raise CloudError(f"{what}: {no.detail}", *hints)

    def _wait(self, machine: DeployedMachine) -> DeployedMachine:
        """The machine once its nodes and its end of the link answer, else none is left of it.

        Raises _Gone for one that went away, which may not be verified yet.
        """
        said = ""
        while True:
            if self.stopping():
                self._end(machine)
                raise Interrupted(STOPPED)
            live = self._look(machine)
            why = live.detail
            if live.state == "ready" and (why := self.linked(machine, live)) is None:
                return machine.model_copy(update={"state": "serving", "address": live.address})
            if live.state == "ended":
                self._end(machine)
                raise InvalidInput(
                    f"{machine.name}: the nodes do not run: {live.detail or 'they ended without a word'}"
                )
            if live.state == "gone":
                raise _MachineLost(live.detail or "nobody said why")
            if why and why != said:
                said = why
                self.tell(f"{machine.name}: {said}")
            if self.live.up_s(machine) > self.patience_s:
                self._end(machine)
                raise CloudError(
                    f"{machine.name}: the nodes did not answer within {self.patience_s:g} s{f': {said}' if said else ''}",
                    "spec.deployment.ready_timeout is how long is waited; what served before still does",
                )
            self.live.times.sleep(self.backend_of(machine.machine.infra).poll_s)

    def _end(self, machine: DeployedMachine) -> None:
        end(self.live, machine, self.backend_of(machine.machine.infra), self.tell)

    def _look(self, machine: DeployedMachine) -> DeploymentStatus:
        try:
            return self.backend_of(machine.machine.infra).poll(self.live.job(machine))
        except Unreachable as lost:
            return DeploymentStatus(state="starting", detail=f"no contact just now: {lost}")


def end(
    live: DeploymentState, machine: DeployedMachine, backend: DeploymentBackend, tell: Callable[[str], None]
) -> None:
    """End a machine and forget it once it is verified gone; raises CloudError when that cannot be verified.

    A disk that is full keeps no machine alive: what cannot be written now is written by whoever ends it again.
    """
    if machine.state != "ending":
        with contextlib.suppress(InvalidInput, OSError):
            live.put(machine.model_copy(update={"state": "ending"}))
    try:
        backend.stop(live.job(machine))
    except Unreachable as lost:
        raise CloudError(
            f"{machine.name}: could not be verified gone: {lost}",
            f"it may still cost money: fogspec down {live.layout.name}",
        ) from None
    tell(f"{machine.name}: gone")
    live.gone(machine.name)
