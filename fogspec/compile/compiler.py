"""Compiling one application: every file that follows from its spec, the catalog and what was measured.

What compile writes is a function of these three: files that no longer follow are removed, and a check is a comparison.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import fogspec.agent
from fogspec.base import digest, units
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import Refused
from fogspec.base.files import write_bytes
from fogspec.base.layout import Layout
from fogspec.base.templates import render
from fogspec.base.units import dollars
from fogspec.base.yaml.writer import yaml_text
from fogspec.catalog.filters import Filtered, filter_offers
from fogspec.catalog.table import Catalog
from fogspec.compile.tasks import left_out, measured_processes, ros_environment, sample_task
from fogspec.plan.budget import ceil_cents, cheapest_options, estimate_cost, within_budget
from fogspec.plan.design import make_plan
from fogspec.plan.reuse import plan_from_campaign, reuse_plan
from fogspec.plan.schema import Plan, Sample, TaskRef, digest_without_budget, lifetime_s
from fogspec.plan.substitutes import substitutes
from fogspec.results.io import read_results
from fogspec.results.schema import Results, completed
from fogspec.spec import fingerprints
from fogspec.spec.loader import read_document
from fogspec.spec.lock_io import read_pins
from fogspec.spec.lockfile import pinned, pins_of_measurement
from fogspec.spec.probe import name_of, probe_parts
from fogspec.spec.schema import Application

if TYPE_CHECKING:
    from fogspec.compile.decision import Decision
    from fogspec.numerics.priors import Library

LINK_FILES = ("link.sh", "policy.xml", "cloud.json5", "robot.json5", "cloud.conf", "robot.conf",
              "cloud.fastdds.xml", "robot.fastdds.xml")  # fmt: skip
PROBE_FILES = (
    "agent.py", "counting.py", "keeper.py", "fogspec_probe.py", "fogspec_probe.hpp", "bag.py", "pairing.py", "player.py",
    "preload.c", "preload.h", "preload.py", "processes.py", "records.py", "ros.py", "secrecy.py", "topics.py",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Artifacts:
    """One application's files, by path; `removed` are files of ours that no longer follow from the inputs.

    `stale` says why there are results that do not count, `chosen` is there once there are results that do.
    """

    application: Application
    layout: Layout
    catalog: Catalog
    plan: Plan
    admissible: Filtered
    files: dict[Path, bytes]
    removed: tuple[Path, ...]
    results: Results | None = None
    stale: str | None = None
    chosen: "Decision | None" = field(default=None)

    def differing(self) -> list[Path]:
        """Files on disk that are not what compile would write, and those that should not be there."""
        changed = [path for path, content in self.files.items() if not path.is_file() or path.read_bytes() != content]
        return sorted([*changed, *self.removed])

    def write(self) -> list[Path]:
        """Write what differs, remove what no longer follows; returns what was written or removed."""
        differing = self.differing()
        for path in differing:
            if path in self.files:
                write_bytes(path, self.files[path])
            else:
                path.unlink(missing_ok=True)
        return differing


def compile_application(
    application: Application, spec_path: str | Path, catalog: Catalog, library: "Library | None" = None
) -> Artifacts:
    """Everything that follows from the inputs; `library` is the machine library, otherwise the one that is locked.

    Raises DiagnosticError or InvalidInput for a wrong file, Infeasible when no machine is admissible, Refused when the
    plan may cost more than the budget.
    """
    layout = Layout.of(spec_path, application.metadata.name)
    source = layout.relative(layout.spec)
    pins = read_pins(layout)
    exact = pinned(application, pins)
    depends = pins_of_measurement(application, pins)
    results, stale = _usable_results(application, layout, depends)
    admissible = filter_offers(catalog, application.spec.hardware, application.spec.infra)
    if library is None and (results is not None or application.spec.benchmark.sampler == "adaptive"):
        from fogspec.model.priors import locked_priors

        library = locked_priors(layout, pins)
    bare = _campaign_plan(application, source, catalog, depends, results)
    if bare is None:
        bare = _reusable_plan(application, layout, catalog, depends, results)
    if bare is None:
        bare = make_plan(application, source, catalog, pins=depends, admissible=admissible, library=library)
    check_budget(application, bare, admissible, results)
    sent = dict(_agent_files(layout))
    files = dict(sent)
    plan = with_tasks(exact, with_substitutes(exact, bare, admissible), layout, files)
    files |= substitute_tasks(exact, plan, layout, results)
    files[layout.plan] = plan_file(plan, layout)
    chosen = None
    if results is not None:
        from fogspec.compile.decision import choose_files

        plan_digest = digest_without_budget(plan)
        chosen = choose_files(exact, layout, catalog, admissible, results, plan_digest, sent, library)
        files |= chosen.files
    return Artifacts(
        exact, layout, catalog, plan, admissible, files, tuple(_leftover(layout, files)), results, stale, chosen
    )  # fmt: skip


def _campaign_plan(
    application: Application, source: str, catalog: Catalog, pins: Mapping[str, str], results: Results | None
) -> Plan | None:
    """The plan of an adaptive campaign that has begun: what was asked for is written in its results."""
    benchmark = application.spec.benchmark
    sampling = results.spec.sampling if results is not None else None
    if sampling is None or benchmark.sampler != "adaptive" or benchmark.machines:
        return None
    return plan_from_campaign(application, source, catalog, sampling, pins)


def _reusable_plan(
    application: Application, layout: Layout, catalog: Catalog, pins: Mapping[str, str], results: Results | None
) -> Plan | None:
    """The plan on disk, where all of it is measured, it still serves, and the spec's box or the prices are new."""
    if results is None or not layout.plan.is_file():
        return None
    try:
        plan = read_document(layout.plan, Plan)
    except DiagnosticError:
        return None
    body, spec = plan.spec, application.spec
    if (body.hardware, body.infra, body.design_catalog) == (spec.hardware, spec.infra, catalog.about.digest):
        return None
    if not {sample.id for sample in body.samples} <= completed(results):
        return None
    return reuse_plan(application, plan, catalog, pins)


