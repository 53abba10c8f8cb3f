"""Choose a machine from results and make the files of the choice: models, menu, charts, and the pinned manifest."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fogspec import __version__
from fogspec.agent import PROTOCOL
from fogspec.base import digest
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import FogspecError, Infeasible, NotMeasured
from fogspec.base.layout import Layout
from fogspec.base.text import count
from fogspec.catalog.filters import Filtered
from fogspec.charts.menu import menu_picture
from fogspec.charts.model import model_picture
from fogspec.choice.choose import Choice, choose
from fogspec.choice.menu import Menu, make_menu, rows_of, why_open
from fogspec.choice.next_samples import outlook_of
from fogspec.choice.outlook import Outlook
from fogspec.choice.relaxed import Relaxed, chosen_by_relaxing, relaxed_optimum
from fogspec.compile.deploy_files import deployable
from fogspec.compile.inputs import Inputs
from fogspec.compile.links import link_of
from fogspec.compile.manifest import Evidence, Manifest, Pins, make_manifest
from fogspec.compile.plan_files import document_file
from fogspec.language import warned as codes
from fogspec.language.fingerprints import CATALOG, TOOL, chosen_record, fitted_record
from fogspec.language.lockfile import image_named, is_pinned, sent_files
from fogspec.language.schema import Application, Statistic, Waiver
from fogspec.language.warned import Warned, sentence, warned
from fogspec.model.fit import Fitted, Model, fit, fitted_from, targets
from fogspec.model.predict import PredictionSet, predict, with_predictions
from fogspec.numerics.families import WEAK_ERROR
from fogspec.numerics.observations import DEFAULT_NOISE
from fogspec.plan.schema import CatalogRef, Plan, digest_without_budget
from fogspec.results.progress import Unfinished, unfinished
from fogspec.results.resources import doubts
from fogspec.results.schema import Results, other_servers
from fogspec.results.standing import carried_on, carried_warning

FEW = 5  # samples, below which R² is high on noise too
DOUBTS = 3  # about samples, in a picture
WAITED = 1.005  # times the latency of requests one after the other, from which it is said


@dataclass(frozen=True, slots=True)
class Selection:
    """The models fitted to the results, the predictions for all machines, and the choice among them.

    `relaxed` is the optimum of the paper's method.
    """

    models: Fitted
    predicted: PredictionSet
    choice: Choice
    relaxed: Relaxed | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """A choice and its files by path.

    There is a manifest if and only if some machine meets the limits, and the plan was carried out or what is `unfinished`
    of it was accepted.
    """

    models: Fitted
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
    """Return why a menu has no machine to choose; None if it has one.

    NotMeasured while nothing is measured, or one more sample may decide; Infeasible where no sample can.
    """
    name = menu.metadata.name
    if menu.spec.balanced is not None:
        return None
    if not menu.spec.admissible:
        return Infeasible(f"{name}: no machine of the catalog is admissible")
    if not menu.spec.predicted:
        return NotMeasured(f"{name}: nothing is measured: no sample counts, or each admissible machine failed")
    said = (why_open(menu) or ["no machine meets the limits"])[0]
    if menu.spec.open is not None and menu.spec.open.cause in ("one sample", "unknown"):
        return NotMeasured(f"{name}: {said}")
    return Infeasible(f"{name}: {said}")


def select(inputs: Inputs, application: Application, admissible: Filtered, results: Results) -> Selection:
    """Fit the results, predict every admissible machine, and choose one by the method in the spec."""
    models = fit(application, results, inputs.library_digest)
    predicted = predict(models, admissible.offers, targets(application), inputs.catalog, inputs.library)
    return select_from(application, models, predicted)


def select_from(application: Application, models: Fitted, predicted: PredictionSet) -> Selection:
    """Choose a machine from these predictions by the method in the spec."""
    choice = choose(application, predicted)
    # Importing scipy takes time, so only this method uses it (ADR 0071); the comparison in a manifest uses the grid.
    by_relaxation = application.spec.objective.method == "relaxed"
    relaxed = relaxed_optimum(models, choice, refine=by_relaxation)
    if by_relaxation:
        choice = chosen_by_relaxing(choice, relaxed)
    return Selection(models, predicted, choice, relaxed)


def outlook_after(application: Application, found: Selection, results: Results, plan: Plan) -> Outlook | None:
    """Return what stands between the machines and the limits after these results; None where one is chosen."""
    offers, budget = found.choice.offers, application.spec.benchmark.budget
    usd = plan.spec.commitment.usd(offers)
    left_usd = math.inf if budget is None else budget - results.spec.spent
    failed = [one.machine for one in found.models.rejected]
    return outlook_of(application, found.predicted, found.choice, failed, usd, left_usd)


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
    outlook = outlook_after(application, selection, results, plan)
    menu = make_menu(application, choice, warnings, selection.relaxed, outlook)
    document = with_predictions(models, selection.predicted, rows_of(choice))
    files = {layout.models: document_file(document, layout), layout.menu: document_file(menu, layout)}
    files |= _charts(
        application, choice, models, layout, [doubt for one in results.spec.samples for doubt in doubts(one)]
    )
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
        manifest = make_manifest(
            application,
            choice,
            evidence=_evidence(inputs, application, selection, results, waived),
            pins=Pins(
                plan=plan_digest,
                models=digest.of_bytes(files[layout.models]),
                task=deployed.task,
                robot_launch=deployed.robot_launch,
                files=deployed.files,
                agent_protocol=PROTOCOL,
                sent=sent_files(application, inputs.sent),
            ),
            fallbacks=deployed.fallbacks,
            robot_environment=deployed.robot_environment,
            warnings=warnings,
        )
        files[layout.manifest] = document_file(manifest, layout)
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
        made = file.document(Manifest)
    except DiagnosticError:
        return False
    partial = made.partial
    return partial is not None and made.pins.plan == plan_digest and set(left.missing) <= set(partial["missing"])


def _evidence(
    inputs: Inputs,
    application: Application,
    selection: Selection,
    results: Results,
    waived: Sequence[Waiver],
) -> Evidence:
    posterior = selection.choice.latency.posterior
    return Evidence(
        method=application.spec.objective.method,
        samples=len(selection.models.observations),
        scales_like={} if posterior is None else posterior.scales_like,
        carried=carried_on(results, waived),
        inputs=record_of_choice(inputs),
    )


def record_of_choice(inputs: Inputs) -> dict[str, Any]:
    """Return the record of what a manifest is made by: spec, results, machine library, catalog, fogspec, policies."""
    about = CatalogRef.of(inputs.catalog.about).model_dump(mode="json")
    catalog = {f"{CATALOG}.{name}": value for name, value in about.items()}
    policies = {inputs.layout.relative(path): digest.of_bytes(file.content) for path, file in inputs.policies.items()}
    others = {**fitted_from(inputs.results, inputs.library_digest), **catalog, TOOL: __version__, **policies}
    return chosen_record(inputs.application, others)


def record_of_models(inputs: Inputs) -> dict[str, Any]:
    """Return the record of what models are fitted from now."""
    return fitted_record(inputs.application, fitted_from(inputs.results, inputs.library_digest))


def warnings_for(
    application: Application,
    models: Fitted,
    choice: Choice,
    results: Results,
    left: Unfinished | None,
    waived: Sequence[Waiver] = (),
) -> list[Warned]:
    """Return the warnings for reviewers about the predictions, most important first; `left` of the plan is unmeasured."""
    found, row = [] if left is None else [left.warning], choice.chosen
    found += [carried_warning(one, len(results.spec.samples)) for one in carried_on(results, waived)]
    found += [*caveats(models, choice), *_spread_unknown(models, application.spec.constraints.statistic)]
    if load := application.spec.objective.load:
        found += _rate_unknown(models, load.rate)
    found += [one for model in models.curves for one in _of_curve(model)]
    found += [one.why for one in models.rejected]
    found += other_servers(results.spec.samples)
    found += [doubt for one in results.spec.samples for doubt in doubts(one)]
    image = image_named(application)
    if image is not None and not is_pinned(image):
        found.append(warned(codes.image_unpinned, image=image))
    if row is not None:
        found += link_of(application).warnings(application, str(choice.offers.cloud[row]))
    unpredicted = len(choice.offers) - int(choice.eligible.sum())
    if unpredicted:
        found.append(warned(codes.unpredicted, machines=unpredicted))
    return found


def _of_curve(model: Model) -> Iterator[Warned]:
    """Yield what makes a curve weak."""
    target, gpu, error = model.target, model.gpu, model.loo_max_error
    if model.n < FEW:
        yield warned(codes.few_samples, target=target, gpu=gpu, samples=model.n)
    if model.p == 1 and model.vcpus[0] < model.vcpus[1]:
        yield warned(codes.constant_curve, target=target, gpu=gpu)
    if error is not None and error > WEAK_ERROR:
        yield warned(codes.curve_error, target=target, gpu=gpu, leave_one_out=error)


def _spread_unknown(models: Fitted, statistic: Statistic) -> list[Warned]:
    """Return what stands for spreads that were not measured, and which of them tell nothing."""
    if models.measured_on_local:
        return []
    observations = models.observations
    times = Counter(one.machine.type_key for one in observations)
    unknown = sum("latency" not in one.errors and times[one.machine.type_key] == 1 for one in observations)
    found = []
    if unknown:
        found.append(warned(codes.spread_unknown, samples=unknown, of=len(observations), assumed_error=DEFAULT_NOISE))
    if untold := [one.id for one in observations if not one.tells]:
        found.append(warned(codes.error_unknown, samples=untold, statistic=statistic))
    return found


def caveats(models: Fitted, choice: Choice) -> list[Warned]:
    """Return the caveats about the choice, which its charts show too."""
    row = choice.least_infeasible if choice.chosen is None else choice.chosen
    waits = [] if row is None else _waits(choice, row)
    if models.measured_on_local:
        return [warned(codes.host_only), *waits]
    if choice.chosen is not None:
        return [*_caveats_of_machine(choice, choice.chosen), *waits]
    return [warned(codes.relaxed_end)] if choice.feasible.any() else waits


def _waits(choice: Choice, row: int) -> list[Warned]:
    """Return how much longer requests take at the declared rate, where they wait for one another."""
    one, latency_s = choice.rule.take(np.array([row])), choice.latency.value[[row]]
    alone_s, rate = one.alone(latency_s), one.costs.requests_per_s
    late, work = (latency_s / alone_s)[0] > WAITED, (alone_s * one.costs.busy_ratio)[0] * (rate or 0.0)
    if rate is None or not (late or work > 1):
        return []
    latency, alone = None if work > 1 else float(latency_s[0]), float(alone_s[0])
    return [warned(codes.waits, machine=str(one.names[0]), requests_per_s=rate, alone_s=alone, latency_s=latency)]


def _rate_unknown(models: Fitted, requests_per_s: float) -> list[Warned]:
    """Return which samples do not say how long requests wait at a rate, and why."""
    found = []
    if absent := [one.id for one in models.observations if one.arrivals is None]:
        found.append(warned(codes.rate_unknown, samples=absent, requests_per_s=requests_per_s))
    slower = [
        (one.id, one.arrivals.sent_per_s) for one in models.observations if one.arrivals and one.arrivals.sent_per_s
    ]
    if slower:
        sent_per_s = min(sent for _, sent in slower)
        named = [name for name, _ in slower]
        found.append(warned(codes.rate_unknown, samples=named, requests_per_s=requests_per_s, sent_per_s=sent_per_s))
    return found


def _caveats_of_machine(choice: Choice, row: int) -> list[Warned]:
    """Return the caveats about the machine in this row."""
    found, name, met = [], str(choice.offers.instance[row]), choice.probability(row)
    if choice.confidence is None and choice.bounds:
        found.append(warned(codes.no_confidence, machine=name, probability=met))
    if choice.by_relaxation and not choice.feasible[row]:
        found.append(warned(codes.relaxed_end, machine=name, probability=met))
    elif choice.best is not None and choice.objective[row] > choice.objective[choice.best]:
        found.append(warned(codes.relaxed_end, machine=name, better=str(choice.offers.instance[choice.best])))
    if not choice.latency.measured[row]:
        extrapolated = bool(choice.latency.extrapolated[row])
        found.append(warned(codes.not_verified, machine=name, extrapolated=extrapolated))
    return found


def _charts(
    application: Application, choice: Choice, models: Fitted, layout: Layout, doubted: Sequence[Warned]
) -> dict[Path, bytes]:
    """Return the chart files, with what is doubtful about the samples; none if no machine can be predicted."""
    if not len(choice.front):
        return {}
    notes = list(map(sentence, [*caveats(models, choice), *doubted[:DOUBTS]]))
    notes += (
        [f"{count(len(doubted) - DOUBTS, 'more doubt')} about samples: fogspec explain"]
        if len(doubted) > DOUBTS
        else []
    )
    found = {layout.picture: menu_picture(application, choice, notes)}
    found[layout.latencies] = model_picture(application, choice, models, notes)
    if metric := application.spec.objective.metric:
        found[layout.metric_picture] = model_picture(application, choice, models, notes, metric)
    return {path: picture.encode() for path, picture in found.items() if picture is not None}
