"""Applying a manifest from start to end: locked, on disk before it costs anything, interruptible."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

from fogspec.backends.protocol import DeploymentBackend, DeploymentStatus
from fogspec.base.errors import FogspecError, Interrupted, InvalidInput, Refused
from fogspec.base.locks import application_lock
from fogspec.base.redaction import check_set
from fogspec.base.signals import interruptible
from fogspec.compile.links import link_of
from fogspec.deploy import link
from fogspec.deploy.apply import Rollout
from fogspec.deploy.preflight import LaunchPlan
from fogspec.deploy.redacted import redacting
from fogspec.deploy.schema import DeployedMachine
from fogspec.deploy.state import DeploymentState, WallClock


@dataclass(frozen=True, slots=True)
class RolloutResult:
    """What serves now, and whether anything was changed for it; `kept` says that the machine is the same as before."""

    machine: DeployedMachine
    changed: bool
    waited_s: float
    kept: bool = False


def link_check(
    ordered: LaunchPlan, tell: Callable[[str], None]
) -> Callable[[DeployedMachine, DeploymentStatus], str | None]:
    """Hands the cloud's public half and address to the robot's end, and says why the link does not answer yet."""
    application, layout = ordered.opened.loaded.application, ordered.opened.layout
    joined: set[str] = set()

    def linked(machine: DeployedMachine, live: DeploymentStatus) -> str | None:
        if link_of(application).protocol is None:
            return None
        if live.link is None or live.address is None:
            return "the cloud's end of the link says nothing yet"
        if live.link not in joined:
            files = link.join(application, layout, live.address, live.link)
            tell(f"link: where this is not the robot, copy these to it: {', '.join(map(str, files))}")
            if (how := link_of(application).opening(application, machine.machine.infra, live.address)) is not None:
                tell(f"link: {how}")
            joined.add(live.link)
        return link.link_error(application, layout)

    return linked


def apply(
    ordered: LaunchPlan, backend_for: Callable[[str], DeploymentBackend], times: WallClock, tell: Callable[[str], None],
    confirm: Callable[[], None],
) -> RolloutResult:  # fmt: skip
    """Bring what runs to what the manifest says; `confirm` is called before money is spent, and may raise.

    Raises CloudError, InvalidInput or Interrupted as `Rollout.run` does, Refused while another apply, bench or down runs
    or where a machine serves that this folder does not know, UsageError for a secret that is not in the environment.
    """
    layout = ordered.opened.layout
    begun = times.now_s()
    names = ordered.opened.loaded.application.spec.secrets
    backend_of = cache(redacting(backend_for, names))
    live: DeploymentState | None = None
    try:
        with application_lock(layout.state / "lock", f"apply of {layout.name}"), interruptible() as interrupt:
            live = DeploymentState.read(layout, times)
            work = Rollout(
                live, ordered.content, ordered.opened.digest, ordered.candidates, ordered.image, ordered.files,
                ordered.opened.manifest.spec.ready_timeout, backend_of, tell, lambda: interrupt.asked,
                link_check(ordered, tell),
            )  # fmt: skip
            served = work.current()
            if served is not None:
                return RolloutResult(served, work.tidy([served.name]), times.now_s() - begun)
            if (stays := work.kept()) is not None:
                work.tidy([stays.name])
                return RolloutResult(stays, True, times.now_s() - begun, kept=True)
            check_set(names)
            if strangers := work.strangers():
                raise Refused(
                    f"{layout.name} runs already, started from another folder or by an apply whose live state is lost",
                    *strangers, f"fogspec down {layout.name} ends it",
                )  # fmt: skip
            for machine in (one for one in live.machines if one.state == "serving"):
                what = f"{machine.machine.instance} in {machine.machine.infra}"
                tell(f"  replaces  {machine.name}: {what}, which ends when the new one answers")
            with interrupt.question():
                confirm()
            return RolloutResult(work.run(), True, times.now_s() - begun)
    except KeyboardInterrupt:
        again = f"fogspec apply {layout.manifest} goes on, fogspec down {layout.name} ends everything"
        begun_now = [one.name for one in live.machines if one.state != "serving"] if live is not None else []
        raise Interrupted("interrupted at once", *map("may still run: {}".format, begun_now), again) from None
    except (BrokenPipeError, FogspecError):
        raise
    except OSError as problem:
        raise InvalidInput(
            f"{problem.filename or layout.state}: {problem.strerror or problem}",
            f"fogspec apply {layout.manifest} goes on, fogspec down {layout.name} ends everything",
        ) from None
