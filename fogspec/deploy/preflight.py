"""Checks before a launch: the manifest is fresh, unedited and not older than what runs, prices hold, images are pinned."""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fogspec.backends.protocol import Work
from fogspec.backends.skypilot.handed_over import handed_over
from fogspec.base import digest, units
from fogspec.base.clouds import LOCAL
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import OutOfDate, Refused, UsageError
from fogspec.base.git import git
from fogspec.base.repository import committed, head_of, top_of
from fogspec.base.text import shell_command
from fogspec.catalog.filters import price_now
from fogspec.catalog.table import Catalog
from fogspec.check.audit import look
from fogspec.compile.bundle import ManifestBundle
from fogspec.compile.manifest import Fallback, Pinned, given
from fogspec.compile.tasks import deploy_work
from fogspec.deploy import link
from fogspec.deploy.candidates import Candidate, affordable, check_price, cost_words, exact
from fogspec.deploy.lifetime import End
from fogspec.deploy.schema import Applied
from fogspec.deploy.shared_state import store_of
from fogspec.deploy.state import DeploymentState
from fogspec.language.warned import sentence
from fogspec.plan.schema import TaskRef


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
    look(opened.inputs).require(f"{opened.layout.manifest}: is stale or was edited, so nothing was started")


def applied(opened: ManifestBundle, live: DeploymentState, older: bool) -> Applied:
    """Return the record of an apply from this checkout; a folder without git is not checked.

    Raise Refused for a commit that is, or may be, older than the one that runs, unless `older` accepts it; in CI and where
    clones share the state also for a manifest of rented machines that is not HEAD's: it pins everything else.
    """
    layout, spec, head = opened.layout, opened.manifest.spec, None
    if top_of(layout.root) is not None:
        shared = os.environ.get("CI", "").lower() not in ("", "0", "false") or store_of(layout) is not None
        rented = any(one.machine.infra != LOCAL for one in (spec, *spec.fallbacks))
        if shared and rented and committed(layout.root, layout.manifest) != opened.content:
            fix = f"commit it: {shell_command('git', 'add', layout.compiled)} && git commit"
            raise Refused(f"{layout.manifest}: is not what HEAD has, so nothing was started", fix)
        head = head_of(layout.root)
        if not older:
            _check_order(live, head or "HEAD")
    return live.applied(head)


def _check_order(live: DeploymentState, head: str) -> None:
    name, root = live.layout.name, live.layout.root
    machines = sorted(live.machines, key=lambda one: one.state != "serving")
    last = next((one.applied for one in machines if one.state != "ending"), None)
    if last is None or last.commit in (None, head):
        return
    base = _git(root, "merge-base", head, str(last.commit))
    shallow = _git(root, "rev-parse", "--is-shallow-repository") == "true"
    if base == last.commit or (base not in (None, head) and not shallow):
        return
    # The clone of a late job often lacks the newer commit, or what lies between: then this cannot be told.
    fetch = "git fetch --unshallow (in CI: fetch-depth: 0)" if shallow else "git fetch"
    raise Refused(
        f"{name}: commit {head[:12]} {'is' if base == head else 'may be'} older than the one that runs: {last.text}",
        f"{'git pull' if base == head else fetch}, then run it again",
        f"or accept the older one: {shell_command('fogspec', 'apply', name, '--older')}",
    )


def _git(root: Path, *words: str) -> str | None:
    try:
        return git(*words, folder=os.path.realpath(root)).decode("utf-8", "replace").strip() or None
    except UsageError:
        return None


