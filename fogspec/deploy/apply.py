"""Applying a manifest: locked, on disk before it costs anything, interruptible, leaving nothing behind.

The live state is written whole before each step, so that the next command after a process that was killed between any two
steps knows every machine there may be, and stops or keeps it. The old machine is stopped once the new one has answered.
"""

import contextlib
import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from fogspec.backends.protocol import DeploymentBackend, DeploymentStatus, LaunchRefused, Unreachable, no_access
from fogspec.base.clouds import cloud_name
from fogspec.base.errors import Busy, CloudError, FogspecError, Interrupted, InvalidInput, Refused
from fogspec.base.redaction import check_set, known
from fogspec.base.signals import interruptible
from fogspec.base.text import shell_command
from fogspec.compile.links import link_of
from fogspec.deploy import link
from fogspec.deploy.candidates import Candidate
from fogspec.deploy.lifetime import NO_END, End, end_variables, left_s, limited
from fogspec.deploy.packages import packages_differ, packages_text
from fogspec.deploy.preflight import LaunchPlan
from fogspec.deploy.schema import Applied, DeployedMachine, date_of
from fogspec.deploy.shared_state import holding
from fogspec.deploy.state import SENT, DeploymentState, WallClock
from fogspec.deploy.stores import StoreUnavailable
from fogspec.language.lock_io import snapshot

NO_CAPACITY = ("capacity", "quota")
STOPPED = "interrupted: what was being started is gone, what served before still does"
Backends = Callable[[str], DeploymentBackend]
LinkCheck = Callable[[DeployedMachine, DeploymentStatus], str | None]


class _MachineLost(Exception):
    """A machine went away before its nodes answered."""


@dataclass(frozen=True, slots=True)
class RolloutResult:
    """The machine that serves now, and whether anything changed; `kept` tells that it is the same machine as before."""

    machine: DeployedMachine
    changed: bool
    waited_s: float
    kept: bool = False


