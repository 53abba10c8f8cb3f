"""From results to the files of a choice: models, menu, picture, and the pinned manifest with its task and launch file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fogspec import stages
from fogspec.admissible import Admissible
from fogspec.base import digest
from fogspec.catalog import About
from fogspec.choice import Choice, choose, latency_limit_s
from fogspec.effects import picture
from fogspec.effects.files import yaml_text
from fogspec.effects.layout import Layout
from fogspec.effects.templates import render
from fogspec.lock import image_named, is_pinned
from fogspec.manifest import FileRef, Manifest, Sources, make_manifest
from fogspec.menu import LEVEL, Menu, make_menu, thinned, weights
from fogspec.models import Models, fit
from fogspec.plan import CatalogRef, TaskRef, machine_ref
from fogspec.relaxing import Relaxed, chosen_by_relaxing, relax
from fogspec.results import Results
from fogspec.spec import Application
from fogspec.tasks import command, deploy_task, ros_environment

SHOWN_DOTS = 400


@dataclass(frozen=True, slots=True)
class Chosen:
    """A choice and its files by path; there is a manifest if and only if some machine meets the limits."""

    models: Models
    choice: Choice
    menu: Menu
    manifest: Manifest | None
    files: dict[Path, bytes]


def choose_files(
    application: Application, layout: Layout, about: About, admissible: Admissible, results: Results, plan_digest: str
) -> Chosen:
    """Fit, choose, and lay out what is written of it."""
    source = layout.relative(layout.spec)
    models = fit(application, results)
    choice, relaxed = decide(application, models, admissible)
    warnings = warnings_of(application, models, choice)
    menu = make_menu(application, choice, warnings)
    files = {layout.models: _yaml(models, source), layout.menu: _yaml(menu, source)}
    if len(choice.front):
        files[layout.picture] = picture.draw(chart(application, choice, warnings)).encode()
    manifest = None
    if choice.chosen is not None:
        task, robot = _deployment_files(application, layout, choice, files)
        beside = layout.compiled
        sources = Sources(
            application=FileRef(path=source, digest=stages.chosen_digest(application)),
            catalog=CatalogRef(source=about.source, revision=about.revision, date=about.date, digest=about.digest),
            plan=FileRef(path=layout.plan.relative_to(beside).as_posix(), digest=plan_digest),
            results=FileRef(path=layout.relative(layout.results), digest=results.integrity),
            models=FileRef(path=layout.models.relative_to(beside).as_posix(), digest=digest.of_bytes(files[layout.models])),
            task=task, robot_launch=robot,
        )  # fmt: skip
        manifest = make_manifest(application, choice, models, sources, warnings, relaxed)
        files[layout.manifest] = _yaml(manifest, source)
    return Chosen(models, choice, menu, manifest, files)


def decide(application: Application, models: Models, admissible: Admissible) -> tuple[Choice, Relaxed | None]:
    """The choice by the method that the spec asks for, and where the paper's method ends."""
    choice = choose(application, models, admissible)
    relaxed = relax(application, models, choice)
    if application.spec.objective.method == "relaxed":
        choice = chosen_by_relaxing(choice, relaxed)
    return choice, relaxed


def _deployment_files(
    application: Application, layout: Layout, choice: Choice, files: dict[Path, bytes]
) -> tuple[TaskRef, TaskRef | None]:
    assert choice.chosen is not None
    spec, source = application.spec, layout.relative(layout.spec)
    ros = ros_environment(spec)
    run = render("run_deploy.sh.j2", **ros, processes=[command(node) for node in spec.cloud])
    setup = None if ros["distro"] is None else render("setup_ros2.sh.j2", **ros)
    task = deploy_task(
        application, machine_ref(choice.offers.offer(choice.chosen)), workdir=layout.relative(layout.spec.parent),
        agent=layout.relative(layout.agent), setup=setup, run=run,
    )  # fmt: skip
    files[layout.deploy] = _text(task, source)
    robot = None
    if spec.robot:
        nodes = [node for node in spec.robot if node.cmd is None]
        processes = [node for node in spec.robot if node.cmd is not None]
        text = render(
            "robot.launch.py.j2", source=source, name=application.metadata.name, nodes=nodes, processes=processes
        )
        files[layout.robot] = text.encode()
        robot = TaskRef(path=layout.robot.name, digest=digest.of_bytes(files[layout.robot]))
    return TaskRef(path=layout.deploy.name, digest=digest.of_bytes(files[layout.deploy])), robot


