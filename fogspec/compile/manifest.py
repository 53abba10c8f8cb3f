"""Make the pinned manifest: the machine to approve, its expected performance, and the provenance of every figure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import Field, SerializerFunctionWrapHandler, field_serializer, model_serializer

from fogspec import __version__
from fogspec.base import units
from fogspec.base.quantities import Cost, Duration, Lean, Memory, Money, Price, Strict, Until
from fogspec.base.units import rounded
from fogspec.catalog.machine import ListedMachine
from fogspec.choice.choose import Choice
from fogspec.choice.menu import LEVEL, Entry, MetricValue, entry_of, floored, scale_texts, weights
from fogspec.choice.relaxed import Relaxed
from fogspec.choice.rule import latency_limit_s
from fogspec.choice.shortlist import shortlist
from fogspec.model.fit import Model, Models
from fogspec.plan.schema import ApplicationRef, CatalogRef, EnvironmentMetadata, TaskRef
from fogspec.results.schema import Carried
from fogspec.spec.lockfile import SentFiles
from fogspec.spec.schema import Application, Billing, Connectivity, Node, Statistic


class Fallback(ListedMachine):
    """A machine that also meets the limits, with its own reviewed task."""

    latency: Duration
    cost: Cost
    task: TaskRef


class Pinned(ListedMachine):
    """What will run: one machine, its image, its nodes, and the reviewed task that starts them.

    `sent` are the files of the spec's directory that the machine gets, `files` the compiled ones; `fallbacks` may take the
    machine's place, in this order, if it is unavailable. With `until` or `max_spend` the deployment ends by itself.
    """

    image: str | None
    image_pinned: bool | None
    cloud: list[Node]
    robot: list[Node]
    connectivity: Connectivity
    task: TaskRef
    robot_launch: TaskRef | None
    robot_environment: dict[str, str]
    sent: SentFiles | None
    files: list[TaskRef]
    ready: list[str] | None
    ready_timeout: Duration
    fallbacks: list[Fallback]
    until: Until | None = None
    max_spend: Money | None = None

    @model_serializer(mode="wrap")
    def _without_unset(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Omit what later versions added while it is not set."""
        found: dict[str, Any] = dump(self)
        return {name: value for name, value in found.items() if value is not None or name not in ("until", "max_spend")}

    @field_serializer("cloud", "robot")
    def _only_what_is_set(self, nodes: list[Node]) -> list[dict[str, Any]]:
        return [node.model_dump(mode="json", exclude_defaults=True) for node in nodes]


class ExpectedLatency(Lean):
    """Latency of one request: predicted, its interval at `level`, and the probability that the limit is met."""

    statistic: Statistic
    predicted: Duration
    interval: tuple[Duration, Duration] | None
    level: float
    limit: Duration | None
    network_allowance: Duration
    probability_met: float | None
    measured: bool
    nested_in: str | None = None
    extrapolated: bool

    ADDED = frozenset({"nested_in"})


class ExpectedLimits(Strict):
    """Whether all limits are met: with which probability, whether that is what was asked, and whether it was measured.

    `probability_met` and `meets_confidence` are None where nothing can be said of probabilities.
    """

    confidence: float
    probability_met: float | None
    meets_confidence: bool | None
    verified: bool


class ExpectedCost(Strict):
    """Cost of one request, and what the machine costs while it is up."""

    predicted: Cost
    limit: Cost | None
    billing: Billing
    hour: Price
    month: str


class ExpectedMetric(Strict):
    """A measure of the application, predicted, with its interval."""

    name: str
    predicted: float
    interval: tuple[float, float] | None
    level: float
    limit: float | None
    unit: str | None
    probability_met: float | None


class ExpectedObjective(Strict):
    """The objective value, with its weights and scales written down."""

    alpha: float
    words: str
    latency_weight: float
    cost_weight: float
    scale: dict[str, str]
    value: float


class Expected(Strict):
    """What the models say of the pinned machine."""

    limits: ExpectedLimits
    latency: ExpectedLatency
    cost: ExpectedCost
    metrics: list[ExpectedMetric]
    objective: ExpectedObjective


class Alternative(Strict):
    """A machine that was not chosen, and why."""

    role: str
    infra: str
    instance: str
    latency: Duration
    cost: Cost
    metrics: dict[str, MetricValue]
    price: Price
    why_not: str


class FileRef(Strict):
    """An input of this manifest: path beside it and digest over what was read of it."""

    path: str
    digest: str


class CurveRef(Strict):
    """The curve of the paper's families for the chosen machine's GPU type, for comparison."""

    gpu: str | None
    family: str
    formula: str
    coefficients: dict[str, float]
    n: int
    p: int
    r2: float | None
    loo_median_error: float | None
    loo_max_error: float | None


class ModelRef(Strict):
    """What the prediction comes from; `priors` is the digest of the machine library, None without one.

    `surrogate` is the version of the model, None where the curve itself predicts, for shapes of one host.
    """

    path: str
    digest: str
    surrogate: int | None
    priors: str | None
    samples: int
    curve: CurveRef | None


