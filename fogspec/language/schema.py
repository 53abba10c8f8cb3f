"""The spec a person writes, as types: one `Application` document for each partition of a robot's nodes.

Quantities are floats in base units (seconds, GiB, USD, USD per request, USD per hour), read from strings
such as `1.5s`, `64GiB` and `$2/1000 requests` (`fogspec.base.quantities`). Rules that concern several fields
live in `fogspec.language.rules`, because pydantic skips a model's own validator as soon as one of its fields is wrong.
"""

import re
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, PrivateAttr, SerializerFunctionWrapHandler, model_serializer

from fogspec.base.clouds import LOCAL
from fogspec.base.layout import DEFAULT_ENVIRONMENT
from fogspec.base.quantities import (
    Confidence,
    Cost,
    CountRange,
    Duration,
    Lean,
    MemoryRange,
    Money,
    Percent,
    Price,
    Rate,
    Spot,
    Strict,
    Until,
)
from fogspec.base.units import parse_until

API_VERSION = "fogspec.dev/v1alpha1"

Name = Annotated[str, Field(pattern=r"^[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?$")]
NameInEnvironment = Annotated[
    str, Field(pattern=r"^[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?(@[a-z0-9]([-a-z0-9]{0,30}[a-z0-9])?)?$")
]
Identifier = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
Condition = Annotated[
    str, Field(pattern=r"^\s*(len\([A-Za-z_][\w.\[\]]*\)|[A-Za-z_][\w.\[\]]*)\s*(==|!=|<=|>=|<|>)\s*\S.*$")
]
ADDED = ("launch", "composable_node_descriptions")  # to Node, after results were first written
INTERRUPTIONS_PER_S = 0.05 / 3600
Statistic = Literal["mean", "p50", "p95", "p99"]
Billing = Literal["busy", "provisioned"]
MachineClass = Literal["previous-generation", "burstable", "low-memory", "bare-metal"]
Sampler = Literal["grid", "adaptive", "list"]
STANDARD = "standard"  # machines of no such class
NO_LIBRARY = "none"
CLASSES = (STANDARD, *get_args(MachineClass))
Stage = Literal["plan", "estimate", "results", "choice"]


@dataclass(frozen=True, slots=True)
class Affects:
    """The stages that read a field, and the fields below it unless they declare their own."""

    stages: frozenset[Stage]


@dataclass(frozen=True, slots=True)
class Tier:
    """Whom a field is for; fields without one are advanced."""

    name: str


BASIC = Tier("basic")  # what a first spec has


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


AUTOSTART = (
    "whether fogspec configures and activates it, a managed node, when it starts, as in launch_ros; needs a name"
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
        {},
        description="topic and service names: from -> to; of those that match a name, the first counts",
        examples=[{"image": "image_raw"}],
    )
    extra_arguments: dict[str, Any] = Field(
        {}, description="extra arguments of the component", examples=[{"use_intra_process_comms": True}]
    )
    autostart: bool = Field(False, description=AUTOSTART, examples=[True])


