"""Make the pinned manifest in the order of a decision: the machine to approve, why it, on what evidence, and every pin."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

from pydantic import Field, field_serializer

from fogspec.base.quantities import Confidence, Cost, Duration, Lean, Money, Strict, Until
from fogspec.catalog.machine import ListedMachine, Machine
from fogspec.choice.choose import Choice
from fogspec.choice.menu import LEVEL, Entry, entry_of, floored, month_text, scale_texts, weights
from fogspec.choice.rule import MOST_CERTAIN, latency_limit_s
from fogspec.language.lockfile import SentFiles
from fogspec.language.schema import Application, Connectivity, Node, Statistic
from fogspec.language.warned import Warned, partial
from fogspec.plan.schema import EnvironmentMetadata, TaskRef
from fogspec.results.schema import Carried

AGENT = "../agent.pyz"  # among the files of a manifest
GIVEN = ("infra", "instance", "spot", "until", "budget")  # of a manifest: what its machine is, and when it ends


class Fallback(ListedMachine, Lean):
    """A machine that also meets the limits, with its own reviewed task."""

    task: TaskRef


class Pinned(ListedMachine, Lean):
    """What will run: one machine, its image and its nodes.

    `fallbacks` may take the machine's place, in this order, if it is unavailable. With `until` or `budget` the deployment
    ends by itself.
    """

    image: str | None = None
    image_pinned: bool | None = None
    cloud: list[Node]
    robot: list[Node]
    connectivity: Connectivity
    robot_environment: dict[str, str] = Field({})
    ready: list[str] | None = None
    ready_timeout: Duration
    fallbacks: list[Fallback] = Field([])
    until: Until | None = None
    budget: Money | None = None

    @field_serializer("cloud", "robot")
    def _only_what_is_set(self, nodes: list[Node]) -> list[dict[str, Any]]:
        return [node.model_dump(mode="json", exclude_defaults=True) for node in nodes]

    @field_serializer("connectivity")
    def _link_and_what_is_set(self, one: Connectivity) -> dict[str, Any]:
        return {"link": one.link, **one.model_dump(mode="json", exclude_defaults=True)}


class ExpectedLimits(Lean):
    """The probability with which all limits must be met, and are; `probability_met` is None where nothing can be said of it."""

    confidence: Confidence
    probability_met: float | None = None


class ExpectedObjective(Strict):
    """The objective value, with what it weighs and its scales written down."""

    alpha: float
    words: str
    scale: dict[str, str]
    value: float


class ExpectedLatency(Lean):
    """Latency of one request, with interval at `level` and probability of the limit."""

    statistic: Statistic
    predicted: Duration
    interval: tuple[Duration, Duration] | None = None
    level: float
    limit: Duration | None = None
    network_allowance: Duration
    probability_met: float | None = None
    measured: bool
    extrapolated: bool = False

    @property
    def limit_on_machine(self) -> float | None:
        """The limit in seconds without the network's allowance, which is what can be compared with a latency; None without."""
        return None if self.limit is None else self.limit - self.network_allowance


class ExpectedCost(Lean):
    """Cost of one request, and what the machine costs while it is up."""

    predicted: Cost
    limit: Cost | None = None
    month: str


class ExpectedMetric(Lean):
    """A measure of the application, predicted, with its interval at the latency's level."""

    name: str
    predicted: float
    interval: tuple[float, float] | None = None
    limit: float | None = None
    unit: str | None = None
    probability_met: float | None = None


class ExpectedBaseline(Strict):
    """What would be taken without a benchmark, as it was measured: the most vCPUs without a GPU."""

    infra: str
    instance: str
    latency: Duration
    cost: Cost


class Expected(Lean):
    """Why this machine: what the models say of it, against the limits, the objective and the baseline."""

    limits: ExpectedLimits
    objective: ExpectedObjective
    latency: ExpectedLatency
    cost: ExpectedCost
    metrics: list[ExpectedMetric] = Field([])
    baseline: ExpectedBaseline | None = None


class Evidence(Lean):
    """What the choice rests on: the samples that count, the model, and `inputs`, the record of all that it was made by.

    `scales_like` are the programs of the machine library that predictions lean on, by weight, which may be negative; they sum
    to 1. `carried` are changes since samples were measured that were waived, or confirmed by another measurement. `inputs` is
    `fogspec.language.fingerprints.chosen_record`.
    """

    method: Literal["exhaustive", "relaxed"]
    samples: int
    scales_like: dict[str, float] = Field({})
    carried: list[Carried] = Field([])
    inputs: dict[str, Any]


class Pins(Lean):
    """Digests of the files behind the choice, and of those that are approved with it, by their paths beside the manifest.

    The plan's is without its budget. `task` starts the machine, `robot_launch` the robot's nodes, `files` are the compiled
    files that either gets, `sent` are those of the spec's directory. A machine whose agent has this `agent_protocol` needs no
    other agent.
    """

    plan: str
    models: str
    task: TaskRef
    robot_launch: TaskRef | None = None
    files: list[TaskRef]
    agent_protocol: int
    sent: SentFiles | None = None


