"""The spec a person writes, as types: one `Application` document for each partition of a robot's nodes.

Quantities are floats in base units (seconds, GiB, USD, USD per request, USD per hour), read from strings
such as `1.5s`, `64GiB` and `$2/1000 requests` (`fogspec.base.quantities`). Rules that concern several fields
live in `fogspec.spec.rules`, because pydantic skips a model's own validator as soon as one of its fields is wrong.
"""

import re
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import Field, PrivateAttr, SerializerFunctionWrapHandler, model_serializer

from fogspec.base.layout import DEFAULT_ENVIRONMENT
from fogspec.base.quantities import (
    Cost,
    CountRange,
    Duration,
    Memory,
    MemoryRange,
    Money,
    Percent,
    Price,
    Rate,
    Strict,
    Transfer,
    Until,
)

API_VERSION = "fogspec.dev/v1alpha1"

Name = Annotated[str, Field(pattern=r"^[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?$")]
NameInEnvironment = Annotated[
    str, Field(pattern=r"^[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?(@[a-z0-9]([-a-z0-9]{0,30}[a-z0-9])?)?$")
]
Identifier = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
Pattern = Annotated[str, Field(pattern=r"^[^\s\\!](.*[^\s\\])?$")]
Condition = Annotated[
    str, Field(pattern=r"^\s*(len\([A-Za-z_][\w.\[\]]*\)|[A-Za-z_][\w.\[\]]*)\s*(==|!=|<=|>=|<|>)\s*\S.*$")
]
ADDED = (
    "allow_substs",
    "prefix",
    "respawn",
    "respawn_delay",
    "composable_node_descriptions",
)  # to Node, after results were first written
Statistic = Literal["mean", "p50", "p95", "p99"]
Billing = Literal["busy", "provisioned"]
MachineClass = Literal["previous-generation", "burstable"]
Stage = Literal["plan", "estimate", "results", "choice"]


@dataclass(frozen=True, slots=True)
class Affects:
    """The stages that read a field, and the fields below it unless they declare their own."""

    stages: frozenset[Stage]


def affects(*stages: Stage) -> Affects:
    """Declare which stages read a field, so that a change of it makes these stale and no others.

    `plan`: which machines are measured, and how. `estimate`: what the plan may cost. `results`: what is measured.
    `choice`: models, menu and manifest. A field without stages is read by no file that is compiled.
    """
    return Affects(frozenset(stages))


class Metadata(Strict):
    """Names the application: its files, clusters and cloud labels."""

    name: Annotated[Name, affects("plan")] = Field(
        description="RFC 1123 label: names files, clusters and cloud labels", examples=["grasp-planning"]
    )


class ComposableNode(Strict):
    """One component of a container, in launch_ros' words."""

    package: str = Field(description="ROS 2 package that holds the component", examples=["image_proc"])
    plugin: str = Field(description="class of the component", examples=["image_proc::RectifyNode"])
    name: str | None = Field(None, description="node name, as in launch_ros", examples=["rectify"])
    namespace: str | None = Field(None, description="node namespace, as in launch_ros", examples=["/camera"])
    parameters: dict[str, Any] = Field({}, description="ROS 2 parameters", examples=[{"queue_size": 5}])
    parameter_files: list[str] = Field(
        [], description="ROS 2 parameter files, relative to the spec", examples=[["config/rectify.yaml"]]
    )
    allow_substs: bool = Field(
        False,
        description="whether launch replaces substitutions in the parameter files, as ParameterFile does",
        examples=[True],
    )
    remappings: dict[str, str] = Field(
        {}, description="topic and service names: from -> to", examples=[{"image": "image_raw"}]
    )
    extra_arguments: dict[str, Any] = Field(
        {}, description="extra arguments of the component", examples=[{"use_intra_process_comms": True}]
    )


