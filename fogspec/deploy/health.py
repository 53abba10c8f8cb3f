"""Health of a deployment: sync (does it match the manifest) and health (do its nodes behave as predicted)."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

from fogspec.backends.protocol import DeploymentBackend, DeploymentStatus, LaunchRefused, Unreachable
from fogspec.base import digest, units
from fogspec.base.console import is_verbose
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import FogspecError
from fogspec.base.layout import MOST_BYTES, Layout
from fogspec.base.quantities import as_numbers
from fogspec.base.redaction import redacted
from fogspec.base.text import count
from fogspec.base.units import dollars
from fogspec.check.compare import Change, compared
from fogspec.compile.manifest import Manifest
from fogspec.deploy.drift import Observed, needed, observe, unclear_text, violation_text
from fogspec.deploy.packages import packages_differ, packages_text
from fogspec.deploy.schema import DeployedMachine
from fogspec.deploy.state import DeploymentState, WallClock
from fogspec.language.loader import SourceFile, read_plain
from fogspec.language.lockfile import differing
from fogspec.language.schema import Application
from fogspec.results.io import read_results
from fogspec.review.deployed import Deployed

Sync = Literal["Synced", "OutOfSync"]
Health = Literal["Healthy", "NotJudged", "Drifted", "Degraded", "Progressing", "Missing", "Unknown"]


@dataclass(frozen=True, slots=True, kw_only=True)
class HealthReport:
    """The deployment of one application: sync, health, reasons and figures; `machines` are all that may cost money.

    `packages` are all differences between the machine that was measured and the one that serves.
    """

    sync: Sync
    health: Health
    reasons: tuple[str, ...]
    changes: tuple[Change, ...]
    machines: tuple[DeployedMachine, ...]
    serving: DeployedMachine | None
    live: DeploymentStatus | None
    observed: Observed | None
    manifest: Manifest | None
    spent_usd: float
    up_s: float | None
    packages: tuple[str, ...] = ()


def health_report(
    application: Application,
    layout: Layout,
    sent: Mapping[str, str],
    fresh: bool,
    times: WallClock,
    backend_for: Callable[[str], DeploymentBackend],
) -> HealthReport | None:
    """Return the health of the application's deployment; None if nothing was applied. Nothing is written.

    `sent` are the digests of the files that a machine would be sent now. `fresh` tells whether the manifest on disk follows
    from its inputs. Raise ForeignMachine if the live state names a machine of another application.
    """
    live_file = DeploymentState.look(layout, times)
    live_file.check_owned()
    if not live_file.machines:
        return None
    serving, subject = _subject(live_file)
    backend_of = cache(backend_for)
    live, silence = _poll(live_file, subject, backend_of)
    approved = _manifest(live_file, subject)
    files = _files_changed(sent, subject)
    differs = manifest_changes(layout, live_file, subject) + files
    reasons = [] if fresh else ["the manifest on disk is stale: fogspec diff says why"]
    reasons += (
        ["another manifest is committed than the one that runs"] if subject.manifest != _committed(layout) else []
    )
    reasons += [f"{one.field} changed since it was started" for one in files]
    reasons += _others(live_file, subject, backend_of)
    observed = None
    if live is not None and approved is not None and live.state == "ready":
        observed = observe(live.timings, application, approved.expected, subject.machine, live.clock_s)
    health, why = _health(subject, live, observed, approved, silence)
    why += _another_cpu(layout, subject, live)
    packages = packages_differ(layout, subject, live)
    why += packages_text(layout.name, packages)
    return HealthReport(
        sync="OutOfSync" if differs or not fresh or serving is None else "Synced",
        health=health,
        reasons=(*reasons, *why),
        changes=tuple(differs),
        machines=tuple(live_file.machines),
        serving=serving,
        live=live,
        observed=observed,
        manifest=approved,
        spent_usd=live_file.total_usd(),
        up_s=live_file.up_s(subject),
        packages=tuple(packages),
    )


def health_without_spec(
    layout: Layout, times: WallClock, backend_for: Callable[[str], DeploymentBackend]
) -> HealthReport | None:
    """Return the health of what runs of an application that has no spec, by its live state; None if nothing does.

    Raise ForeignMachine if the live state names a machine of another application.
    """
    live_file = DeploymentState.look(layout, times)
    live_file.check_owned()
    if not live_file.machines:
        return None
    serving, subject = _subject(live_file)
    backend_of = cache(backend_for)
    live, silence = _poll(live_file, subject, backend_of)
    health, why = _health(subject, live, None, None, silence)
    if health == "NotJudged":
        why = ["not judged without its spec"]
    return HealthReport(
        sync="OutOfSync",
        health=health,
        reasons=(*_others(live_file, subject, backend_of), *why),
        changes=(),
        machines=tuple(live_file.machines),
        serving=serving,
        live=live,
        observed=None,
        manifest=None,
        spent_usd=live_file.total_usd(),
        up_s=live_file.up_s(subject),
    )


def _subject(live: DeploymentState) -> tuple[DeployedMachine | None, DeployedMachine]:
    """Return the machine that serves, if one does, and the one that is judged."""
    serving = next((one for one in live.machines if one.state == "serving"), None)
    return serving, serving or live.machines[-1]


def _others(
    live: DeploymentState, subject: DeployedMachine, backend_of: Callable[[str], DeploymentBackend]
) -> Iterator[str]:
    """Yield a reason for each other machine of the application, also for one that its engine lists and no record has."""
    name, known = live.layout.name, {one.name for one in live.machines}
    yield from (f"{one.name} is {one.state} too" for one in live.machines if one is not subject)
    try:
        listed = backend_of(subject.machine.infra).list(live.owner, live.layout.state)
    except (Unreachable, FogspecError):
        return  # what the record has is shown without contact, too
    unknown = (one for one in listed if live.owner.has_deployment(one) and one not in known)
    yield from (
        f"{one} runs and is in no record: fogspec apply {name} --adopt takes it over, fogspec down {name} ends it"
        for one in unknown
    )


def manifest_changes(layout: Layout, live: DeploymentState, machine: DeployedMachine) -> list[Change]:
    """Return the differences between the manifest on disk and a machine's own manifest."""
    if _committed(layout) == machine.manifest:
        return []
    try:
        kept = live.manifest_of(machine.name)
        before: Any = {"digest": machine.manifest} if kept is None else read_plain(f"manifest of {machine.name}", kept)
    except (DiagnosticError, FogspecError, OSError):
        before = {"digest": machine.manifest}
    now = Deployed.at(layout)
    after = None if now is None else now.values if now.damage is None else {"damaged": now.damage}
    return compared(redacted(before), after)