def warnings_of(application: Application, models: Models, choice: Choice) -> list[str]:
    """What a reviewer must know before believing the figures, most important first."""
    found = []
    if models.spec.measured_on_local:
        found.append(
            "extrapolated: measured on one host's CPUs and memory, not on machines of the catalog, whose CPUs differ: "
            "the ranking is a guess, and how far off it is cannot be said"
        )
    row = choice.chosen
    if row is not None:
        if choice.latency.extrapolated[row] and not models.spec.measured_on_local:
            found.append(
                f"extrapolated: {choice.offers.instance[row]} lies outside the vCPUs and memory that were sampled"
            )
        limit = latency_limit_s(application)
        probability = None if limit is None else choice.latency.probability_below(row, limit)
        confidence = application.spec.constraints.confidence
        if probability is not None and probability < confidence:
            found.append(
                f"the latency limit is met with probability {probability:.2f}, below constraints.confidence {confidence:g}: "
                "measure this machine (benchmark.machines) before relying on it"
            )
        if choice.latency.interval(row, LEVEL) is None and not models.spec.measured_on_local:
            found.append("the samples are too few to say how sure the prediction is")
    elif choice.feasible.any():
        found.append(
            "the relaxed method ends beside no machine that meets the limits, though there are some: use exhaustive"
        )
    for model in models.spec.models:
        beside = f" with {model.gpu}" if model.gpu else ""
        found += [f"model of {model.target}{beside}: {text}" for text in model.warnings]
    found += [f"sample {one.id} does not count: {one.why}" for one in models.spec.unusable]
    image = image_named(application)
    if image is not None and not is_pinned(image):
        found.append(f"image {image} is not pinned to a digest: what is deployed may differ from what was measured")
    unpredicted = len(choice.offers) - int(choice.eligible.sum())
    if unpredicted:
        found.append(f"{unpredicted} admissible machines cannot be predicted: no usable sample of their GPU type")
    return found


def chart(application: Application, choice: Choice, warnings: Sequence[str]) -> picture.Chart:
    """The menu as a picture: latency against the cost of one request."""
    spec = application.spec
    roles: Mapping[int | None, Any] = {choice.fastest: "fastest", choice.cheapest: "cheapest", choice.chosen: "chosen"}
    rows = _drawn(choice, [row for row in roles if row is not None])
    front = set(choice.front.tolist())
    points = []
    for row in rows:
        interval = choice.latency.interval(row, LEVEL) if row in roles or row in front else None
        points.append(picture.Point(
            name=f"{choice.offers.instance[row]}" + (" spot" if choice.offers.spot[row] else ""),
            latency_s=float(choice.latency.value[row]), cost_usd_per_request=float(choice.cost_usd_per_request[row]),
            low_s=interval[0] if interval else None, high_s=interval[1] if interval else None,
            measured=bool(choice.latency.measured[row]), on_front=row in front, role=roles.get(row, ""),
        ))  # fmt: skip
    return picture.Chart(
        title=application.metadata.name, subtitle=f"{weights(application)}, {spec.objective.billing} billing",
        latency_label=f"{spec.constraints.statistic} latency", points=points,
        latency_limit_s=latency_limit_s(application), cost_limit_usd_per_request=spec.constraints.cost,
        warning=warnings[0] if warnings else None,
    )  # fmt: skip


def _drawn(choice: Choice, named: Sequence[int]) -> list[int]:
    """Named and front machines, and the cheapest offer of each instance type by objective, at most so many."""
    best: dict[str, int] = {}
    eligible = choice.eligible.nonzero()[0]
    for row in eligible[choice.objective[eligible].argsort(kind="stable")].tolist():
        best.setdefault(str(choice.offers.instance[row]), row)
    return sorted({*named, *thinned(choice.front), *list(best.values())[:SHOWN_DOTS]})


def _yaml(artefact: Models | Menu | Manifest, source: str) -> bytes:
    return _text(artefact.model_dump(mode="json"), source)


def _text(data: Mapping[str, Any], source: str) -> bytes:
    return yaml_text(data, f"fogspec compile {source}", source).encode()
