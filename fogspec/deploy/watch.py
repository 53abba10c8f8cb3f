"""Keep deployments serving: see what does not, and start a machine in its place, within what was approved.

Each round looks at every application once. It starts a machine only in place of one that certainly does not serve, only by
the manifest that this one was started for, at its approved price, and only so often in an hour. Where a machine cannot be
reached, nothing is started: two machines would cost twice (ADR 0080). Drift and other manifests are reported.
"""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Any

from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import Busy, CloudError, FogspecError, Interrupted, OutOfDate, Refused
from fogspec.base.layout import Layout
from fogspec.base.text import count, shell_command
from fogspec.base.units import shown_duration
from fogspec.catalog.table import Catalog
from fogspec.compile.bundle import ManifestBundle, open_bundle
from fogspec.deploy.apply import Backends, apply, stop_machine
from fogspec.deploy.events import HOUR_S, RESTART, Events
from fogspec.deploy.health import HealthReport, health_report
from fogspec.deploy.lifetime import ended
from fogspec.deploy.metrics import metrics_text
from fogspec.deploy.preflight import check_fresh, launch_plan
from fogspec.deploy.schema import DeployedMachine
from fogspec.deploy.shared_state import holding
from fogspec.deploy.state import DeploymentState, WallClock
from fogspec.language.schema import Application

FIRST_WAIT_S, LONGEST_WAIT_S = 10.0, 300.0


class Action(Enum):
    """What an application needs."""

    NOTHING = auto()
    RESTART = auto()  # nothing serves, and something should
    FINISH = auto()  # machines are left that should not be there


class Settled(Refused):
    """What needed a machine does not need it any more."""


@dataclass(slots=True, kw_only=True)
class Watched:
    """One application that is watched; `report` is None where nothing runs, `problem` why it cannot be looked at."""

    application: Application
    layout: Layout
    events: Events
    report: HealthReport | None = None
    problem: str | None = None
    said: dict[str, str] = field(default_factory=dict)

    @property
    def serves(self) -> bool:
        """Whether its nodes answer, or nothing is meant to run."""
        if self.problem is not None:
            return False
        return self.report is None or (
            self.report.serving is not None and self.report.live is not None and self.report.live.state == "ready"
        )


def action_of(report: HealthReport, machine_ended: bool) -> Action:
    """Return what is to be done; `machine_ended` tells that the machine came to the end that it was given."""
    live, serving = report.live, report.serving
    if all(one.state == "ending" for one in report.machines):
        return Action.FINISH
    if live is None:
        return Action.NOTHING
    if serving is None:
        return Action.RESTART  # an apply was killed before the nodes answered
    if live.state in ("gone", "ended"):
        return Action.FINISH if machine_ended else Action.RESTART
    return Action.FINISH if len(report.machines) > 1 else Action.NOTHING


def wait_s(ages_s: Sequence[float]) -> float:
    """Return how long the next restart waits after those of the last hour: twice as long after each, from `FIRST_WAIT_S`."""
    if not ages_s:
        return 0.0
    between_s: float = min(FIRST_WAIT_S * 2 ** (len(ages_s) - 1), LONGEST_WAIT_S)
    return max(0.0, between_s - ages_s[-1])