def _committed(layout: Layout) -> str | None:
    """Return the digest of the manifest on disk."""
    files = layout.files
    return digest.of_bytes(files.head(layout.manifest, MOST_BYTES + 1)) if files.is_file(layout.manifest) else None


def _files_changed(sent: Mapping[str, str], machine: DeployedMachine) -> list[Change]:
    """Return the files that differ from those that the machine was sent."""
    known = sent if machine.files is None else machine.files
    return [Change(name, "as it was started", "changed since") for name in differing(known, sent)]


def running_changes(layout: Layout, times: WallClock, sent: Mapping[str, str]) -> list[Change] | None:
    """Return the differences for the machine that serves now, without polling; None if there is none."""
    live = DeploymentState.look(layout, times)
    serving = next((one for one in live.machines if one.state == "serving"), None)
    if serving is None:
        return None
    return manifest_changes(layout, live, serving) + _files_changed(sent, serving)


def _poll(
    live: DeploymentState, machine: DeployedMachine, backend_of: Callable[[str], DeploymentBackend]
) -> tuple[DeploymentStatus | None, str]:
    """Return the machine's status; None, and what is known, without contact."""
    try:
        return backend_of(machine.machine.infra).poll(live.job(machine)), ""
    except LaunchRefused as no:
        return DeploymentStatus(state="gone", detail=no.detail), ""
    except (Unreachable, FogspecError) as lost:
        return None, str(lost)


def _manifest(live: DeploymentState, machine: DeployedMachine) -> Manifest | None:
    """Return the manifest that the machine was started for."""
    try:
        kept = live.manifest_of(machine.name)
        return None if kept is None else SourceFile(f"manifest of {machine.name}", kept).document(Manifest)
    except (DiagnosticError, FogspecError, OSError):
        return None


def _health(
    machine: DeployedMachine,
    live: DeploymentStatus | None,
    observed: Observed | None,
    manifest: Manifest | None,
    silence: str,
) -> tuple[Health, list[str]]:
    if live is None:
        return "Unknown", [f"status unknown: no contact with the machine{f': {silence}' if silence else ''}"]
    if live.state == "gone":
        return "Missing", [f"its machine is gone: {live.detail}" if live.detail else "its machine is gone"]
    if live.state == "ended":
        return "Degraded", [f"the nodes do not run: {live.detail}"]
    if live.state == "starting" or machine.state != "serving":
        return "Progressing", [live.detail] if live.detail else []
    notes = [live.detail] if live.detail else []
    if observed is None or manifest is None:
        return "NotJudged", [*notes, "not judged: the manifest that it was started for cannot be read"]
    notes += [violation_text(one, observed, manifest.expected) for one in observed.violated]
    if hangs := observed.waited_s is not None:
        notes.append(f"a request has been open for {units.shown_duration(observed.waited_s)}, and none has ended since")
    drifted = observed.drift in ("slower", "faster")
    if drifted:
        notes.append(f"the model no longer holds: requests are {observed.drift} than predicted")
    if not observed.violated and not hangs and observed.interval_s is None:
        least = needed(manifest.expected.latency.statistic)
        few = f"not judged yet ({observed.requests} of {least} requests)"
        alike = f"not judged: the latency varies too slowly for an interval from {observed.requests} requests"
        return "NotJudged", [*notes, few if observed.requests < least else alike]
    if observed.violated or hangs or drifted:
        return "Degraded" if observed.violated or hangs else "Drifted", notes
    wide = [f"not judged: {unclear_text(one, observed, manifest.expected)}" for one in observed.unclear]
    return "NotJudged" if wide else "Healthy", [*notes, *wide]