def check_budget(application: Application, plan: Plan, admissible: Filtered, results: Results | None) -> None:
    """Raises Refused when what is still to be measured may cost more than the budget leaves."""
    body = plan.spec
    due = estimate_cost(plan, completed(results), results.spec.spent if results else 0.0)
    if within_budget(plan, due):
        return
    assert body.budget is not None
    before = f", {dollars(due.spent_usd)} of it spent already" if due.spent_usd else ""
    raise Refused(
        f"{plan.metadata.name}: the plan may cost {dollars(due.total_usd)}{before}, the budget is {dollars(body.budget)}: "
        "nothing was written",
        f"{len(due.todo)} samples to measure: measuring {dollars(due.estimate.measuring)}, "
        f"set-up {dollars(due.estimate.setup)}",
        "ways to make it fit, those that lose least first:",
        *(f"- {way.line()}" for way in cheapest_options(application, plan, due, admissible)),
        f"- raise spec.benchmark.budget to {units.format_money(ceil_cents(due.total_usd))}: loses nothing",
    )


def _agent_files(layout: Layout) -> Iterator[tuple[Path, bytes]]:
    """What is sent to a sampled machine, beside the tasks that send it."""
    folder = Path(next(iter(fogspec.agent.__path__)))
    for name in PROBE_FILES:
        yield layout.agent / name, (folder / name).read_bytes()


def with_substitutes(application: Application, plan: Plan, admissible: Filtered) -> Plan:
    """The plan, with the machines that take a sample's place where it cannot be had."""
    others = substitutes(application.spec, plan.spec.samples, admissible.offers)
    return plan.model_copy(update={"spec": plan.spec.model_copy(update={"substitutes": others})})


def substitute_tasks(
    application: Application, plan: Plan, layout: Layout, results: Results | None
) -> dict[Path, bytes]:
    """The tasks of machines that took a sample's place, by path."""
    planned = {sample.id for sample in plan.spec.samples}
    records = results.spec.samples if results is not None else []
    took = [Sample(id=one.id, machine=one.machine, reason="") for one in records if one.substitute_for in planned]
    others = (one for one in took if one.id not in planned)
    return {layout.task(one.id): task_file(application, plan, one, layout) for one in others}


