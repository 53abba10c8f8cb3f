"""Choose a machine from results and make the files of the choice: models, menu, charts, and the pinned manifest."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from fogspec.base import digest
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import FogspecError, Infeasible, NotMeasured
from fogspec.base.layout import Layout
from fogspec.base.text import shell_command
from fogspec.base.yaml.writer import yaml_text
from fogspec.catalog.filters import Filtered
from fogspec.charts import menu_chart, menu_svg, model_svg
from fogspec.choice.choose import Choice, choose
from fogspec.choice.menu import LEVEL, Menu, floored, make_menu
from fogspec.choice.relaxed import Relaxed, chosen_by_relaxing, relaxed_optimum
from fogspec.compile.deploy_files import Deployable, deployable
from fogspec.compile.inputs import Inputs
from fogspec.compile.links import link_of
from fogspec.compile.manifest import FileRef, Manifest, Partial, Sources, make_manifest
from fogspec.model.fit import Models, fit, targets
from fogspec.model.predict import PredictionSet, predict
from fogspec.numerics.observations import DEFAULT_NOISE
from fogspec.plan.schema import ApplicationRef, CatalogRef, Plan, digest_without_budget
from fogspec.results.progress import Unfinished, unfinished
from fogspec.results.resources import doubts
from fogspec.results.schema import Results, other_servers, own_records
from fogspec.results.standing import carried_on, carried_text
from fogspec.spec import fingerprints
from fogspec.spec.lockfile import image_named, is_pinned, sent_files
from fogspec.spec.schema import Application, Waiver


@dataclass(frozen=True, slots=True)
class Selection:
    """The models fitted to the results, the predictions for all machines, and the choice among them.

    `relaxed` is the optimum of the paper's method.
    """

    models: Models
    predicted: PredictionSet
    choice: Choice
    relaxed: Relaxed | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """A choice and its files by path.

    There is a manifest if and only if some machine meets the limits, and the plan was carried out or what is `unfinished`
    of it was accepted.
    """

    models: Models
    predicted: PredictionSet
    choice: Choice
    menu: Menu
    manifest: Manifest | None
    files: Mapping[Path, bytes]
    unfinished: Unfinished | None

    @property
    def refusal(self) -> FogspecError | None:
        """Why there is no manifest; None if there is one."""
        if self.manifest is not None:
            return None
        refusal = no_choice(self.menu)
        if refusal is None and self.unfinished is not None:
            refusal = NotMeasured(
                f"{self.menu.metadata.name}: {self.unfinished.state}: no manifest",
                "measure the others with fogspec bench, or accept what there is with fogspec compile --partial",
            )
        return refusal


def no_choice(menu: Menu) -> FogspecError | None:
    """Return why a menu has no machine to choose: none admissible, measured, or within the limits; None if it has one."""
    name = menu.metadata.name
    if menu.spec.balanced is not None:
        return None
    if not menu.spec.admissible:
        return Infeasible(f"{name}: no machine of the catalog is admissible")
    if not menu.spec.predicted:
        return NotMeasured(f"{name}: nothing is measured: no sample counts, or each admissible machine failed")
    return Infeasible(f"{name}: no machine meets the limits")


def select(inputs: Inputs, application: Application, admissible: Filtered, results: Results) -> Selection:
    """Fit the results, predict every admissible machine, and choose one by the method in the spec."""
    library = inputs.library
    models = fit(application, results, library.digest if library else None)
    return select_from(
        application, models, predict(models, admissible.offers, targets(application), inputs.catalog, library)
    )


def select_from(application: Application, models: Models, predicted: PredictionSet) -> Selection:
    """Choose a machine from these predictions by the method in the spec."""
    choice = choose(application, predicted)
    # Importing scipy takes time, so only this method uses it (ADR 0071); the comparison in a manifest uses the grid.
    by_relaxation = application.spec.objective.method == "relaxed"
    relaxed = relaxed_optimum(models, choice, refine=by_relaxation)
    if by_relaxation:
        choice = chosen_by_relaxing(choice, relaxed)
    return Selection(models, predicted, choice, relaxed)


def decide(
    inputs: Inputs,
    application: Application,
    admissible: Filtered,
    results: Results,
    plan: Plan,
    partial: bool,
    waived: Sequence[Waiver] = (),
) -> Decision:
    """Select a machine and make the files of that choice; `application` has its image pinned.

    `partial` accepts that the plan was not carried out, as does the manifest on disk for the same plan. `waived` are the
    changes since the results were measured.
    """
    plan_digest, left = digest_without_budget(plan), unfinished(inputs.measured.application, plan, results)
    selection = select(inputs, application, admissible, results)
    models, choice, layout = selection.models, selection.choice, inputs.layout
    warnings = warnings_for(application, models, choice, results, left, waived)
    menu = make_menu(application, choice, warnings)
    shared = layout if layout.own_models else layout.measured
    files = {layout.models: _yaml(models, shared), layout.menu: _yaml(menu, layout)}
    files |= _charts(application, choice, models, layout)
    manifest = None
    if choice.chosen is not None and (left is None or partial or _accepted(inputs, left, plan_digest)):
        deployed = deployable(
            application,
            layout,
            choice,
            chosen=choice.chosen,
            sent=inputs.agent,
            files=files,
        )
        models_digest = digest.of_bytes(files[layout.models])
        sources = _sources(
            inputs,
            application,
            deployed,
            plan_digest=plan_digest,
            results_digest=results.integrity,
            models_digest=models_digest,
        )
        manifest = make_manifest(
            application,
            choice,
            models,
            sources,
            warnings=warnings,
            relaxed=selection.relaxed,
            carried=[one.model_copy(update={"pins": None}) for one in carried_on(results, waived)],
            partial=None
            if left is None
            else Partial(measured=left.measured, planned=left.planned, missing=list(left.missing)),
        )
        files[layout.manifest] = _yaml(manifest, layout)
    return Decision(
        models=models,
        predicted=selection.predicted,
        choice=choice,
        menu=menu,
        manifest=manifest,
        files=files,
        unfinished=left,
    )


def _accepted(inputs: Inputs, left: Unfinished, plan_digest: str) -> bool:
    """Return whether the manifest on disk was made from this plan with no less measured, and says that it is partial."""
    file = inputs.on_disk.get(inputs.layout.manifest)
    if file is None:
        return False
    try:
        provenance = file.document(Manifest).provenance
    except DiagnosticError:
        return False
    partial = provenance.partial
    return partial is not None and provenance.plan.digest == plan_digest and set(left.missing) <= set(partial.missing)


def _sources(
    inputs: Inputs,
    application: Application,
    deployed: Deployable,
    *,
    plan_digest: str,
    results_digest: str,
    models_digest: str,
) -> Sources:
    """Return references to the inputs of a choice and to the files of its deployment."""
    layout, about = inputs.layout, inputs.catalog.about
    return Sources(
        application=ApplicationRef(
            path=inputs.source,
            digest=fingerprints.chosen_digest(application),
            field_digests=fingerprints.chosen_fields(application),
        ),
        catalog=CatalogRef(source=about.source, revision=about.revision, date=about.date, digest=about.digest),
        plan=FileRef(path=layout.beside_manifest(layout.plan), digest=plan_digest),
        results=FileRef(path=layout.relative(layout.results), digest=results_digest),
        models=FileRef(path=layout.beside_manifest(layout.models), digest=models_digest),
        task=deployed.task,
        robot_launch=deployed.robot_launch,
        robot_environment=deployed.robot_environment,
        sent=sent_files(
            application, layout.beside_manifest(layout.spec.parent), inputs.pins, layout.spec.parent == layout.root
        ),
        files=deployed.files,
        fallbacks=deployed.fallbacks,
    )


def warnings_for(
    application: Application,
    models: Models,
    choice: Choice,
    results: Results,
    left: Unfinished | None,
    waived: Sequence[Waiver] = (),
) -> list[str]:
    """Return the warnings for reviewers about the predictions, most important first; `left` of the plan is unmeasured."""
    partial = [] if left is None else [left.warning]
    partial += [carried_text(one, len(own_records(results.spec.samples))) for one in carried_on(results, waived)]
    found, row = [*partial, *caveats(models, choice), *_calibration(models, choice)], choice.chosen
    for model in models.spec.models:
        beside = f" with {model.gpu}" if model.gpu else ""
        found += [f"curve of {model.target}{beside}: {text}" for text in model.warnings]
    found += [f"sample {one.id} does not count: {one.reason}" for one in models.spec.rejected]
    found += other_servers(results.spec.samples)
    found += doubts(results.spec.samples)
    image = image_named(application)
    if image is not None and not is_pinned(image):
        found.append(f"image {image} is not pinned to a digest: what is deployed may differ from what was measured")
    if row is not None:
        found += link_of(application).notes(application, str(choice.offers.cloud[row]))
    unpredicted = len(choice.offers) - int(choice.eligible.sum())
    if unpredicted:
        found.append(f"{unpredicted} admissible machines cannot be predicted, or failed when they were measured")
    return found


def _calibration(models: Models, choice: Choice) -> list[str]:
    """Return what the samples say against the ranges, and what stands for spreads that were not measured."""
    posterior, body, found = choice.latency.posterior, models.spec, []
    if posterior is None:
        return []
    calibration, level = posterior.calibration, f"{LEVEL:.0%} range"
    if calibration.factor > 1:
        found.append(
            f"{calibration.covered} of {calibration.machines} measured machines lie in the {level} that the others give them: "
            f"ranges of predictions are widened by a factor of {calibration.factor:.3g}, with which "
            f"{calibration.covered_widened} do; probabilities are not"
        )
    times = Counter(one.machine.type_key for one in body.observations)
    unknown = sum(one.error is None and times[one.machine.type_key] == 1 for one in body.observations)
    if unknown:
        probability = None if choice.chosen is None or not choice.bounds else choice.probability(choice.chosen)
        rests = (
            "" if probability is None else f", on which the probability {floored(probability):g} of the choice rests"
        )
        found.append(
            f"the spread of requests is unknown for {unknown} of {len(body.observations)} samples: "
            f"each is assumed to err by {DEFAULT_NOISE:.1%}{rests}"
        )
    return found


def caveats(models: Models, choice: Choice) -> list[str]:
    """Return the caveats about the choice; the charts show the first."""
    if models.spec.measured_on_local:
        return [
            "extrapolated: measured on one host's CPUs and memory, not on machines of the catalog, whose CPUs differ: "
            "the ranking is a guess, and how far off it is cannot be said"
        ]
    if choice.chosen is not None:
        return _caveats_of_machine(choice, choice.chosen)
    if choice.feasible.any():
        return [
            "the relaxed method ends beside no machine that meets the limits, though there are some: use exhaustive"
        ]
    return []


def _caveats_of_machine(choice: Choice, row: int) -> list[str]:
    """Return the caveats about the machine in this row."""
    found, name = [], choice.offers.instance[row]
    if choice.by_relaxation and not choice.feasible[row]:
        met = choice.probability(row)
        likely = "" if met is None else f": with probability {met:.2f} it does"
        found.append(
            f"the relaxed method ends at {name} because its own curve says that it meets the limits; the model of method: "
            f"exhaustive says that it does not{likely}"
        )
    elif choice.best is not None and choice.objective[row] > choice.objective[choice.best]:
        best = choice.offers.instance[choice.best]
        found.append(f"the relaxed method ends at {name}; {best} meets the limits and is better: use exhaustive")
    elif not choice.meets_confidence:
        found.append(
            f"no machine meets the limits with constraints.confidence {choice.confidence:g}: {name}, the best of those "
            f"more likely to meet them than not, does with probability {choice.probability(row) or 0:.2f}"
        )
    if choice.latency.extrapolated[row]:
        found.append(f"extrapolated: {name} lies outside the vCPUs, memory and kinds of machine that were sampled")
    if not choice.latency.measured[row]:
        where = choice.latency.where_nested(row)
        how = "was not measured, its latency is predicted" if where is None else f"was measured on {where}, not itself"
        found.append(f"not verified: {name} {how}")
    return found


def _yaml(artifact: Models | Menu | Manifest, layout: Layout) -> bytes:
    again = shell_command("fogspec", "compile", layout.relative(layout.spec))
    return yaml_text(artifact.model_dump(mode="json"), again, layout.source).encode()


def _charts(application: Application, choice: Choice, models: Models, layout: Layout) -> dict[Path, bytes]:
    """Return the chart files; none if no machine can be predicted."""
    if not len(choice.front):
        return {}
    doubts = caveats(models, choice)
    found = {layout.picture: menu_svg.draw(menu_chart.menu_chart(application, choice, doubts)).encode()}
    sized = {layout.latencies: None, layout.metric_picture: application.spec.objective.metric}
    for path, metric in sized.items():
        if path == layout.latencies or metric is not None:
            chart = model_svg.size_chart(application, choice, models, doubts, metric)
            if chart.series:
                found[path] = model_svg.draw(chart).encode()
    return found