@dataclass(slots=True, kw_only=True)
class Rollout:
    """One application of a manifest.

    `send` makes the snapshot of the files that a machine is sent, and raises OutOfDate if they are not `files` any more.
    `backend_of` returns the backend of an infra; `link_check` connects robot and cloud once the nodes are ready, and returns
    why the link does not answer yet. `end` is what ends the machines by itself; `ends`, in place of its `until`, the date in
    UTC at which a machine was to end whose place this one takes. `applied` is the record of this apply.
    """

    live: DeploymentState
    manifest: bytes
    digest: str
    candidates: Sequence[Candidate]
    image: str | None
    files: Mapping[str, str]
    ready_timeout_s: float
    backend_of: Backends
    report: Callable[[str], None] = lambda _text: None
    stopping: Callable[[], bool] = lambda: False
    link_check: LinkCheck = lambda _machine, _status: None
    send: Callable[[Path], object] = lambda _target: None
    end: End = NO_END
    ends: str | None = None
    applied: Applied | None = None

    def current(self) -> DeployedMachine | None:
        """Return the machine that serves this manifest already; None if there is none, or its nodes have ended.

        None also if files next to the spec have changed since. Raise CloudError if its state is unknown: another machine
        besides it would cost twice.
        """
        for machine in self.live.machines:
            same = machine.manifest == self.digest and self._runs(machine) == machine.runs
            if machine.state == "serving" and same and self._is_alive(machine):
                return machine
        return None

    def _runs(self, machine: DeployedMachine) -> str:
        """Return the digest of what the machine would be given now; if it is no longer a candidate, of what it was given."""
        return next((one.runs for one in self.candidates if one.number == machine.fallback), machine.runs)

    def adopt(self) -> DeployedMachine | None:
        """Keep the machine that serves an older manifest and is given the same by this one, under the new manifest.

        Return None if there is none. Raise CloudError if its state is unknown.
        """
        first = self.candidates[0]
        for machine in self.live.machines:
            same = machine.runs == first.runs and machine.image == self.image
            if machine.state == "serving" and same and self._is_alive(machine):
                self.live.keep_manifest(machine.name, self.manifest)
                now = machine.machine.model_copy(update={"price": first.price_usd_per_hour})
                update = {"manifest": self.digest, "machine": now, "fallback": 0, "applied": self.applied}
                machine = machine.model_copy(update=update)
                self.live.put(machine, ends=True)
                return machine
        return None

    def _is_alive(self, machine: DeployedMachine) -> bool:
        """Return whether its nodes run; raise CloudError if that is unknown."""
        try:
            status = self._backend(machine).poll(self.live.job(machine))
        except LaunchRefused:
            return False
        except Unreachable as lost:
            raise CloudError(
                f"{machine.name}: status unknown, no contact with the machine: {lost}", "safe to run again"
            ) from None
        return status.state in ("starting", "ready")

    def unknown_machines(self) -> list[str]:
        """Return machines that were started to serve this application and that the live state does not have.

        Raise CloudError if they cannot be listed: another machine besides them would cost twice.
        """
        layout, known = self.live.layout, {machine.name for machine in self.live.machines}
        backends = {one.name: one for one in (self.backend_of(c.machine.infra) for c in self.candidates)}
        try:
            found = [name for one in backends.values() for name in one.list(self.live.owner, layout.state)]
        except Unreachable as lost:
            raise CloudError(f"{layout.name}: status unknown, no contact: {lost}", "safe to run again") from None
        return sorted(name for name in set(found) - known if self.live.owner.has_deployment(name))

    def stop_others(self, keep: Sequence[str]) -> bool:
        """Stop all machines but these; return whether there were any. Raise CloudError for one not verified gone."""
        others = [machine for machine in self.live.machines if machine.name not in keep]
        for machine in others:
            self._stop(machine)
        return bool(others)

    def unfinished(self) -> DeployedMachine | None:
        """Return a machine that an earlier apply of this manifest started and did not finish, if it is still there."""
        for machine in self.live.machines:
            if machine.state == "starting" and machine.manifest == self.digest and machine.runs == self._runs(machine):
                with contextlib.suppress(LaunchRefused):
                    if self._poll(machine).state in ("starting", "ready"):
                        return machine
                self._stop(machine)
        return None

    def run(self) -> DeployedMachine:
        """Start the machine, or the next one if it is unavailable; wait until it answers; stop the old one.

        Raise CloudError if all are unavailable or the nodes do not answer in time, Refused for a price that rose,
        InvalidInput if a node ended, Interrupted after Ctrl-C: what served before still does. Raise Refused too if another
        apply, from another clone, started a machine meanwhile.
        """
        begun = self.unfinished()
        for one in self.candidates:
            if begun is not None and one.number < begun.fallback:
                continue
            served, begun = self._attempt(one, begun), None
            if served is not None:
                self._check_alone(served)
                served = served.model_copy(update={"applied": self.applied})
                self.live.put(served, ends=True)
                self.stop_others([served.name])
                return served
        raise CloudError("the manifest names no machine that may be started")

    def _check_alone(self, machine: DeployedMachine) -> None:
        """Stop the machine and raise Busy if lists show one that another apply started.

        Both may see each other, and both then stop their own. By now every list shows this machine: who started later sees it.
        """
        while (others := self._listed(machine)) is None:
            self.live.times.sleep(self._backend(machine).poll_s)
        if others:
            self._stop(machine)
            raise Busy(
                f"another apply of {self.live.layout.name} started a machine at the same time: this one ended its own",
                *others,
                "see whether that one serves; fogspec down ends all of them",
            )

    def _listed(self, machine: DeployedMachine) -> list[str] | None:
        """Return `unknown_machines`, None if they cannot be listed just now; stop the machine and raise once its time is up."""
        try:
            return self.unknown_machines()
        except CloudError:
            if self.live.up_s(machine) <= self.ready_timeout_s:
                return None
            self._stop(machine)
            raise

    def _attempt(self, one: Candidate, begun: DeployedMachine | None) -> DeployedMachine | None:
        """Return the machine once it answers, or None if the next is to be tried.

        A machine lost before it became ready is relaunched once, after its termination was verified.
        """
        again = True
        while True:
            machine, begun = begun or self._recorded(one), None
            try:
                return self._wait(self._started(machine, one))
            except LaunchRefused as no:
                self._stop(machine)
                self._next(one, no)
                return None
            except _MachineLost as gone:
                self._stop(machine)
                if self.stopping():
                    raise Interrupted(STOPPED) from None
                why = f"{machine.name}: its machine is gone: {gone}"
                if not again:
                    raise CloudError(why, "safe to run again") from None
                again = False
                self.report(f"{why}; it is started once more")

    def _recorded(self, one: Candidate) -> DeployedMachine:
        """Return the machine's record, on disk before anything is started."""
        times = self.live.times
        ends = self._ends(one)
        name = self.live.owner.deployment_name(self.digest, secrets.token_hex(3))
        self.live.layout.files.remove(self.live.layout.last_words)
        self.send(self.live.folder(name) / SENT)
        deployer = self.backend_of(one.machine.infra).name
        machine = DeployedMachine(
            name=name,
            deployer=deployer,
            place=self.live.place(deployer),
            state="starting",
            manifest=self.digest,
            machine=one.machine.model_copy(update={"price": one.price_usd_per_hour}),
            runs=one.runs,
            fallback=one.number,
            image=self.image,
            files=dict(self.files),
            at=times.now_s(),
            boot=times.boot(),
            since=date_of(times.date().timestamp()),
            ends=ends,
            applied=self.applied,
        )
        self.live.put(machine)
        return machine

    def _ends(self, one: Candidate) -> str | None:
        """Return when the machine is to end by itself, None if it is not; raise Refused if that is now."""
        if not self.end:
            return None
        # What serves now is paid until this one answers.
        meanwhile = sum(other.machine.usd(self.ready_timeout_s) for other in self.live.machines)
        machine = one.machine.model_copy(update={"price": one.price_usd_per_hour})
        end = self.end if self.ends is None else End(self.ends, self.end.budget_usd)
        return end.date(machine, self.live.times.date(), self.live.total_usd() + meanwhile)

    def _started(self, machine: DeployedMachine, one: Candidate) -> DeployedMachine:
        """Start it, unless an earlier apply did."""
        if self.live.manifest_of(machine.name) is not None:
            return machine
        if not self.live.layout.files.exists(self.live.folder(machine.name)):
            self.send(self.live.folder(machine.name) / SENT)  # another clone recorded it and was ended before it began
        self.report(f"{one.machine.instance} in {one.machine.infra}: starting {machine.name}")
        self.live.keep_manifest(machine.name, self.manifest)
        work, task, lifetime_s = one.work, one.task, None
        if machine.ends is not None:
            lifetime_s = max(1.0, left_s(machine.ends, self.live.times.date()))
            work = replace(work, envs={**work.envs, **end_variables(machine.ends, lifetime_s)})
            task = limited(task, machine.machine, machine.ends, lifetime_s)
        try:
            self._backend(machine).start(self.live.job(machine, work, task, one.cap_usd_per_hour, lifetime_s))
        except Unreachable as lost:
            self.report(f"lost contact: {lost}")
        return machine

    def _next(self, one: Candidate, no: LaunchRefused) -> None:
        """Report that the next machine is tried; raise CloudError if there is none, or none would help.

        Raise Refused for a price that rose between its lookup here and the launch.
        """
        what = f"{one.machine.instance} in {one.machine.infra}"
        if no.reason in NO_CAPACITY and one is not self.candidates[-1]:
            self.report(f"{what} is unavailable: {no.detail}; trying the next")
            return
        if no.reason == "access":
            raise no_access(no.detail)
        if no.reason == "budget":
            raise Refused(f"{what}: {no.detail}", "compile again with these prices, or allow it: --max")
        hints: tuple[str, ...] = ()
        if no.reason in NO_CAPACITY and len(self.candidates) > 1:
            hints = (f"none of {len(self.candidates)} machines is available now: safe to run again",)
        elif no.reason in NO_CAPACITY:
            hints = ("spec.deployment.fallbacks lets other machines take its place", "safe to run again")
        if no.reason in NO_CAPACITY and self.end and cloud_name(one.machine.infra) == "slurm":
            hints += (
                "or the deployment's time is longer than the partition allows: see sinfo, lower spec.deployment.until",
            )
        raise CloudError(f"{what}: {no.detail}", *hints)

    def _wait(self, machine: DeployedMachine) -> DeployedMachine:
        """Return the machine once its nodes and its end of the link answer; otherwise stop it and raise.

        Raise _MachineLost for one that went away, which may not be verified yet.
        """
        reported = ""
        while True:
            if self.stopping():
                self._stop(machine)
                raise Interrupted(STOPPED)
            status = self._poll(machine)
            why = status.detail
            if status.state == "ready" and (why := self.link_check(machine, status)) is None:
                layout = self.live.layout
                for text in packages_text(layout.name, packages_differ(layout, machine, status)):
                    self.report(f"warning: {text}")
                return machine.model_copy(update={"state": "serving", "address": status.address})
            if status.state == "ended":
                self._keep_last_words(machine)
                self._stop(machine)
                raise InvalidInput(
                    f"{machine.name}: the nodes do not run: {status.detail or 'they ended without a word'}"
                )
            if status.state == "gone":
                self._keep_last_words(machine)
                raise _MachineLost(status.detail or "for an unknown reason")
            if why and why != reported:
                reported = why
                self.report(f"{machine.name}: {reported}")
            if self.live.up_s(machine) > self.ready_timeout_s:
                self._keep_last_words(machine)
                self._stop(machine)
                last = f": {reported}" if reported else ""
                raise CloudError(
                    f"{machine.name}: the nodes did not answer within {self.ready_timeout_s:g} s{last}",
                    "spec.deployment.ready_timeout is how long is waited; what served before still does",
                )
            self.live.times.sleep(self._backend(machine).poll_s)

    def _backend(self, machine: DeployedMachine) -> DeploymentBackend:
        return self.backend_of(machine.machine.infra)

    def _stop(self, machine: DeployedMachine) -> None:
        stop_machine(self.live, machine, self._backend(machine), self.report)

    def _keep_last_words(self, machine: DeployedMachine) -> None:
        """Keep what a machine's nodes printed that never answered, for `fogspec logs`: its directory goes with it."""
        layout = self.live.layout
        with contextlib.suppress(Unreachable, InvalidInput, OSError):
            if log := self._backend(machine).read_log(self.live.job(machine)):
                layout.files.write(layout.last_words, known().redact_bytes(log))
                self.report(f"{machine.name}: its last words: {shell_command('fogspec', 'logs', layout.name)}")

    def _poll(self, machine: DeployedMachine) -> DeploymentStatus:
        try:
            return self._backend(machine).poll(self.live.job(machine))
        except Unreachable as lost:
            return DeploymentStatus(state="starting", detail=f"no contact just now: {lost}")


