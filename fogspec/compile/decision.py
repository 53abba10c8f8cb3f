"""From results to the files of a choice: models, menu, picture, and the pinned manifest with its task and launch file."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fogspec.base import digest
from fogspec.base.layout import Layout
from fogspec.base.yaml.writer import yaml_text
from fogspec.catalog.filters import Filtered
from fogspec.catalog.table import Catalog
from fogspec.charts.drawing import charts
from fogspec.choice.choose import Choice, choose
from fogspec.choice.menu import Menu, make_menu
from fogspec.choice.relaxed import Relaxed, chosen_by_relaxing, relaxed_optimum
from fogspec.compile.deploy_files import deployable
from fogspec.compile.links import link_of
from fogspec.compile.manifest import FileRef, Manifest, Sources, make_manifest
from fogspec.model.fit import Models, fit, targets
from fogspec.model.predict import PredictionSet, predict
from fogspec.numerics.priors import Library
from fogspec.plan.schema import ApplicationRef, CatalogRef
from fogspec.results.schema import Results
from fogspec.spec import fingerprints
from fogspec.spec.lockfile import image_named, is_pinned
from fogspec.spec.schema import Application


@dataclass(frozen=True, slots=True)
class Decision:
    """A choice and its files by path; there is a manifest if and only if some machine meets the limits."""

    models: Models
    predicted: PredictionSet
    choice: Choice
    menu: Menu
    manifest: Manifest | None
    files: dict[Path, bytes]


def choose_files(
    application: Application, layout: Layout, catalog: Catalog, admissible: Filtered, results: Results,
    plan_digest: str, sent: Mapping[Path, bytes], library: Library | None = None,
) -> Decision:  # fmt: skip
    """Fit, choose, and lay out what is written of it; `sent` are the files that every machine gets."""
    source, about = layout.relative(layout.spec), catalog.about
    models = fit(application, results, library.digest if library else None)
    predicted = predict(models, admissible.offers, targets(application), catalog, library)
    choice, relaxed = decide(application, models, predicted)
    warnings = warnings_for(application, models, choice)
    menu = make_menu(application, choice, warnings)
    files = {layout.models: _yaml(models, source), layout.menu: _yaml(menu, source)}
    files |= charts(application, choice, models, caveats(models, choice), layout)
    manifest = None
    if choice.chosen is not None:
        made = deployable(application, layout, choice, sent, files)
        beside = layout.compiled
        sources = Sources(
            application=ApplicationRef(
                path=source, digest=fingerprints.chosen_digest(application),
                field_digests=fingerprints.chosen_fields(application)
            ),
            catalog=CatalogRef(source=about.source, revision=about.revision, date=about.date, digest=about.digest),
            plan=FileRef(path=layout.plan.relative_to(beside).as_posix(), digest=plan_digest),
            results=FileRef(path=layout.relative(layout.results), digest=results.integrity),
            models=FileRef(path=layout.models.relative_to(beside).as_posix(), digest=digest.of_bytes(files[layout.models])),
            task=made.task, robot_launch=made.robot_launch,
            robot_environment=made.robot_environment, files=made.files, fallbacks=made.fallbacks,
        )  # fmt: skip
        manifest = make_manifest(application, choice, models, sources, warnings, relaxed)
        files[layout.manifest] = _yaml(manifest, source)
    return Decision(models, predicted, choice, menu, manifest, files)


def decide(application: Application, models: Models, predicted: PredictionSet) -> tuple[Choice, Relaxed | None]:
    """The choice by the method that the spec asks for, and where the paper's method ends."""
    choice = choose(application, predicted)
    relaxed = relaxed_optimum(models, choice)
    if application.spec.objective.method == "relaxed":
        choice = chosen_by_relaxing(choice, relaxed)
    return choice, relaxed


def warnings_for(application: Application, models: Models, choice: Choice) -> list[str]:
    """What a reviewer must know before believing the figures, most important first."""
    found, row = caveats(models, choice), choice.chosen
    for model in models.spec.models:
        beside = f" with {model.gpu}" if model.gpu else ""
        found += [f"curve of {model.target}{beside}: {text}" for text in model.warnings]
    found += [f"sample {one.id} does not count: {one.reason}" for one in models.spec.rejected]
    image = image_named(application)
    if image is not None and not is_pinned(image):
        found.append(f"image {image} is not pinned to a digest: what is deployed may differ from what was measured")
    if row is not None:
        found += link_of(application).notes(application, str(choice.offers.cloud[row]))
    unpredicted = len(choice.offers) - int(choice.eligible.sum())
    if unpredicted:
        found.append(f"{unpredicted} admissible machines cannot be predicted, or failed when they were measured")
    return found


def caveats(models: Models, choice: Choice) -> list[str]:
    """What speaks against the choice itself; the pictures have room for the first."""
    if models.spec.measured_on_local:
        return [
            "extrapolated: measured on one host's CPUs and memory, not on machines of the catalog, whose CPUs differ: "
            "the ranking is a guess, and how far off it is cannot be said"
        ]
    if choice.chosen is not None:
        return _caveats(choice, choice.chosen)
    if choice.feasible.any():
        return [
            "the relaxed method ends beside no machine that meets the limits, though there are some: use exhaustive"
        ]
    return []


def _caveats(choice: Choice, row: int) -> list[str]:
    """What speaks against the chosen machine."""
    found, name = [], choice.offers.instance[row]
    if choice.best is not None and choice.objective[row] > choice.objective[choice.best]:
        best = choice.offers.instance[choice.best]
        found.append(f"the relaxed method ends at {name}; {best} meets the limits and is better: use exhaustive")
    if not choice.meets_confidence:
        found.append(
            f"no machine meets the limits with constraints.confidence {choice.confidence:g}: {name}, the best of those "
            f"more likely to meet them than not, does with probability {choice.probability(row) or 0:.2f}"
        )
    if choice.latency.extrapolated[row]:
        found.append(f"extrapolated: {name} lies outside the vCPUs, memory and kinds of machine that were sampled")
    if not choice.latency.measured[row]:
        found.append(f"not verified: {name} was not measured, its latency is predicted")
    return found


def _yaml(artefact: Models | Menu | Manifest, source: str) -> bytes:
    return _text(artefact.model_dump(mode="json"), source)


def _text(data: Mapping[str, Any], source: str) -> bytes:
    return yaml_text(data, f"fogspec compile {source}", source).encode()