def launch_plan(
    opened: ManifestBundle, prices: Catalog, most_usd_per_hour: float | None, resolve: bool, ask: Callable[[str], str]
) -> LaunchPlan:
    """Return the candidates at their prices now; fallbacks that became too expensive are left out.

    Raise DiagnosticError if a file to send is missing or not sent, Refused if the chosen machine
    costs more than is allowed, or for an image that is not pinned.
    """
    if absent := opened.loaded.absent(measured=False):
        raise DiagnosticError(absent)
    spec, limit = opened.manifest.spec, opened.loaded.application.spec.constraints.price
    peer = link.environment(opened.loaded.application, opened.layout)
    work = _work(opened, peer)
    reviewed: list[Pinned | Fallback] = [spec, *spec.fallbacks]
    found: list[Candidate] = []
    image, pins = None, opened.manifest.pins.model_dump(mode="json")
    end = spec.model_dump(mode="json", include={"until", "budget"})
    for number, listed in enumerate(reviewed):
        machine = listed.machine
        content = read_task(opened, listed.task if isinstance(listed, Fallback) else opened.manifest.pins.task)
        task, exactly = exact({**content, **_peer(content, peer)}, machine.infra, spec.image, resolve, ask)
        image = exactly if number == 0 else image
        task = allowed(task, most_usd_per_hour)
        runs = digest.of_value(given(task, {**end, **machine.model_dump(mode="json")}, pins))
        candidate = Candidate(
            number=number,
            machine=machine,
            work=work,
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
    return LaunchPlan(opened, opened.content, tuple(found), image, opened.inputs.sent)


def allowed(task: Mapping[str, Any], most_usd_per_hour: float | None) -> Mapping[str, Any]:
    """Return the task with the price that the caller allows in place of the approved one; SkyPilot's side checks it too."""
    if most_usd_per_hour is None or "max_hourly_cost" not in task["resources"]:
        return task
    return {**task, "resources": {**task["resources"], "max_hourly_cost": most_usd_per_hour}}


def _work(opened: ManifestBundle, peer: Mapping[str, str]) -> Work:
    """Return what every candidate runs, with the digests in the manifest and the public half of the robot's end."""
    layout = opened.layout
    pinned = {layout.relative(opened.path(one)): one.digest for one in opened.manifest.pins.files}
    work = deploy_work(opened.loaded.application, layout, pinned)
    return replace(work, envs={**work.envs, **peer})


def _peer(task: Mapping[str, Any], peer: Mapping[str, str]) -> dict[str, Any]:
    """Return the environment with the public half of the robot's end of the link, which is known only at launch."""
    return {"envs": {**task.get("envs", {}), **peer}} if peer else {}


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
    spec, latency, task = manifest.spec, manifest.expected.latency, manifest.pins.task
    limit = "" if latency.limit_on_machine is None else f", limit {units.shown_duration(latency.limit_on_machine)}"
    gpu = f", {spec.gpu.label}" if spec.gpu else ""
    lines = [
        f"{manifest.metadata.name}: {spec.instance} in {spec.infra}{' spot' if spec.spot else ''} "
        f"({spec.cpus:g} vCPU{'' if spec.cpus == 1 else 's'}, {units.shown(spec.memory)} GiB{gpu})",
        f"  nodes     {len(spec.cloud)} in the cloud, {len(spec.robot)} on the robot; link {spec.connectivity.link}",
        f"  task      {plan.opened.layout.compiled / task.path}  {task.digest}",
        f"  costs     {cost_words(first)}",
        f"  expected  {latency.statistic} latency {units.shown_duration(latency.predicted)}"
        f"{units.shown_interval(latency.interval)}{limit}; {units.shown_cost(manifest.expected.cost.predicted)}",
    ]
    if end := End.of(spec):
        lines.append(f"  ends      {end.text(spec.infra)}")
    if manifest.partial is not None:
        lines.append(f"  partial   {sentence(manifest.partial)}")
    if plan.image is not None:
        lines.append(f"  image     {plan.image}")
    lines += [
        f"  or else   {one.machine.instance} in {one.machine.infra}: {cost_words(one)}" for one in plan.candidates[1:]
    ]
    given = handed_over(one.machine.infra for one in plan.candidates)
    return lines + [f"  {'gets' if n == 0 else '':<9} {text}" for n, text in enumerate(given)]