def stop_machine(
    live: DeploymentState, machine: DeployedMachine, backend: DeploymentBackend, report: Callable[[str], None]
) -> None:
    """Stop a machine and forget it once it is verified gone; raise CloudError if that cannot be verified.

    Neither a full disk nor a shared state without contact keeps a machine alive: a record that cannot be written now is
    written by the next command that stops it.
    """
    if machine.state != "ending":
        with contextlib.suppress(InvalidInput, StoreUnavailable, OSError):
            live.put(machine.model_copy(update={"state": "ending"}))
    try:
        backend.stop(live.job(machine))
    except Unreachable as lost:
        raise CloudError(
            f"{machine.name}: could not be verified gone: {lost}",
            f"it may still cost money: fogspec down {live.layout.name}",
        ) from None
    report(f"{machine.name}: gone")
    live.gone(machine.name)


def link_check(plan: LaunchPlan, report: Callable[[str], None]) -> LinkCheck:
    """Return a check that gives the cloud's public half and address to the robot's end, and then asks the link."""
    application, layout = plan.opened.loaded.application, plan.opened.layout
    joined: set[str] = set()

    def check(machine: DeployedMachine, status: DeploymentStatus) -> str | None:
        if link_of(application).protocol is None:
            return None
        if status.link is None or status.address is None:
            return "the cloud's end of the link says nothing yet"
        if status.link not in joined:
            files = link.join(application, layout, status.address, status.link)
            report(f"link: where this is not the robot, copy these to it: {', '.join(map(str, files))}")
            if (how := link_of(application).opening(application, machine.machine.infra, status.address)) is not None:
                report(f"link: {how}")
            joined.add(status.link)
        return link.link_error(application, layout)

    return check