class Builder(Strict):
    """The program that wrote the file."""

    name: Literal["fogspec"] = "fogspec"
    version: str


class PaperChoice(Strict):
    """Where the paper's method ends: a continuous optimum, its nearest machine, and the one that meets the limits.

    `latency` is what its own curve predicts. `objective` and `meets` say what the exhaustive choice's model predicts.
    """

    cpus: float
    memory: Memory
    rounded: str
    instance: str | None
    infra: str | None
    latency: Duration | None
    objective: float | None
    meets: bool | None


class BestOfAll(Strict):
    """The best of all machines that meet the limits."""

    instance: str
    infra: str
    objective: float


class Partial(Strict):
    """How much of a plan that was not carried out is measured, and the ids of the samples that are missing."""

    measured: int
    planned: int
    missing: list[str]


class Provenance(Lean):
    """Where every figure came from; `application.field_digests` has a short digest of each field that choosing depends on.

    `relaxed` and `exhaustive` say where these methods end if they end at different machines. `partial` is there if the
    plan was not carried out, which `compile --partial` accepted. `carried` are changes since samples were measured that
    were waived, or confirmed by another measurement.
    """

    application: ApplicationRef
    catalog: CatalogRef
    plan: FileRef
    results: FileRef
    models: ModelRef
    method: Literal["exhaustive", "relaxed"]
    relaxed: PaperChoice | None
    exhaustive: BestOfAll | None
    partial: Partial | None = None
    carried: list[Carried] = Field([])
    builder: Builder

    ADDED = frozenset({"partial", "carried"})


class Manifest(Strict):
    """`kind: DeploymentManifest`; the name is not a Kubernetes kind, so that no controller tries to apply it."""

    apiVersion: Literal["fogspec.dev/v1alpha1"] = "fogspec.dev/v1alpha1"
    kind: Literal["DeploymentManifest"] = "DeploymentManifest"
    metadata: EnvironmentMetadata
    spec: Pinned
    expected: Expected
    warnings: list[str]
    alternatives: list[Alternative]
    provenance: Provenance


@dataclass(frozen=True, slots=True, kw_only=True)
class Sources:
    """References to the inputs of a manifest and to the files of its deployment."""

    application: ApplicationRef
    catalog: CatalogRef
    plan: FileRef
    results: FileRef
    models: FileRef
    task: TaskRef
    robot_launch: TaskRef | None
    robot_environment: Mapping[str, str]
    sent: SentFiles | None
    files: list[TaskRef]
    fallbacks: Mapping[int, TaskRef]


def make_manifest(
    application: Application,
    choice: Choice,
    models: Models,
    sources: Sources,
    *,
    warnings: list[str],
    relaxed: Relaxed | None = None,
    partial: Partial | None = None,
    carried: Sequence[Carried] = (),
) -> Manifest:
    """Return the manifest of the chosen machine, with the optimum of `relaxed` if it differs.

    `partial` says how much of the plan is measured if that is not all, `carried` after which changes samples count on.

    Raise ValueError if no machine is chosen.
    """
    row = choice.chosen
    if row is None:
        raise ValueError("there is no manifest without a choice")
    entry = entry_of(choice, row)
    return Manifest(
        metadata=EnvironmentMetadata(name=application.name),
        spec=_pinned(application, entry, sources, choice),
        expected=_expected(application, choice, row, entry),
        warnings=warnings,
        alternatives=alternatives(choice, row),
        provenance=Provenance(
            application=sources.application,
            catalog=sources.catalog,
            plan=sources.plan,
            results=sources.results,
            models=_model_ref(models, entry, sources.models),
            method=application.spec.objective.method,
            relaxed=None if relaxed is None or relaxed.row == choice.best else _paper_choice(choice, relaxed),
            exhaustive=None if choice.best in (None, row) else _best_of_all(choice, choice.best),
            partial=partial,
            carried=list(carried),
            builder=Builder(version=__version__),
        ),
    )


def _best_of_all(choice: Choice, row: int) -> BestOfAll:
    best = entry_of(choice, row)
    return BestOfAll(instance=best.instance, infra=best.infra, objective=best.objective)


def _paper_choice(choice: Choice, relaxed: Relaxed) -> PaperChoice:
    end = None if relaxed.row is None else entry_of(choice, relaxed.row)
    return PaperChoice(
        cpus=rounded(relaxed.vcpus),
        memory=rounded(relaxed.memory_gib),
        rounded=str(choice.offers.instance[relaxed.rounded]),
        instance=end and end.instance,
        infra=end and end.infra,
        latency=None if relaxed.row is None else rounded(float(relaxed.selection.latency.value[relaxed.row])),
        objective=end and end.objective,
        meets=end and end.meets,
    )