class Launch(Lean):
    """How launch starts a process, in the words of launch_ros."""

    allow_substs: bool = Field(
        False,
        description="whether launch replaces substitutions in the parameter files, as ParameterFile does",
        examples=[True],
    )
    autostart: bool = Field(False, description=AUTOSTART, examples=[True])
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
        {},
        description="topic and service names: from -> to; of those that match a name, the first counts",
        examples=[{"/image_raw": "/camera/color/image"}],
    )
    arguments: list[str] = Field([], description="arguments appended to the command line", examples=[["--verbose"]])
    env: dict[str, str] = Field(
        {}, description="environment variables of this process", examples=[{"OMP_PROC_BIND": "true"}]
    )
    launch: Launch = Field(
        Launch.model_construct(),
        description="how launch starts the process, in the words of launch_ros",
        examples=[{"prefix": "nice -n 5", "respawn": True}],
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


# The code name of the Ubuntu of each distribution (REP 2000).
UBUNTU = {"humble": "jammy", "jazzy": "noble", "kilted": "noble", "lyrical": "resolute", "rolling": "resolute"}


class Ros(Strict):
    """The ROS 2 environment that is provisioned on the cloud machine."""

    distro: Literal["humble", "jazzy", "kilted", "lyrical", "rolling"] = Field(
        "jazzy", description="ROS 2 distribution", examples=["jazzy"]
    )
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
    env: dict[Identifier, str] = Field(
        {},
        description="environment variables of the whole ROS 2 graph there, the probe's as the nodes', where no link sets them; "
        "of a sample, domain and discovery are its own",
        examples=[{"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}],
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

    latency: Annotated[Duration | None, BASIC] = Field(
        None, description="upper bound on the latency of one request", examples=["2s"]
    )
    statistic: Statistic = Field(
        "mean", description="which statistic of the latency is bounded and optimised", examples=["p95"]
    )
    network_allowance: Duration = Field(
        0.0, description="allowance for the network, taken off the latency bound", examples=["30ms"]
    )
    cost: Annotated[Cost | None, BASIC] = Field(
        None, description="upper bound on the cost of one request", examples=["$0.001/request"]
    )
    price: Price | None = Field(
        None, description="upper bound on the machine's hourly price, without disk and address", examples=["$1.50/h"]
    )
    metrics: dict[str, float] = Field(
        {}, description="upper bounds on the application's own metrics", examples=[{"path_length": 12.5}]
    )
    confidence: Confidence = Field(
        0.9,
        description="probability with which another server of the type must meet the limits: at 0.9 a measured machine needs "
        "room of some 5% below the limit on AWS, of 10% on Azure; with none, predicted values decide",
        examples=[0.95],
    )


class Scale(Strict):
    """What latency and cost are divided by before they are weighed."""

    latency: Duration | None = Field(None, gt=0, description="latency that counts as 1", examples=["1s"])
    cost: Cost | None = Field(None, gt=0, description="cost that counts as 1", examples=["$1/1000 requests"])
    metric: float | None = Field(None, gt=0, description="value of the metric that counts as 1", examples=[10.0])


class Load(Strict):
    """The requests that a machine serves which is paid all the time that it is up: always, or in sessions."""

    rate: Rate = Field(gt=0, description="requests while it is used", examples=["10/s"])
    session: Duration | None = Field(
        None,
        gt=0,
        description="how long it is used each time, after a start-up; always if absent, and paid always unless "
        "deployment.until ends it by then",
        examples=["20min"],
    )
    sessions: Rate | None = Field(None, gt=0, description="how often it is used", examples=["1/week"])

    @property
    def used(self) -> float:
        """The fraction of all time in which the machine serves requests."""
        return self.up(0.0)

    def up(self, startup_s: float) -> float:
        """Return the fraction of all time for which the machine is paid, a start-up of each session included."""
        return self.sessions * (self.session + startup_s) if self.session and self.sessions else 1.0


class Objective(Strict):
    """What is best: alpha x latency + (1 - alpha) x cost, both divided by their scales."""

    alpha: Annotated[float, BASIC] = Field(
        0.5, ge=0, le=1, description="1 = only latency counts, 0 = only cost counts", examples=[0.7]
    )
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
    load: Load | None = Field(
        None,
        description="requests per second at which the latency is bounded, and that share the price of all the time that the "
        "machine is up; if absent, requests come one after the other, and only their seconds are paid",
        examples=[{"rate": "10/s"}, {"rate": "10/s", "session": "20min", "sessions": "1/week"}],
    )
    transfer: Cost = Field(
        0.0,
        ge=0,
        description="what the cloud charges for the data of one request, added to its cost",
        examples=["$0.18/1000 requests"],
    )

    @property
    def billing(self) -> Billing:
        """`busy`: only the seconds of a request are paid; `provisioned`: all the time that the machine is up."""
        return "busy" if self.load is None else "provisioned"


class Hardware(Strict):
    """Which machines are admissible."""

    cpus: CountRange | None = Field(None, description="vCPUs", examples=["2..64"])
    memory: MemoryRange | None = Field(None, description="memory", examples=["4GiB..512GiB"])
    memory_per_cpu: MemoryRange | None = Field(None, description="memory per vCPU", examples=["2GiB..8GiB"])
    gpus: list[str] = Field(
        ["none"],
        min_length=1,
        description="GPUs allowed: T4 = machines with one T4, T4:4 = with four; none = machines without any accelerator",
        examples=[["none", "T4"], ["T4:4"]],
    )
    allow: list[str] = Field(
        [STANDARD],
        min_length=1,
        description="only these machines: instance types, where * matches any text, or classes: burstable (a CPU that is "
        "guaranteed for part of the time only), previous-generation, low-memory (a virtual machine with less than 4 GiB, of "
        "which SkyPilot takes up to 1), bare-metal (which boots for 5 to 15 minutes), and standard, all others",
        examples=[["c6i.*", "m6i.*"], [STANDARD, "burstable"]],
    )
    deny: list[str] = Field(
        [], description="never these: instance types or classes, as in allow", examples=[["*.metal"]]
    )
    arch: list[Literal["x86_64", "arm64"]] = Field(
        ["x86_64"], min_length=1, description="CPU architectures allowed", examples=[["x86_64", "arm64"]]
    )
    spot: Spot = Field(
        False,
        description="whether spot machines are allowed, beside on-demand ones; a rate is how often one is interrupted, 0.05/h "
        "if it is only true",
        examples=[True, "0.1/h"],
    )
    startup: Annotated[Duration, affects("choice")] = Field(
        300.0,
        ge=0,
        description="paid time until a machine is ready: of each session, and after an interruption of a spot machine",
        examples=["3min"],
    )

    @property
    def search_space(self) -> "Hardware":
        """Itself without what only a cost depends on: how often spot machines are interrupted, and start-ups."""
        startup_s = Hardware.model_fields["startup"].default
        return self.model_copy(update={"spot": self.spot is not False, "startup": startup_s})

    @property
    def interruptions_per_s(self) -> float:
        """How often a spot machine is interrupted; a cautious guess if the spec has none, 0 without spot machines."""
        return INTERRUPTIONS_PER_S if self.spot is True else float(self.spot)


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


class Waiver(Lean):
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


class Benchmark(Strict):
    """How machines are sampled, and what that may cost."""

    budget: Annotated[Money | None, affects("estimate"), BASIC] = Field(
        None,
        description="maximum benchmark spend; over-budget plans are rejected and runs are stopped",
        examples=["$2.50"],
    )
    sampler: Annotated[Literal["grid", "adaptive"], affects("plan")] = Field(
        "adaptive",
        description="which machines are sampled: adaptive asks the model for each next one; grid is the paper's",
        examples=["grid"],
    )
    servers: Annotated[int, affects("plan")] = Field(
        1,
        ge=1,
        le=6,
        description="adaptive: how many servers the chosen machine is measured on, each rented for it",
        examples=[2],
    )
    batch_size: Annotated[int, affects("plan")] = Field(
        3,
        ge=1,
        description="adaptive: how many machines are measured at once after the first batch",
        examples=[1],
    )
    machines: Annotated[list[str], affects("plan")] = Field(
        [],
        description="sample exactly these: instance types that the spec admits, or local/<n>cpu-<m>gib",
        examples=[["c6i.large", "c6i.4xlarge"]],
    )
    stop: Annotated[Stop, affects("plan")] = Field(
        Stop.model_construct(),
        description="when one sample has measured enough",
        examples=[{"requests": 200, "duration": "5min"}],
    )
    warmup: Annotated[int, affects("plan", "results")] = Field(
        1, ge=0, description="first requests of each process that do not count", examples=[5]
    )
    ready_timeout: Annotated[Duration, affects("plan")] = Field(
        300.0, ge=0, description="longest time a machine may take to be ready", examples=["10min"]
    )
    workload: Annotated[Workload, affects("plan", "results"), BASIC] = Field(
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


class Connectivity(Strict):
    """How robot and cloud are joined, and what passes besides what probe, metrics and remappings name."""

    link: Annotated[Literal["none", "zenoh", "wireguard"], BASIC] = Field(
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
    expose: dict[str, Literal["topic", "service", "action"]] = Field(
        {}, description="further names that pass, and what each is", examples=[{"/tf": "topic", "/plan": "service"}]
    )

    def exposed(self, kind: str) -> list[str]:
        """Return the further names that pass and are of this kind."""
        return [name for name, its in self.expose.items() if its == kind]

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
    budget: Money | None = Field(
        None,
        gt=0,
        examples=["$25"],
        description="the most that its machines may cost from apply to down; the machine ends by itself before",
    )


class Spec(Strict):
    """What to offload, what it must meet, and what may be spent."""

    cloud: Annotated[list[Node], affects("plan", "results"), BASIC] = Field(
        min_length=1,
        description="nodes that move to the cloud",
        examples=[[{"package": "fogros2_examples", "executable": "grasp_planning_node"}]],
    )
    robot: Annotated[list[Node], affects("choice"), BASIC] = Field(
        [],
        description="nodes that stay on the robot",
        examples=[[{"package": "fogros2_examples", "executable": "grasp_planning_client"}]],
    )
    ros: Annotated[Ros | None, affects("plan", "results"), BASIC] = Field(
        None,
        description="the ROS 2 environment on the cloud machine",
        examples=[{"distro": "jazzy", "workspace": "ros2_ws"}],
    )
    probe: Annotated[Probe, affects("plan", "results"), BASIC] = Field(
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
    hardware: Annotated[Hardware, affects("plan", "choice"), BASIC] = Field(
        Hardware.model_construct(),
        description="which machines are admissible",
        examples=[{"cpus": "2..64", "gpus": ["none", "T4"]}],
    )
    infra: Annotated[list[str], affects("plan", "choice"), BASIC] = Field(
        min_length=1,
        description="cloud, cloud/region or cloud/region/zone, as SkyPilot writes it",
        examples=[["aws/us-east-1"]],
    )
    max_price_age: Annotated[Duration | None, affects()] = Field(
        None,
        gt=0,
        description="compile warns of prices that are older; a year if absent, and never of the bundled list",
        examples=["30d"],
    )
    library: Annotated[str | None, affects("choice")] = Field(
        None,
        min_length=1,
        description="how fast other programs are on many machines, so that fewer samples suffice: fogspec's own library if "
        "absent, none, or a file of fogspec-lab library, relative to the spec",
        examples=["none"],
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
    files: Annotated[list[str] | None, affects("choice")] = Field(
        None,
        description="files and directories next to the spec that machines receive; by default the whole directory of the "
        "spec. Specs that share a directory must each name theirs",
        examples=[["work.py", "config/"]],
    )
    secrets: Annotated[list[Identifier], affects("plan", "results")] = Field(
        [], description="names of environment variables; values stay in no file", examples=[["API_KEY"]]
    )

    @property
    def ends_sessions(self) -> bool:
        """Whether the machine ends by itself by the end of each session, counted from `apply`."""
        load, until = self.objective.load, self.deployment.until
        end = None if until is None else parse_until(until)
        session = None if load is None else load.session
        return session is not None and isinstance(end, float) and end <= session + self.hardware.startup

    @property
    def up(self) -> float:
        """The fraction of all time for which the machine is paid: always, unless something ends it after each session."""
        load = self.objective.load
        return load.up(self.hardware.startup) if load is not None and self.ends_sessions else 1.0

    @property
    def sampler(self) -> Sampler:
        """How machines are sampled: a list of them comes before any sampler, and of this host every shape is measured."""
        benchmark = self.benchmark
        here = self.infra == [LOCAL] and benchmark.sampler == "adaptive"
        return "list" if benchmark.machines or here else benchmark.sampler


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