def with_tasks(application: Application, plan: Plan, layout: Layout, files: dict[Path, bytes]) -> Plan:
    """The plan with a reference to each sample's task, which goes into `files`."""
    samples = []
    for sample in plan.spec.samples:
        path = layout.task(sample.id)
        files[path] = task_file(application, plan, sample, layout)
        reference = TaskRef(path=path.relative_to(layout.compiled).as_posix(), digest=digest.of_bytes(files[path]))
        samples.append(sample.model_copy(update={"task": reference}))
    said = dict.fromkeys(note for sample in samples for note in left_out(application.spec, sample.machine))
    notes = [*plan.spec.notes, *(note for note in said if note not in plan.spec.notes)]
    return plan.model_copy(update={"spec": plan.spec.model_copy(update={"samples": samples, "notes": notes})})


def plan_file(plan: Plan, layout: Layout) -> bytes:
    """What is written of a plan."""
    return _yaml(plan.model_dump(mode="json"), layout.relative(layout.spec))


def task_file(application: Application, plan: Plan, sample: Sample, layout: Layout) -> bytes:
    """What is written of a sample's task."""
    return _yaml(task_of(application, plan, sample, layout), layout.relative(layout.spec))


def task_of(application: Application, plan: Plan, sample: Sample, layout: Layout) -> dict[str, Any]:
    """The compiled task of one sample."""
    body = plan.spec
    life = lifetime_s(body.duration, body.setup_timeout)
    ros = ros_environment(application.spec)
    limits = [*_limits(application, plan), *(word for name in application.spec.secrets for word in ("--secret", name))]
    run = render(
        "run_sample.sh.j2", **ros, limits=limits, lifetime_s=life, processes=measured_processes(application.spec)
    )
    return sample_task(
        application, sample, life,
        workdir=layout.relative(layout.spec.parent), agent=layout.relative(layout.agent), setup=setup_script(ros), run=run,
    )  # fmt: skip


def setup_script(ros: dict[str, Any]) -> str | None:
    """What provisions ROS 2 and the workspace; None for plain processes."""
    return None if ros["distro"] is None else render("setup_ros2.sh.j2", **ros)


def _limits(application: Application, plan: Plan) -> list[str]:
    body, stop = plan.spec, application.spec.benchmark.stop
    words = ["--after", units.format_number(body.duration), "--warmup", str(body.warmup)]
    words += ["--startup", units.format_number(body.setup_timeout)]
    if body.requests is not None:
        words += ["--steps", str(body.requests)]
    words += ["--callback", name_of(application.spec.probe)]
    if (afterwards := probe_parts(application.spec).afterwards) is not None:
        words += ["--afterwards", json.dumps(afterwards)]
    if stop.precision is not None:
        statistic = application.spec.constraints.statistic
        words += ["--precision", units.format_number(stop.precision), "--statistic", statistic]
    return words


def _usable_results(
    application: Application, layout: Layout, pins: Mapping[str, str]
) -> tuple[Results | None, str | None]:
    """Results that measure what the spec says now, or why those on disk do not count."""
    results = read_results(layout)
    if results is None:
        return None, None
    if results.spec.application != fingerprints.measured_digest(application):
        return None, (
            f"{layout.results} measured something else: nodes, environment, probe, metrics, workload, or how it is "
            "driven has changed since"
        )
    if others := fingerprints.changed_pins(results.spec.pins, pins):
        return None, f"{layout.results} measured something else: {', '.join(others)} changed since"
    return results, None


def _leftover(layout: Layout, files: dict[Path, bytes]) -> Iterator[Path]:
    """Files in `compiled/NAME` that compile wrote once and no longer writes; what others put there stays."""
    ours = [
        layout.models,
        layout.menu,
        layout.picture,
        layout.latencies,
        layout.manifest,
        layout.deploy,
        layout.robot,
        layout.cloud,
    ]
    found = (*layout.compiled.glob("deploy.*.sky.yaml"), *layout.tasks.glob("*.sky.yaml"), *layout.agent.glob("*.*"),
             *(layout.link / name for name in LINK_FILES))  # fmt: skip
    for path in dict.fromkeys([*ours, *sorted(found)]):
        if path not in files and path.is_file():
            yield path


def _yaml(data: dict[str, Any], source: str) -> bytes:
    return yaml_text(data, f"fogspec compile {source}", source).encode()