def _pinned(application: Application, entry: Entry, sources: Sources, choice: Choice) -> Pinned:
    spec = application.spec
    image = spec.ros.image if spec.ros else None
    return Pinned(
        **dict(entry.machine),
        image=image,
        image_pinned=None if image is None else "@sha256:" in image,
        cloud=spec.cloud,
        robot=spec.robot,
        connectivity=spec.connectivity,
        task=sources.task,
        robot_launch=sources.robot_launch,
        robot_environment=dict(sources.robot_environment),
        sent=sources.sent,
        files=sources.files,
        ready=spec.deployment.ready,
        ready_timeout=spec.deployment.ready_timeout,
        fallbacks=[_fallback(entry_of(choice, row), task) for row, task in sources.fallbacks.items()],
        until=spec.deployment.until,
        max_spend=spec.deployment.max_spend,
    )


def _fallback(entry: Entry, task: TaskRef) -> Fallback:
    return Fallback(**dict(entry.machine), latency=entry.latency, cost=entry.cost, task=task)


def _expected(application: Application, choice: Choice, row: int, entry: Entry) -> Expected:
    spec = application.spec
    limit, objective = latency_limit_s(application), spec.objective
    probability = None if limit is None else choice.latency.probability_below(row, limit)
    return Expected(
        limits=_limits(choice, row),
        latency=ExpectedLatency(
            statistic=spec.constraints.statistic,
            predicted=entry.latency,
            interval=entry.interval,
            level=LEVEL,
            limit=spec.constraints.latency,
            network_allowance=spec.constraints.network_allowance,
            probability_met=None if probability is None else floored(probability),
            measured=entry.measured,
            nested_in=entry.nested_in,
            extrapolated=entry.extrapolated,
        ),
        cost=ExpectedCost(
            predicted=entry.cost,
            limit=spec.constraints.cost,
            billing=objective.billing,
            hour=entry.price,
            month=entry.month,
        ),
        metrics=_expected_metrics(choice, row, entry),
        objective=ExpectedObjective(
            alpha=objective.alpha,
            words=weights(application),
            latency_weight=objective.alpha,
            cost_weight=round(1 - objective.alpha, 12),
            scale=scale_texts(application, choice),
            value=entry.objective,
        ),
    )


def _expected_metrics(choice: Choice, row: int, entry: Entry) -> list[ExpectedMetric]:
    found = []
    for name, one in entry.metrics.items():
        met = None if one.limit is None else choice.metrics[name].probability_below(row, one.limit)
        found.append(
            ExpectedMetric(
                name=name,
                predicted=one.value,
                interval=one.interval,
                level=LEVEL,
                limit=one.limit,
                unit=one.unit,
                probability_met=None if met is None else floored(met),
            )
        )
    return found


def _limits(choice: Choice, row: int) -> ExpectedLimits:
    met = choice.probability(row)
    return ExpectedLimits(
        confidence=choice.confidence,
        probability_met=None if met is None else floored(met),
        meets_confidence=None if met is None else choice.meets_confidence,
        verified=bool(choice.latency.measured[row]),
    )


def alternatives(choice: Choice, chosen: int) -> list[Alternative]:
    """Return the other named choices, the runner-up, and the nearest machine that a limit excludes."""
    found: list[Alternative] = []
    for role, row in shortlist(choice).items():
        entry = entry_of(choice, row)
        found.append(
            Alternative(
                role=role,
                infra=entry.infra,
                instance=entry.instance,
                latency=entry.latency,
                cost=entry.cost,
                metrics=entry.metrics,
                price=entry.price,
                why_not=entry.why_not or _lost_on(choice, row, chosen),
            )
        )
    return found


def _lost_on(choice: Choice, row: int, chosen: int) -> str:
    mine, best = (rounded(float(choice.objective[at])) for at in (row, chosen))
    if mine == best:
        return "equal objective; ties go by cost, latency, name"
    return "objective {} against {}".format(*units.shown_apart(mine, best))


def _model_ref(models: Models, entry: Entry, file: FileRef) -> ModelRef:
    body, model = models.spec, model_for(models, entry)
    curve = None
    if model is not None:
        curve = CurveRef(
            gpu=model.gpu,
            family=f"{model.cpu_family} + {model.memory_family}",
            formula=model.formula,
            coefficients={k: rounded(v) for k, v in model.coefficients.items()},
            n=model.n,
            p=model.p,
            r2=_maybe(model.r2),
            loo_median_error=_maybe(model.loo_median_error),
            loo_max_error=_maybe(model.loo_max_error),
        )
    return ModelRef(
        path=file.path,
        digest=file.digest,
        surrogate=None if body.measured_on_local else body.predictor.surrogate,
        priors=body.predictor.priors,
        samples=len(body.observations),
        curve=curve,
    )


def model_for(models: Models, entry: Entry) -> Model | None:
    """Return the latency curve of the entry's GPU type; None if no machine of that type was measured."""
    return next((m for m in models.spec.models if m.gpu == entry.gpu_key and m.target == "latency"), None)


def _maybe(value: float | None) -> float | None:
    return None if value is None else rounded(value)