class Manifest(Lean):
    """`kind: DeploymentManifest`; the name is not a Kubernetes kind, so that no controller tries to apply it."""

    apiVersion: Literal["fogspec.dev/v1alpha1"]
    kind: Literal["DeploymentManifest"]
    metadata: EnvironmentMetadata
    spec: Pinned
    expected: Expected
    warnings: list[Warned] = Field([])
    evidence: Evidence
    pins: Pins

    @property
    def partial(self) -> Warned | None:
        """The warning that the plan was not carried out, which `compile --partial` accepted; None if it was."""
        return next((one for one in self.warnings if one["code"] == partial.__name__), None)


def make_manifest(
    application: Application,
    choice: Choice,
    *,
    evidence: Evidence,
    pins: Pins,
    fallbacks: Mapping[int, TaskRef],
    robot_environment: Mapping[str, str],
    warnings: list[Warned],
) -> Manifest:
    """Return the manifest of the chosen machine; `fallbacks` are the tasks of others by their rows.

    Raise ValueError if no machine is chosen.
    """
    row = choice.chosen
    if row is None:
        raise ValueError("there is no manifest without a choice")
    entry = entry_of(choice, row)
    others = [Fallback(**dict(entry_of(choice, other).machine), task=task) for other, task in fallbacks.items()]
    return Manifest(
        apiVersion="fogspec.dev/v1alpha1",
        kind="DeploymentManifest",
        metadata=EnvironmentMetadata(name=application.name),
        spec=pinned_to(application, entry.machine, others, robot_environment),
        expected=_expected(application, choice, row, entry),
        warnings=warnings,
        evidence=evidence,
        pins=pins,
    )


def pinned_to(
    application: Application, machine: Machine, fallbacks: Sequence[Fallback], robot_environment: Mapping[str, str]
) -> Pinned:
    """Return what runs if this machine is chosen."""
    spec = application.spec
    image = spec.ros.image if spec.ros else None
    return Pinned(
        **dict(machine),
        image=image,
        image_pinned=None if image is None else "@sha256:" in image,
        cloud=spec.cloud,
        robot=spec.robot,
        connectivity=spec.connectivity,
        robot_environment=dict(robot_environment),
        ready=spec.deployment.ready,
        ready_timeout=spec.deployment.ready_timeout,
        fallbacks=list(fallbacks),
        until=spec.deployment.until,
        budget=spec.deployment.budget,
    )


def given(task: Any, spec: Mapping[str, Any], pins: Mapping[str, Any]) -> list[Any]:
    """Return all that a machine is given: its task, and what a manifest says in plain values, also one of another version.

    A new price or expectation needs no other machine; the protocol of the agent says whether another agent does.
    """
    if isinstance(task, Mapping) and isinstance(task.get("resources"), Mapping):
        resources = {key: value for key, value in task["resources"].items() if key != "max_hourly_cost"}
        task = {**task, "resources": resources}
    robot, listed = pins.get("robot_launch"), pins.get("files")
    apart = (AGENT, robot.get("path") if isinstance(robot, Mapping) else None)
    files = [one for one in listed if not isinstance(one, Mapping) or one.get("path") not in apart] if listed else []
    return [task, *map(spec.get, GIVEN), files, pins.get("sent"), pins.get("agent_protocol")]


def scope_of(application: Application) -> str | None:
    """Return what the latency leaves out; None if the spec allows time for the network."""
    return None if application.spec.constraints.network_allowance else "computing only, network allowance 0 s"


def _expected(application: Application, choice: Choice, row: int, entry: Entry) -> Expected:
    constraints, objective = application.spec.constraints, application.spec.objective
    limit, met = latency_limit_s(application), choice.probability(row)
    probability = None if limit is None else choice.latency.probability_below(row, limit)
    return Expected(
        limits=ExpectedLimits(
            confidence=choice.confidence,
            probability_met=None if met is None else floored(met),
        ),
        objective=ExpectedObjective(
            alpha=objective.alpha,
            words=weights(application),
            scale=scale_texts(application, choice),
            value=entry.objective,
        ),
        latency=ExpectedLatency(
            statistic=constraints.statistic,
            predicted=entry.latency,
            interval=entry.interval,
            level=LEVEL,
            limit=constraints.latency,
            network_allowance=constraints.network_allowance,
            probability_met=_shown(probability),
            measured=entry.measured,
            extrapolated=entry.extrapolated,
        ),
        cost=ExpectedCost(predicted=entry.cost, limit=constraints.cost, month=month_text(entry.usd_per_month)),
        metrics=list(_expected_metrics(choice, row, entry)),
        baseline=_baseline(choice),
    )


def _baseline(choice: Choice) -> ExpectedBaseline | None:
    if choice.baseline is None:
        return None
    one = entry_of(choice, choice.baseline)
    return ExpectedBaseline(infra=one.infra, instance=one.instance, latency=one.latency, cost=one.cost)


def _expected_metrics(choice: Choice, row: int, entry: Entry) -> Iterator[ExpectedMetric]:
    for name, one in entry.metrics.items():
        met = None if one.limit is None else choice.metrics[name].probability_below(row, one.limit)
        yield ExpectedMetric(
            name=name,
            predicted=one.value,
            interval=one.interval,
            limit=one.limit,
            unit=one.unit,
            probability_met=_shown(met),
        )


def _shown(probability: float | None) -> float | None:
    """Return a probability as it is written: no model is certain."""
    return None if probability is None else floored(min(probability, MOST_CERTAIN))
