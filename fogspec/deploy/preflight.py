"""Checks before a launch: the manifest is fresh and unedited, its prices still hold, its image is pinned."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from fogspec.audit.verify import remedy, verify
from fogspec.base import digest, units
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import OutOfDate
from fogspec.catalog.filters import price_now
from fogspec.catalog.machine import Machine
from fogspec.catalog.table import Catalog
from fogspec.compile.bundle import ManifestBundle
from fogspec.compile.manifest import Fallback, Pinned
from fogspec.deploy import link
from fogspec.deploy.candidates import Candidate, affordable, check_price, exact, price_words
from fogspec.deploy.lifetime import End
from fogspec.plan.schema import TaskRef
from fogspec.results.progress import state_text
from fogspec.spec.lock_io import check_sent


@dataclass(frozen=True, slots=True)
class LaunchPlan:
    """The approved launch: the machine and its fallbacks, with the image that they run.

    `files` are the current digests of the files of the spec's directory that are sent along.
    """

    opened: ManifestBundle
    content: bytes
    candidates: tuple[Candidate, ...]
    image: str | None
    files: Mapping[str, str]


def check_fresh(opened: ManifestBundle) -> None:
    """Raise OutOfDate for a manifest that was edited or no longer follows from its inputs, with the reasons."""
    if broken := [link for link in verify(opened) if link.breaks]:
        raise OutOfDate(
            f"{opened.layout.manifest}: is stale or was edited, so nothing was started",
            *(f"{link.name}: {text}" for link in broken for text in link.breaks[:3]),
            remedy(opened, broken[0]),
        )


def launch_plan(
    opened: ManifestBundle, prices: Catalog, most_usd_per_hour: float | None, resolve: bool, ask: Callable[[str], str]
) -> LaunchPlan:
    """Return the candidates at their prices now; fallbacks that became too expensive are left out.

    Raise DiagnosticError if a file to send is missing, InvalidInput if one is not sent, Refused if the chosen machine
    costs more than is allowed, or for an image that is not pinned.
    """
    if absent := opened.loaded.absent(measured=False):
        raise DiagnosticError(absent)
    check_sent(opened.loaded.application, opened.layout, measured=False)
    spec, limit = opened.manifest.spec, opened.loaded.application.spec.constraints.price
    peer = link.environment(opened.loaded.application, opened.layout)
    reviewed: list[Pinned | Fallback] = [spec, *spec.fallbacks]
    found: list[Candidate] = []
    image, files = None, opened.inputs.sent
    for number, listed in enumerate(reviewed):
        machine = listed.machine
        content = read_task(opened, listed.task)
        task, exactly = exact({**content, **_peer(content, peer)}, machine.infra, spec.image, resolve, ask)
        image = exactly if number == 0 else image
        task = allowed(task, most_usd_per_hour)
        runs = runs_digest(task, machine, opened, files)
        candidate = Candidate(
            number=number,
            machine=machine,
            task=task,
            runs=runs,
            approved_usd_per_hour=machine.price,
            now_usd_per_hour=price_now(machine, prices),
            cap_usd_per_hour=machine.price if most_usd_per_hour is None else most_usd_per_hour,
        )
        if number == 0:
            check_price(candidate, limit, most_usd_per_hour, prices.about.source)
        elif not affordable(candidate, limit, most_usd_per_hour):
            continue
        found.append(candidate)
    return LaunchPlan(opened, opened.content, tuple(found), image, files)


def allowed(task: Mapping[str, Any], most_usd_per_hour: float | None) -> Mapping[str, Any]:
    """Return the task with the price that the caller allows in place of the approved one; SkyPilot's side checks it too."""
    if most_usd_per_hour is None or "max_hourly_cost" not in task["resources"]:
        return task
    return {**task, "resources": {**task["resources"], "max_hourly_cost": most_usd_per_hour}}


def _peer(task: Mapping[str, Any], peer: Mapping[str, str]) -> dict[str, Any]:
    """Return the environment with the public half of the robot's end of the link, which is known only at launch."""
    return {"envs": {**task.get("envs", {}), **peer}} if peer else {}


def runs_digest(task: Mapping[str, Any], machine: Machine, opened: ManifestBundle, files: Mapping[str, str]) -> str:
    """Return the digest of everything that the machine is given: a new price or expectation needs no other machine."""
    resources = {key: value for key, value in task["resources"].items() if key != "max_hourly_cost"}
    sent = {one.path: one.digest for one in opened.manifest.spec.files if one.path != opened.layout.robot.name}
    end = opened.manifest.spec.model_dump(mode="json", include={"until", "max_spend"})
    given = [{**task, "resources": resources}, machine.infra, machine.instance, machine.spot, sent, files]
    return digest.of_value([*given, end] if end else given)


def read_task(opened: ManifestBundle, reference: TaskRef) -> dict[str, Any]:
    """Return the parsed task; raise OutOfDate if it is not the reviewed one."""
    from ruamel.yaml import YAML

    path, file = opened.layout.compiled / reference.path, opened.file(reference)
    if file.problem is not None:
        raise OutOfDate(f"{path}: cannot be read: {file.problem.strerror}")
    if digest.of_bytes(file.content) != reference.digest:
        raise OutOfDate(f"{path} is not what the manifest says: what is reviewed is what runs")
    task: dict[str, Any] = YAML(typ="safe", pure=True).load(file.content)
    return task


def as_text(plan: LaunchPlan) -> list[str]:
    """Return the lines that describe the launch and its cost."""
    manifest, first = plan.opened.manifest, plan.candidates[0]
    spec, latency = manifest.spec, manifest.expected.latency
    limit = "" if latency.limit is None else f", limit {units.shown_duration(latency.limit)}"
    gpu = f", {spec.gpu.label}" if spec.gpu else ""
    lines = [
        f"{manifest.metadata.name}: {spec.instance} in {spec.infra}{' spot' if spec.spot else ''} "
        f"({spec.cpus:g} vCPU{'' if spec.cpus == 1 else 's'}, {units.shown(spec.memory)} GiB{gpu})",
        f"  nodes     {len(spec.cloud)} in the cloud, {len(spec.robot)} on the robot; link {spec.connectivity.link}",
        f"  task      {plan.opened.layout.compiled / spec.task.path}  {spec.task.digest}",
        f"  costs     {price_words(first.price_usd_per_hour)}",
        f"  expected  {latency.statistic} latency {units.shown_duration(latency.predicted)}"
        f"{units.shown_interval(latency.interval)}{limit}; {units.shown_cost(manifest.expected.cost.predicted)}",
    ]
    if end := End.of(spec):
        lines.append(f"  ends      {end.text(spec.infra)}")
    if (partial := manifest.provenance.partial) is not None:
        lines.append(f"  partial   {state_text(partial.measured, partial.planned)}")
    if plan.image is not None:
        lines.append(f"  image     {plan.image}")
    lines += [
        f"  or else   {one.machine.instance} in {one.machine.infra}: {price_words(one.price_usd_per_hour)}"
        for one in plan.candidates[1:]
    ]
    return lines
