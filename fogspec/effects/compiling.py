"""Compiling one application: every file that follows from its spec, the catalog and what was measured.

What compile writes is a function of these three: files that no longer follow are removed, and a check is a comparison.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import fogspec.probe
from fogspec import stages
from fogspec.admissible import Admissible, admit
from fogspec.base import digest, units
from fogspec.base.outcomes import Refused
from fogspec.catalog import Catalog
from fogspec.effects.choosing import Chosen, choose_files
from fogspec.effects.files import write_bytes, yaml_text
from fogspec.effects.layout import Layout
from fogspec.effects.measured import read_results
from fogspec.effects.templates import render
from fogspec.plan import Plan, Sample, TaskRef, lifetime_s, make_plan
from fogspec.results import Results
from fogspec.spec import Application
from fogspec.tasks import measured_processes, ros_environment, sample_task

PROBE_FILES = ("agent.py", "fogspec_probe.py", "fogspec_topics.py")


@dataclass(frozen=True, slots=True)
class Compiled:
    """One application's files, by path; `removed` are files of ours that no longer follow from the inputs.

    `stale` says why there are results that do not count, `chosen` is there once there are results that do.
    """

    layout: Layout
    plan: Plan
    admissible: Admissible
    files: dict[Path, bytes]
    removed: tuple[Path, ...]
    results: Results | None = None
    stale: str | None = None
    chosen: Chosen | None = field(default=None)

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


def compile_application(application: Application, spec_path: str | Path, catalog: Catalog) -> Compiled:
    """Everything that follows from the inputs.

    Raises Problems or WrongFile for a wrong file, NothingMeets when no machine is admissible, Refused when the
    plan may cost more than the budget.
    """
    layout = Layout.of(spec_path, application.metadata.name)
    source = layout.relative(layout.spec)
    bare = make_plan(application, source, catalog)
    check_budget(bare)
    files = dict(_agent_files(layout))
    plan = _with_tasks(application, bare, layout, files)
    files[layout.plan] = _yaml(plan.model_dump(mode="json"), source)
    admissible = admit(catalog, application.spec.hardware, application.spec.infra)
    results, stale = _usable_results(application, layout)
    chosen = None
    if results is not None:
        plan_digest = digest.of_bytes(files[layout.plan])
        chosen = choose_files(application, layout, catalog.about, admissible, results, plan_digest)
        files |= chosen.files
    return Compiled(layout, plan, admissible, files, tuple(_leftover(layout, files)), results, stale, chosen)


def check_budget(plan: Plan) -> None:
    """Raises Refused when the plan may cost more than its budget."""
    body = plan.spec
    if body.budget is None or body.estimate.total <= body.budget:
        return
    needed = units.format_money(-(-body.estimate.total * 100 // 1) / 100)
    raise Refused(
        f"{plan.metadata.name}: the plan may cost {money(body.estimate.total)}, the budget is {money(body.budget)}: "
        "nothing was written",
        f"{len(body.samples)} samples: measuring {money(body.estimate.measuring)}, set-up {money(body.estimate.setup)}",
        f"raise spec.benchmark.budget to {needed}, or lower spec.benchmark.stop.after, setup, or hardware",
    )


def money(usd: float) -> str:
    """Dollars and cents; hundredths of a cent where that matters."""
    return f"${usd:.2f}" if usd >= 1 or usd == 0 else f"${usd:.4f}"


def _agent_files(layout: Layout) -> Iterator[tuple[Path, bytes]]:
    """What is sent to a sampled machine, beside the tasks that send it."""
    folder = Path(next(iter(fogspec.probe.__path__)))
    for name in PROBE_FILES:
        yield layout.agent / name, (folder / name).read_bytes()


def _with_tasks(application: Application, plan: Plan, layout: Layout, files: dict[Path, bytes]) -> Plan:
    source = layout.relative(layout.spec)
    samples = []
    for sample in plan.spec.samples:
        path = layout.task(sample.id)
        files[path] = _yaml(task_of(application, plan, sample, layout), source)
        reference = TaskRef(path=path.relative_to(layout.compiled).as_posix(), digest=digest.of_bytes(files[path]))
        samples.append(sample.model_copy(update={"task": reference}))
    return plan.model_copy(update={"spec": plan.spec.model_copy(update={"samples": samples})})


def task_of(application: Application, plan: Plan, sample: Sample, layout: Layout) -> dict[str, Any]:
    """The compiled task of one sample."""
    body = plan.spec
    life = lifetime_s(body.after, body.setup)
    ros = ros_environment(application.spec)
    limits = _limits(application, plan)
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
    words = ["--after", units.format_number(body.after), "--warmup", str(body.warmup)]
    words += ["--startup", units.format_number(body.setup)]
    if body.steps is not None:
        words += ["--steps", str(body.steps)]
    if stop.precision is not None:
        statistic = application.spec.constraints.statistic
        words += ["--precision", units.format_number(stop.precision), "--statistic", statistic]
    return words


def _usable_results(application: Application, layout: Layout) -> tuple[Results | None, str | None]:
    """Results that measure what the spec says now, or why those on disk do not count."""
    results = read_results(layout)
    if results is None:
        return None, None
    if results.spec.application != stages.measured_digest(application):
        return None, (
            f"{layout.results} measured something else: nodes, environment, probe, metrics, workload, or how it is "
            "driven has changed since"
        )
    return results, None


def _leftover(layout: Layout, files: dict[Path, bytes]) -> Iterator[Path]:
    """Files in `compiled/NAME` that compile wrote once and no longer writes; what others put there stays."""
    ours = [layout.models, layout.menu, layout.picture, layout.manifest, layout.deploy, layout.robot]
    for path in (*ours, *sorted(layout.tasks.glob("*.sky.yaml")), *sorted(layout.agent.glob("*.py"))):
        if path not in files and path.is_file():
            yield path


def _yaml(data: dict[str, Any], source: str) -> bytes:
    return yaml_text(data, f"fogspec compile {source}", source).encode()