class Node(Strict):
    """One process to start: a ROS 2 node in launch_ros' words, or with `cmd` a plain process.

    Texts may have launch's substitutions `$(find-pkg-share P)`, `$(find-pkg-prefix P)`, `$(env X)` and `$(command '...')`;
    they are replaced on the machine where the node starts.
    """

    package: str | None = Field(
        None, description="ROS 2 package that holds the executable", examples=["fogros2_examples"]
    )
    executable: str | None = Field(None, description="executable of the package", examples=["grasp_planning_node"])
    cmd: list[str] | None = Field(
        None,
        min_length=1,
        description="a plain process instead of a ROS 2 node: argv",
        examples=[["python3", "workloads/plan.py"]],
    )
    name: str | None = Field(None, description="node name, as in launch_ros", examples=["planner"])
    namespace: str | None = Field(None, description="node namespace, as in launch_ros", examples=["/arm"])
    parameters: dict[str, Any] = Field(
        {}, description="ROS 2 parameters, passed through untouched", examples=[{"model": "GQCNN-4.0-PJ", "gain": 38.0}]
    )
    parameter_files: list[str] = Field(
        [], description="ROS 2 parameter files, relative to the spec", examples=[["config/planner.yaml"]]
    )
    remappings: dict[str, str] = Field(
        {}, description="topic and service names: from -> to", examples=[{"/image_raw": "/camera/color/image"}]
    )
    arguments: list[str] = Field([], description="arguments appended to the command line", examples=[["--verbose"]])
    env: dict[str, str] = Field(
        {}, description="environment variables of this process", examples=[{"OMP_PROC_BIND": "true"}]
    )
    allow_substs: bool = Field(
        False,
        description="whether launch replaces substitutions in the parameter files, as ParameterFile does",
        examples=[True],
    )
    prefix: str | None = Field(
        None, description="command in front of the executable, as in launch_ros", examples=["nice -n 5"]
    )
    respawn: Literal[False, True, "always", "on_failure"] = Field(
        False,
        description="start the process again when it ends, as in launch_ros; true is always, on_failure only when its exit "
        "code is not 0; not while a sample is measured",
        examples=[True, "on_failure"],
    )
    respawn_delay: Duration | None = Field(
        None,
        gt=0,
        description="time until it is started again; in the cloud 1 s by default, and doubled for each restart in a row",
        examples=["2s"],
    )
    composable_node_descriptions: list[ComposableNode] = Field(
        [],
        description="components that run in this process, which is then a component container, as in launch_ros",
        examples=[[{"package": "image_proc", "plugin": "image_proc::RectifyNode"}]],
    )

    @model_serializer(mode="wrap")
    def _without_added(self, written: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Omit what later versions added while it is not set, so that digests of older results stay valid."""
        values: dict[str, Any] = written(self)
        return {key: value for key, value in values.items() if key not in ADDED or value}


class Ros(Strict):
    """The ROS 2 environment that is provisioned on the cloud machine."""

    distro: Literal["humble", "jazzy", "lyrical"] = Field("jazzy", description="ROS 2 distribution", examples=["jazzy"])
    image: str | None = Field(
        None,
        description="container image; pinned to its digest for deployment",
        examples=["docker.io/library/ros:jazzy"],
    )
    workspace: str | None = Field(
        None, description="colcon workspace, relative to the spec, built on the machine", examples=["ros2_ws"]
    )
    apt: list[str] = Field([], description="further Debian packages", examples=[["ros-jazzy-moveit"]])
    setup: list[str] = Field(
        [], description="shell lines that run after provisioning, once", examples=[["pip3 install --user gqcnn"]]
    )


class Probe(Strict):
    """How the latency of one request is measured: exactly one kind of probe."""

    request: str | None = Field(None, description="topic that carries the request", examples=["/camera/color/image"])
    response: str | None = Field(None, description="topic that carries the response", examples=["/RGBD/pose"])
    match: Literal["stamp", "order", "first_request", "last_response"] | None = Field(
        None, description="how a response finds its request; stamp unless said otherwise", examples=["stamp"]
    )
    service: str | None = Field(None, description="service name: latency of one call", examples=["/plan_path"])
    action: str | None = Field(
        None, description="action name: latency from goal to result", examples=["/navigate_to_pose"]
    )
    callback: Identifier | None = Field(
        None, description="name given to fogspec_probe.start and .stop in the node", examples=["plan"]
    )
    bag: str | None = Field(
        None,
        description="bag that the nodes record while a sample runs, relative to the spec, where both topics are read",
        examples=["run/bag"],
    )
    via: Literal["rclpy", "preload"] | None = Field(
        None,
        description="rclpy: a subscriber beside the nodes; preload: a library in the measured process, which sees services too",
        examples=["preload"],
    )
    timeout: Duration | None = Field(None, gt=0, description="a request that takes longer has failed", examples=["10s"])
    success: Condition | None = Field(
        None,
        description="condition on a field of the response: a request without it has failed",
        examples=["len(poses) > 0", "error_code.val == 1"],
    )


class Metric(Strict):
    """A measure of the application besides latency and cost; smaller is better."""

    topic: str | None = Field(None, description="topic that carries the value", examples=["/plan/result"])
    field: str | None = Field(None, description="field of the topic's message, dotted", examples=["path_cost"])
    callback: Identifier | None = Field(
        None, description="keyword given to fogspec_probe.stop in the node", examples=["path_length"]
    )
    unit: str | None = Field(None, description="unit of the value, for people", examples=["m"])


class Constraints(Strict):
    """Upper bounds, hard."""

    latency: Duration | None = Field(None, description="upper bound on the latency of one request", examples=["2s"])
    statistic: Statistic = Field(
        "mean", description="which statistic of the latency is bounded and optimised", examples=["p95"]
    )
    network_allowance: Duration = Field(
        0.0, description="allowance for the network, taken off the latency bound", examples=["30ms"]
    )
    cost: Cost | None = Field(None, description="upper bound on the cost of one request", examples=["$0.001/request"])
    price: Price | None = Field(None, description="upper bound on the machine's hourly price", examples=["$1.50/h"])
    metrics: dict[str, float] = Field(
        {}, description="upper bounds on the application's own metrics", examples=[{"path_length": 12.5}]
    )
    confidence: float = Field(
        0.9, gt=0, lt=1, description="probability with which the limits must be met", examples=[0.95]
    )


class Scale(Strict):
    """What latency and cost are divided by before they are weighed."""

    latency: Duration | None = Field(None, gt=0, description="latency that counts as 1", examples=["1s"])
    cost: Cost | None = Field(None, gt=0, description="cost that counts as 1", examples=["$1/1000 requests"])
    metric: float | None = Field(None, gt=0, description="value of the metric that counts as 1", examples=[10.0])


class Interruption(Strict):
    """What a spot machine's interruptions cost: requests that are run again, and the time until another machine serves."""

    rate: Rate = Field(
        0.05 / 3600,
        description="interruptions of one spot machine per hour; the default is a cautious guess",
        examples=["0.05/h"],
    )
    recovery_time: Duration = Field(
        300.0, ge=0, description="paid time until another machine is ready in its place", examples=["5min"]
    )


class Usage(Strict):
    """When a provisioned machine is up: in sessions, each after a start-up that is paid too."""

    session: Duration = Field(gt=0, description="how long the machine is used each time", examples=["20min"])
    sessions: Rate = Field(gt=0, description="how often it is used", examples=["1/week"])
    startup: Duration = Field(
        300.0, ge=0, description="paid time of each session until the machine is ready", examples=["3min"]
    )

    @property
    def up(self) -> float:
        """The fraction of all time for which the machine is paid."""
        return self.sessions * (self.session + self.startup)

    @property
    def used(self) -> float:
        """The fraction of all time in which it serves requests."""
        return self.sessions * self.session


class DataTransfer(Strict):
    """What the cloud charges for data, added to the cost of each request."""

    per_request: Memory = Field(0.0, ge=0, description="data charged for one request", examples=["2MB"])
    price: Transfer = Field(0.0, ge=0, description="what the cloud charges for it", examples=["$0.09/GiB"])


class Objective(Strict):
    """What is best: alpha x latency + (1 - alpha) x cost, both divided by their scales."""

    alpha: float = Field(0.5, ge=0, le=1, description="1 = only latency counts, 0 = only cost counts", examples=[0.7])
    metric: Identifier | None = Field(
        None, description="a metric of the application, in place of latency", examples=["path_length"]
    )
    method: Literal["exhaustive", "relaxed"] = Field(
        "exhaustive",
        description="exhaustive: the best of all machines; relaxed: the paper's optimum and its neighbours",
        examples=["relaxed"],
    )
    scale: Scale = Field(
        Scale.model_construct(),
        description="what latency and cost are divided by",
        examples=[{"latency": "1s", "cost": "$1/1000 requests"}],
    )
    billing: Billing = Field(
        "busy",
        description="busy: only the seconds of a request are paid; provisioned: all the time that the machine is up",
        examples=["provisioned"],
    )
    rate: Rate | None = Field(None, gt=0, description="requests per second, for provisioned billing", examples=["10/s"])
    usage: Usage | None = Field(
        None,
        description="when a provisioned machine is up; always if absent",
        examples=[{"session": "20min", "sessions": "1/week"}],
    )
    interruption: Interruption = Field(
        Interruption.model_construct(),
        description="what spot machines' interruptions add to their cost",
        examples=[{"rate": "0.05/h", "recovery_time": "5min"}],
    )
    transfer: DataTransfer = Field(
        DataTransfer.model_construct(),
        description="an allowance for data transfer, added to the cost of each request",
        examples=[{"per_request": "2MB", "price": "$0.09/GiB"}],
    )


class Machines(Strict):
    """Instance types allowed or denied, by name or with `*`, and classes that are not candidates unless included."""

    allow: list[str] = Field(
        [],
        description="only these instance types, whatever their class; `*` matches any text",
        examples=[["c6i.*", "m6i.*"]],
    )
    include: list[MachineClass] = Field(
        [],
        description="CPU machines that are left out by default: those of previous generations, and those whose CPU is "
        "guaranteed for part of the time only",
        examples=[["burstable", "previous-generation"]],
    )
    deny: list[str] = Field([], description="never these instance types; `*` matches any text", examples=[["*.metal"]])


class Hardware(Strict):
    """Which machines are admissible."""

    cpus: CountRange | None = Field(None, description="vCPUs", examples=["2..64"])
    memory: MemoryRange | None = Field(None, description="memory", examples=["4GiB..512GiB"])
    memory_per_cpu: MemoryRange | None = Field(None, description="memory per vCPU", examples=["2GiB..8GiB"])
    gpus: list[str] = Field(
        ["none"],
        min_length=1,
        description="GPU types allowed; none = machines without any accelerator",
        examples=[["none", "T4"]],
    )
    machines: Machines = Field(
        Machines.model_construct(),
        description="instance types allowed or denied",
        examples=[{"allow": ["c6i.*", "m6i.*"]}],
    )
    arch: list[Literal["x86_64", "arm64"]] = Field(
        ["x86_64"], min_length=1, description="CPU architectures allowed", examples=[["x86_64", "arm64"]]
    )
    spot: bool = Field(False, description="whether spot machines are allowed, beside on-demand ones", examples=[True])


class Stop(Strict):
    """When one sample has measured enough: whichever comes first."""

    requests: int | None = Field(200, ge=1, description="requests", examples=[200])
    duration: Duration = Field(300.0, gt=0, description="time", examples=["5min"])
    precision: Percent | None = Field(
        None, gt=0, description="half width of the statistic's 95% interval", examples=["2%"]
    )


class Workload(Strict):
    """What sends the requests while a sample is measured."""

    bag: str | None = Field(
        None, description="recorded bag, relative to the spec, played closed-loop", examples=["data/kitchen.mcap"]
    )
    rate: Rate | None = Field(None, gt=0, description="open-loop rate; closed-loop if absent", examples=["30/s"])
    node: Node | None = Field(None, description="the user's own client", examples=[{"cmd": ["python3", "client.py"]}])


class Volume(Strict):
    """The requests that the choice will serve: a sample must be expected to save its price on them."""

    requests_per_month: float = Field(gt=0, le=1e15, description="requests in a month of use", examples=[1000000])
    months: float = Field(
        12.0, gt=0, le=1200, description="months of use that the benchmark has to pay for itself", examples=[6]
    )

    @property
    def requests(self) -> float:
        """All of them."""
        return self.requests_per_month * self.months


class Waiver(Strict):
    """One change since the measurement that its results survive: from one value to one other, and no further.

    What is None was not there.
    """

    change: str = Field(
        min_length=1,
        description="what changed: a field under spec, a file that is sent to machines, or image",
        examples=["spec.cloud[0].env.LOG_LEVEL"],
    )
    old: Any = Field(
        None,
        description="its value when it was measured, of a file or image the digest; absent: it was not there",
        examples=["info"],
    )
    new: Any = Field(None, description="its value now; absent: it is not there", examples=["debug"])
    reason: str = Field(
        min_length=1,
        max_length=500,
        description="why the change cannot affect what was measured, for reviewers",
        examples=["log level only"],
    )

    @model_serializer(mode="wrap")
    def _without_absent(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        found: dict[str, Any] = dump(self)
        return {name: value for name, value in found.items() if value is not None}


class Benchmark(Strict):
    """How machines are sampled, and what that may cost."""

    budget: Annotated[Money | None, affects("estimate")] = Field(
        None,
        description="maximum benchmark spend; over-budget plans are rejected and runs are stopped",
        examples=["$2.50"],
    )
    sampler: Annotated[Literal["grid", "adaptive"], affects("plan")] = Field(
        "adaptive",
        description="which machines are sampled: adaptive asks the model for each next one; grid is the paper's",
        examples=["grid"],
    )
    volume: Annotated[Volume | None, affects("plan")] = Field(
        None,
        description="adaptive: sampling ends when a further sample is not expected to save its price on these requests",
        examples=[{"requests_per_month": 1000000, "months": 6}],
    )
    shapes: Annotated[Literal["own", "nested"], affects("plan")] = Field(
        "own",
        description="own: each machine is measured as it is; nested: also confined to its half, quarter and eighth, which "
        "inform about smaller machines",
        examples=["nested"],
    )
    servers: Annotated[int, affects("plan")] = Field(
        1,
        ge=1,
        le=6,
        description="adaptive: how many servers the chosen machine is measured on, each rented for it",
        examples=[2],
    )
    wall_time: Annotated[Duration | None, affects("plan")] = Field(
        None,
        gt=0,
        description="adaptive: longest time that sampling may take, each batch at its longest; it decides batch_size",
        examples=["1h"],
    )
    batch_size: Annotated[int | None, affects("plan")] = Field(
        None,
        ge=1,
        description="adaptive: how many machines are measured at once after the first batch; 1, or what wall_time needs",
        examples=[2],
    )
    machines: Annotated[list[str], affects("plan")] = Field(
        [],
        description="sample exactly these: instance types, or local/<n>cpu-<m>gib",
        examples=[["c6i.large", "c6i.4xlarge"]],
    )
    stop: Annotated[Stop, affects("plan")] = Field(
        Stop.model_construct(),
        description="when one sample has measured enough",
        examples=[{"requests": 200, "duration": "5min"}],
    )
    warmup: Annotated[int, affects("plan", "results")] = Field(
        1, ge=0, description="first requests of each sample that do not count", examples=[5]
    )
    setup_timeout: Annotated[Duration, affects("plan")] = Field(
        300.0, ge=0, description="longest time a machine may take to be ready", examples=["10min"]
    )
    workload: Annotated[Workload, affects("plan", "results")] = Field(
        Workload.model_construct(),
        description="what sends the requests",
        examples=[{"node": {"cmd": ["python3", "client.py"]}}],
    )
    scenarios: Annotated[dict[Identifier, Annotated[float, Field(gt=0)]], affects("plan", "results")] = Field(
        {},
        description="kinds of request and how often each occurs in use; the workload names them: stop(…, scenario=…)",
        examples=[{"open_space": 3, "narrow_door": 1}],
    )
    min_success_rate: Annotated[Percent, affects("plan", "results")] = Field(
        0.95, description="smallest share of requests that must succeed", examples=["99%"]
    )
    waivers: Annotated[list[Waiver], affects("choice")] = Field(
        [],
        max_length=32,
        description="changes since the measurement that its results survive, as fogspec status prints them",
        examples=[
            [{"change": "spec.cloud[0].env.LOG_LEVEL", "old": "info", "new": "debug", "reason": "log level only"}]
        ],
    )

    @property
    def is_adaptive(self) -> bool:
        """Whether the model selects the machines: a list of them comes before any sampler."""
        return self.sampler == "adaptive" and not self.machines


class CatalogAge(Strict):
    """What is asked of the catalog."""

    max_age: Duration = Field(
        365 * 86400.0,
        gt=0,
        description="compile warns of a catalog that is older; of the bundled one only if this is set",
        examples=["30d"],
    )


class Connectivity(Strict):
    """How robot and cloud are joined, and what passes besides what probe, metrics and remappings name."""

    link: Literal["none", "zenoh", "wireguard"] = Field(
        "none",
        description="none: joined by other means; zenoh: rmw_zenoh routers over mutual TLS; wireguard: a tunnel",
        examples=["zenoh"],
    )
    port: int | None = Field(
        None,
        ge=1,
        le=65535,
        description="port of the cloud machine; 7448 (TCP) for zenoh, 51820 (UDP) for wireguard",
        examples=[7448],
    )
    topics: list[str] = Field([], description="further topics that pass", examples=[["/tf", "/tf_static"]])
    services: list[str] = Field([], description="further services that pass", examples=[["/planner/get_parameters"]])
    actions: list[str] = Field([], description="further actions that pass", examples=[["/navigate_to_pose"]])
    sros2: bool = Field(
        False, description="write an SROS2 policy of the named nodes and these names as well", examples=[True]
    )


class Deployment(Strict):
    """How the cloud nodes are kept running once a manifest is approved."""

    ready: list[str] | None = Field(
        None,
        min_length=1,
        examples=[["python3", "answers.py"]],
        description="a command on the machine that succeeds once the nodes answer; without it they must stay alive",
    )
    ready_timeout: Duration = Field(
        1800.0, gt=0, description="longest time from the launch until the nodes answer", examples=["20min"]
    )
    fallbacks: int = Field(
        0,
        ge=0,
        le=5,
        examples=[2],
        description="how many other machines may take its place, best first, if the chosen one is unavailable",
    )
    until: Until | None = Field(
        None,
        examples=["8h", "2027-03-31T18:00:00Z"],
        description="when the deployment ends by itself: a time after apply, or a date with its time zone",
    )
    max_spend: Money | None = Field(
        None,
        gt=0,
        examples=["$25"],
        description="the most that its machines may cost from apply to down; the machine ends by itself before",
    )


class Spec(Strict):
    """What to offload, what it must meet, and what may be spent."""

    cloud: Annotated[list[Node], affects("plan", "results")] = Field(
        min_length=1,
        description="nodes that move to the cloud",
        examples=[[{"package": "fogros2_examples", "executable": "grasp_planning_node"}]],
    )
    robot: Annotated[list[Node], affects("choice")] = Field(
        [],
        description="nodes that stay on the robot",
        examples=[[{"package": "fogros2_examples", "executable": "grasp_planning_client"}]],
    )
    ros: Annotated[Ros | None, affects("plan", "results")] = Field(
        None,
        description="the ROS 2 environment on the cloud machine",
        examples=[{"distro": "jazzy", "workspace": "ros2_ws"}],
    )
    probe: Annotated[Probe, affects("plan", "results")] = Field(
        description="how the latency of one request is measured",
        examples=[{"request": "/grasp/depth_image", "response": "/grasp/candidates"}],
    )
    metrics: Annotated[dict[Identifier, Metric], affects("plan", "results", "choice")] = Field(
        {},
        description="measures of the application besides latency",
        examples=[{"path_length": {"callback": "path_length", "unit": "m"}}],
    )
    constraints: Annotated[Constraints, affects("choice")] = Field(
        Constraints.model_construct(),
        description="upper bounds, hard",
        examples=[{"latency": "2s", "cost": "$0.001/request"}],
    )
    objective: Annotated[Objective, affects("choice")] = Field(
        Objective.model_construct(),
        description="what is best among what meets the constraints",
        examples=[{"alpha": 0.7}],
    )
    hardware: Annotated[Hardware, affects("plan", "choice")] = Field(
        Hardware.model_construct(),
        description="which machines are admissible",
        examples=[{"cpus": "2..64", "gpus": ["none", "T4"]}],
    )
    infra: Annotated[list[str], affects("plan", "choice")] = Field(
        min_length=1,
        description="cloud, cloud/region or cloud/region/zone, as SkyPilot writes it",
        examples=[["aws/us-east-1"]],
    )
    catalog: Annotated[CatalogAge, affects()] = Field(
        CatalogAge.model_construct(),
        description="what is asked of the catalog of machines and prices",
        examples=[{"max_age": "30d"}],
    )
    benchmark: Benchmark = Field(
        Benchmark.model_construct(), description="how machines are sampled", examples=[{"budget": "$2.50"}]
    )
    connectivity: Annotated[Connectivity, affects("choice")] = Field(
        Connectivity.model_construct(), description="how robot and cloud are joined", examples=[{"link": "none"}]
    )
    deployment: Annotated[Deployment, affects("choice")] = Field(
        Deployment.model_construct(), description="how the cloud nodes are kept running", examples=[{"fallbacks": 2}]
    )
    ignore: Annotated[list[Pattern], affects("choice")] = Field(
        [],
        description="patterns of files in the spec's folder that are not sent to machines, besides those that never are: "
        "a name anywhere, or with a slash a path",
        examples=[["*.bag", "data/raw/", "/docs"]],
    )
    secrets: Annotated[list[Identifier], affects("plan", "results")] = Field(
        [], description="names of environment variables; values stay in no file", examples=[["API_KEY"]]
    )


class Application(Strict):
    """One partition of a robot's nodes; it gets one machine of its own."""

    apiVersion: Annotated[Literal["fogspec.dev/v1alpha1"], affects()] = Field(
        description="version of the spec schema", examples=["fogspec.dev/v1alpha1"]
    )
    kind: Annotated[Literal["Application"], affects()] = Field(
        description="kind of the document", examples=["Application"]
    )
    metadata: Metadata = Field(description="names the application", examples=[{"name": "grasp-planning"}])
    spec: Spec = Field(description="what to offload, what it must meet, and what may be spent")

    # No document says it: the name of the file in environments/ does.
    _environment: str = PrivateAttr(DEFAULT_ENVIRONMENT)

    @property
    def environment(self) -> str:
        """The environment that its overlay was merged for."""
        return self._environment

    @property
    def name(self) -> str:
        """The name, with `@` and the environment behind it unless that is the default one."""
        own = self._environment != DEFAULT_ENVIRONMENT
        return f"{self.metadata.name}@{self._environment}" if own else self.metadata.name

    def in_environment(self, environment: str) -> "Application":
        """Return this application as the one of an environment."""
        found = self.model_copy()
        found._environment = environment
        return found


LOCAL_SHAPE = re.compile(r"^local/(?P<cpus>[1-9]\d*)cpu-(?P<memory_gib>[1-9]\d*)gib$")


def local_shape(text: str) -> tuple[int, int] | None:
    """Return vCPUs and GiB of `local/<n>cpu-<m>gib`; None for any other machine."""
    match = LOCAL_SHAPE.match(text)
    return (int(match["cpus"]), int(match["memory_gib"])) if match else None