def apply(
    plan: LaunchPlan,
    backend_for: Backends,
    times: WallClock,
    report: Callable[[str], None],
    confirm: Callable[[], None],
    applied: Callable[[DeploymentState], Applied | None],
    ends: str | None = None,
    admit: Callable[[DeploymentState], None] = lambda _live: None,
    verb: str = "apply",
) -> RolloutResult:
    """Make the deployment what the manifest asks for; `confirm` is called before money is spent, and may raise.

    `ends` is the date at which it ends by itself, in place of what `spec.deployment.until` says from now on. `applied` returns
    the record of this apply, and `admit` is given the state before `confirm`; both may raise as well. `verb` is for messages
    and the history.

    Raise CloudError, InvalidInput or Interrupted as `Rollout.run` does, Refused while another apply, bench or down runs,
    if the live state names a machine of another application, or if a machine serves that this directory does not know,
    UsageError for a secret that is not in the environment.
    """
    layout = plan.opened.layout
    names = plan.opened.loaded.application.spec.secrets
    begun_s = times.now_s()
    live: DeploymentState | None = None
    try:
        what = f"{verb} of {layout.name}"
        with interruptible() as interrupt, holding(layout, what, times, report) as record:
            live = DeploymentState.read(layout, times, record)
            live.verb = verb
            live.check_owned()
            now = applied(live)
            rollout = Rollout(
                live=live,
                manifest=plan.content,
                digest=plan.opened.digest,
                candidates=plan.candidates,
                image=plan.image,
                files=plan.files,
                ready_timeout_s=plan.opened.manifest.spec.ready_timeout,
                backend_of=cache(backend_for),
                report=report,
                stopping=lambda: interrupt.asked,
                link_check=link_check(plan, report),
                send=lambda target: snapshot(plan.opened.loaded.application, layout, target, plan.files),
                end=End.of(plan.opened.manifest.spec),
                ends=ends,
                applied=now,
            )
            if (served := rollout.current()) is not None:
                if now is not None and now.commit not in (None, served.applied and served.applied.commit):
                    live.put(served := served.model_copy(update={"applied": now}))
                return RolloutResult(served, rollout.stop_others([served.name]), times.now_s() - begun_s)
            if (adopted := rollout.adopt()) is not None:
                rollout.stop_others([adopted.name])
                return RolloutResult(adopted, True, times.now_s() - begun_s, kept=True)
            check_set(names)
            if unknown := rollout.unknown_machines():
                raise Refused(
                    f"{layout.name} runs already, started from another folder or by an apply whose live state is lost",
                    *unknown,
                    f"fogspec apply {layout.name} --adopt takes it over, fogspec down {layout.name} ends it",
                )
            for machine in (one for one in live.machines if one.state == "serving"):
                old = f"{machine.machine.instance} in {machine.machine.infra}"
                report(f"  replaces  {machine.name}: {old}, which ends when the new one answers")
            first = plan.candidates[0].machine.infra
            rollout.backend_of(first).check_access([first])
            admit(live)
            with interrupt.question():
                confirm()
            return RolloutResult(rollout.run(), True, times.now_s() - begun_s)
    except KeyboardInterrupt:
        again = (
            f"{shell_command('fogspec', 'apply', layout.manifest)} resumes, fogspec down {layout.name} tears it down"
        )
        started = [one.name for one in live.machines if one.state != "serving"] if live is not None else []
        raise Interrupted("interrupted at once", *map("may still run: {}".format, started), again) from None
    except (BrokenPipeError, FogspecError):
        raise
    except OSError as problem:
        raise InvalidInput(
            f"{problem.filename or layout.state}: {problem.strerror or problem}",
            f"{shell_command('fogspec', 'apply', layout.manifest)} resumes, fogspec down {layout.name} tears everything down",
        ) from None