@dataclass(slots=True, kw_only=True)
class Watcher:
    """Looks at applications and restarts them; `tell` takes each event, `prices` the catalog of prices now, if one is named."""

    times: WallClock
    backend_for: Backends
    restarts_per_hour: int
    tell: Callable[[Mapping[str, Any]], None]
    prices: Callable[[ManifestBundle], Catalog] | None = None
    watched: dict[str, Watched] = field(default_factory=dict)

    def take(self, found: Mapping[str, tuple[Application, Layout]]) -> None:
        """Watch these applications, by name, and no others."""
        for name, (application, layout) in found.items():
            if name in self.watched:
                self.watched[name].application, self.watched[name].layout = application, layout
            else:
                events = Events(layout, self.times)
                self.watched[name] = Watched(application=application, layout=layout, events=events)
        for name in [name for name in self.watched if name not in found]:
            del self.watched[name]

    def round(self, stopping: Callable[[], bool] = lambda: False) -> None:
        """Look at every application, and act where that is needed; raise Interrupted after Ctrl-C in a restart."""
        for one in list(self.watched.values()):
            if stopping():
                return
            self._look(one)
            if one.report is not None:
                self._act(one, one.report)

    def write_metrics(self) -> None:
        """Write what was seen last as metrics, below each root; raise InvalidInput if a file cannot be written."""
        restarts, now = dict[str, int](), self.times.date().timestamp()
        for name, one in self.watched.items():
            with contextlib.suppress(FogspecError):
                restarts[name] = one.events.restarts()
        for layout in {one.layout.root: one.layout for one in self.watched.values()}.values():
            below = {name: one for name, one in self.watched.items() if one.layout.root == layout.root}
            known = {name: one.report for name, one in below.items() if one.report or one.problem is None}
            text = metrics_text(known, {name: restarts[name] for name in below if name in restarts}, now)
            layout.files.write(layout.metrics, text.encode())

    def _look(self, one: Watched) -> None:
        one.report, one.problem = None, None
        try:
            look = DeploymentState.look(one.layout, self.times)
            serving = [machine for machine in look.machines if machine.state == "serving"]
            sent = next((machine.files for machine in (*serving, *reversed(look.machines))), None)
            one.report = health_report(one.application, one.layout, sent or {}, True, self.times, self.backend_for)
        except DiagnosticError as wrong:
            self._problem(one, f"{one.layout.live}: {wrong.diagnostics[0].message}")
            return
        except (FogspecError, OSError) as wrong:
            self._problem(one, str(wrong))
            return
        self._clear(one, "problem")
        if one.report is None:
            if one.said.pop("health", None) is not None:
                self.tell({"application": one.layout.name, "event": "Missing", "text": "nothing runs"})
            return
        if one.report.health == "NotJudged" and one.report.sync == "Synced":  # no news; another manifest is
            one.said.pop("health", None)
            return
        reasons = "; ".join(one.report.reasons)
        subject = _subject(one.report)
        self._say(
            one, "health", one.report.health, f"{one.report.sync}{f': {reasons}' if reasons else ''}", subject.name
        )

    def _act(self, one: Watched, report: HealthReport) -> None:
        subject = _subject(report)
        over = ended(subject.ends, self.times.date())
        action = action_of(report, over)
        try:
            if action is Action.FINISH:
                self._finish(one, over)
            elif action is Action.RESTART and self.restarts_per_hour:
                self._restart(one, subject, report)
            elif action is Action.NOTHING:
                self._clear(one, "problem")
        except (Busy, Settled) as busy:
            self._say(one, "busy", "waiting", busy.message)
        except Interrupted:
            raise
        except DiagnosticError as wrong:
            self._problem(one, wrong.diagnostics[0].message)
        except FogspecError as wrong:
            self._problem(one, "; ".join(dict.fromkeys([wrong.message, *wrong.hints[:1], *wrong.hints[-1:]])))
        except OSError as wrong:
            self._problem(one, str(wrong))

    def _restart(self, one: Watched, subject: DeployedMachine, report: HealthReport) -> None:
        """Start a machine in place of one that does not serve; raise why that may not be."""
        self._check_rate(one)
        layout, name = one.layout, one.layout.name
        opened = open_bundle(layout.manifest, layout.spec)
        if opened.digest != subject.manifest:
            raise OutOfDate(
                f"{name}: does not serve, and another manifest is committed than the one that ran",
                f"whether that one is to run is yours to say: {shell_command('fogspec', 'apply', layout.manifest)}",
            )
        check_fresh(opened)
        image = subject.image
        plan = launch_plan(
            opened,
            self.prices(opened) if self.prices else opened.inputs.catalog,
            None,
            image is not None,
            lambda _tag: str(image).rpartition("@")[2],
        )
        why = "; ".join(report.reasons) or report.health

        def admit(live: DeploymentState) -> None:
            if subject.name not in [machine.name for machine in live.machines]:
                raise Settled(f"{name}: {subject.name} was ended meanwhile")
            self._check_rate(one)
            self._tell(one, RESTART, why, subject.name)

        served = apply(
            plan,
            self.backend_for,
            self.times,
            lambda text: self._progress(one, text),
            lambda: None,
            lambda _live: subject.applied,
            subject.ends,
            admit,
            "watch",
        )
        self._clear(one, "problem")
        if served.changed and not served.kept:
            machine, waited = served.machine, shown_duration(served.waited_s)
            self._tell(
                one, "serves", f"{machine.machine.instance} in {machine.machine.infra}, after {waited}", machine.name
            )
        self._look(one)

    def _check_rate(self, one: Watched) -> None:
        """Raise Refused if there were too many restarts in the last hour, Busy until the next one is due."""
        ages_s = one.events.ages_s()
        if len(ages_s) >= self.restarts_per_hour:
            after = shown_duration(HOUR_S - ages_s[-self.restarts_per_hour])
            raise Refused(
                f"{one.layout.name}: does not serve, and was restarted {count(len(ages_s), 'time')} in the last hour",
                f"{shell_command('fogspec', 'logs', one.layout.name)} says why its nodes end; the next is due in {after}",
            )
        if (seconds := wait_s(ages_s)) > 0:
            raise Settled(f"{one.layout.name}: the next restart waits {shown_duration(seconds)}")

    def _finish(self, one: Watched, over: bool) -> None:
        """End the machines that should not be there: all but the one that serves, which goes too if its end has come."""
        layout = one.layout
        what = f"watch of {layout.name}"

        def report(text: str) -> None:
            self._progress(one, text)

        with holding(layout, what, self.times, report) as record:
            live = DeploymentState.read(layout, self.times, record)
            live.verb = "watch"
            live.check_owned()
            serving = None if over else next((m for m in live.machines if m.state == "serving"), None)
            if serving is None and not over and any(machine.state == "starting" for machine in live.machines):
                return
            for machine in [m for m in live.machines if m is not serving]:
                stop_machine(live, machine, self.backend_for(machine.machine.infra), lambda _text: None)
                self._tell(one, "ended", "its time is over" if over else f"it was {machine.state}", machine.name)
        self._look(one)

    def _progress(self, one: Watched, text: str) -> None:
        self.tell({"application": one.layout.name, "event": "progress", "text": text})

    def _problem(self, one: Watched, text: str) -> None:
        one.problem = text
        self._say(one, "problem", "problem", text)

    def _clear(self, one: Watched, topic: str) -> None:
        one.problem = None
        one.said.pop(topic, None)

    def _say(self, one: Watched, topic: str, event: str, text: str, machine: str | None = None) -> None:
        """Tell an event of a topic that was not the last one of it; figures in its text alone make no new one."""
        now = f"{event} {''.join(c for c in text if not c.isdigit())}"
        if one.said.get(topic) != now:
            one.said[topic] = now
            self._tell(one, event, text, machine)

    def _tell(self, one: Watched, event: str, text: str, machine: str | None = None) -> None:
        """Keep an event and tell it. One that cannot be kept is reported; a restart that cannot be kept is not made."""
        try:
            found = one.events.add(event, text, machine)
        except FogspecError as problem:
            if event == RESTART:
                raise
            found = {
                "application": one.layout.name,
                "event": event,
                "machine": machine,
                "text": f"{text}; {problem.message}",
            }
        self.tell(found)


def _subject(report: HealthReport) -> DeployedMachine:
    """Return the machine that serves, or else the one that is being started."""
    begun = [one for one in report.machines if one.state == "starting"]
    return report.serving or [*report.machines, *begun][-1]


def check_serving(watched: Sequence[Watched]) -> None:
    """Raise CloudError if something that should serve does not."""
    found = [one for one in watched if not one.serves]
    if found:
        why = [f"{one.layout.name}: {one.problem or (one.report and one.report.health)}" for one in found]
        raise CloudError(f"not everything serves: {', '.join(one.layout.name for one in found)}", *why)