def _another_cpu(layout: Layout, machine: DeployedMachine, live: DeploymentStatus | None) -> Iterator[str]:
    """Yield a reason if the machine has a CPU on which its type was not measured."""
    if live is None or live.server is None:
        return
    try:
        results = read_results(layout)
    except (DiagnosticError, FogspecError):
        return
    samples = [] if results is None else results.spec.samples
    measured = {one.server.cpu for one in samples if one.server and one.machine.type_key == machine.machine.type_key}
    if measured and live.server.cpu not in measured:
        yield f"another CPU than measured: {live.server.cpu}, and {' and '.join(sorted(measured))} was measured"


def as_text(one: HealthReport) -> list[str]:
    """Return the deployment in lines."""
    subject = one.serving or one.machines[-1]
    machine = subject.machine
    lines = [f"  {'running':<9} {one.sync}, {one.health}"]
    lines += [f"  {'':<9} {text}" for text in (*one.reasons, subject.name)]
    up = "" if one.up_s is None else f", up {units.shown_duration(round(one.up_s))}"
    lines.append(
        f"  {'':<9} {machine.instance} in {machine.infra} at {subject.address or 'no address yet'}{up}, "
        f"{machine.price_words}, {dollars(one.spent_usd)} so far"
    )
    if subject.applied is not None:
        lines.append(f"  {'':<9} {subject.applied.text}")
    if subject.ends is not None:
        over = one.live is not None and one.live.state in ("ended", "gone")
        lines.append(f"  {'':<9} {'its end was' if over else 'ends by itself at'} {subject.ends}")
    if restarted := {name: times for name, times in (one.live.restarts if one.live else {}).items() if times}:
        each = ", ".join(f"{name} {count(times, 'time')}" for name, times in restarted.items())
        lines.append(f"  {'':<9} restarted: {each}")
    if is_verbose():
        lines += [f"  {'':<9} {text}" for text in one.packages]
    if one.manifest is not None and one.observed is not None:
        lines.append(f"  {'':<9} {_observed_words(one.observed, one.manifest)}")
    return lines


def _observed_words(seen: Observed, manifest: Manifest) -> str:
    expected = manifest.expected.latency
    predicted = f"predicted {units.shown_duration(expected.predicted)}{units.shown_interval(expected.interval)}"
    if seen.value_s is None:
        return f"{predicted}; no request was observed yet"
    value = f"observed {expected.statistic} {units.shown_duration(seen.value_s)}{units.shown_interval(seen.interval_s)}"
    failed = f", {seen.failed} failed" if seen.failed else ""
    cost = "" if seen.cost_usd_per_request is None else f", {units.shown_cost(seen.cost_usd_per_request)}"
    unsaid = ", without an interval: drift cannot be seen" if expected.interval is None else ""
    return f"{value} of the latest {count(seen.requests, 'request')}{failed}{cost}; {predicted}{unsaid}"


def as_dict(one: HealthReport) -> dict[str, Any]:
    """Return the deployment as data."""
    return {
        "sync": one.sync,
        "health": one.health,
        "reasons": list(one.reasons),
        "changes": [
            {"field": change.field, "running": change.before, "manifest": change.after} for change in one.changes
        ],
        "machines": [as_numbers(machine) for machine in one.machines],
        "spent_usd": round(one.spent_usd, 6),
        "up_s": one.up_s,
        "ends": (one.serving or one.machines[-1]).ends,
        "ready_s": one.live and one.live.ready_s,
        "packages": list(one.packages),
        "restarts": {} if one.live is None else dict(one.live.restarts),
        "server": None if one.live is None or one.live.server is None else as_numbers(one.live.server),
        "predicted": None if one.manifest is None else _predicted(one.manifest),
        "observed": None if one.observed is None or one.manifest is None else _observed(one.observed, one.manifest),
    }


def _predicted(manifest: Manifest) -> dict[str, Any]:
    latency = manifest.expected.latency
    return {
        "statistic": latency.statistic,
        "latency_s": latency.predicted,
        "interval_s": latency.interval,
        "level": latency.level,
        "cost_usd_per_request": manifest.expected.cost.predicted,
    }


def _observed(seen: Observed, manifest: Manifest) -> dict[str, Any]:
    latency = seen.latency
    return {
        "requests": seen.requests,
        "failed": seen.failed,
        "latency_s": seen.value_s,
        "interval_s": seen.interval_s,
        "p50_s": latency and latency.p50,
        "p95_s": latency and latency.p95,
        "p99_s": latency and latency.p99,
        "mean_s": latency and latency.mean,
        "cost_usd_per_request": seen.cost_usd_per_request,
        "drift": seen.drift,
        "open_s": seen.waited_s,
        "breaks": [violation_text(one, seen, manifest.expected) for one in seen.violated],
    }
