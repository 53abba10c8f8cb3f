"""Stable codes of the rules that concern several fields: FS5xx."""

from fogspec.spec.codes import Code

NODES = {
    "FS501": Code(
        "a node is a package and its executable, or a plain process",
        "ROS 2 nodes are started with launch_ros' own words; anything else with cmd, a list of arguments.",
        "cloud: [{package: planner}]",
        "cloud: [{package: planner, executable: planner_node}]",
    ),
    "FS502": Code(
        "a plain process has no ROS 2 words",
        "Parameters and remappings are ROS 2's; give a plain process its arguments in cmd.",
        "- {cmd: [python3, plan.py], parameters: {k: 1}}",
        "- {cmd: [python3, plan.py, '--k', '1']}",
    ),
    "FS503": Code(
        "ROS 2 nodes on the cloud need a ROS 2 environment",
        "spec.ros says which distribution, and optionally which image, workspace and packages the machine gets.",
        "cloud: [{package: a, executable: b}]",
        "ros: {distro: jazzy}\ncloud: [{package: a, executable: b}]",
    ),
    "FS504": Code(
        "two nodes must not have the same full name",
        "In ROS 2 a name in a namespace belongs to one node.",
        "- {package: a, executable: b, name: n}\n- {package: c, executable: d, name: n}",
        "- {package: a, executable: b, name: n}\n- {package: c, executable: d, name: m}",
    ),
    "FS505": Code(
        "topics and namespaces must have names that ROS 2 accepts",
        "Letters, digits, '_' and '/', also ~ at the start; no part starts with a digit or is empty.",
        "request: /camera/1/image",
        "request: /camera/left/image",
    ),
    "FS506": Code(
        "a ROS 2 parameter has one kind of value",
        "true or false, a whole number, a number, a text, or a list of one of these; 1 is a whole number and "
        "1.0 is not, and ROS 2 tells them apart.",
        "gains: [1, 0.5]",
        "gains: [1.0, 0.5]",
    ),
    "FS507": Code(
        "files are in the spec's folder, named relative to it",
        "Paths from the root of one computer mean nothing on another, and a machine gets the folder of the spec only.",
        "workspace: /home/me/ros2_ws",
        "workspace: ros2_ws",
    ),
    "FS508": Code(
        "a secret's value is in no file",
        "spec.secrets names environment variables whose values are taken from your environment at launch.",
        "secrets: [API_KEY]\ncloud: [{cmd: [plan], env: {API_KEY: abc}}]",
        "secrets: [API_KEY]\ncloud: [{cmd: [plan]}]",
    ),
    "FS509": Code(
        "private keys and credentials are in no spec",
        "A spec is in git, and what has been in git is known. Keys for the link are made by `fogspec keys` where they "
        "are used; other secrets are named in spec.secrets. Make a new one of what stood here. Its line is not shown.",
        "env: {CERT: '-----BEGIN PRIVATE KEY----- ...'}",
        "secrets: [CERT]",
    ),
    "FS510": Code(
        "each application has a name of its own",
        "The name is that of its files, clusters and cloud labels, so two applications of one name would "
        "overwrite one another.",
    ),
}

MEASURING = {
    "FS511": Code(
        "a probe is of exactly one kind",
        "Latency is response minus request of two topics, live or in a bag, of a service call, of an action, or of a callback "
        "in the code.",
        "probe: {}",
        "probe: {callback: plan}",
    ),
    "FS512": Code(
        "a request needs its response",
        "Latency is the difference between the two.",
        "probe: {request: /image}",
        "probe: {request: /image, response: /pose}",
    ),
    "FS513": Code(
        "request and response are different topics",
        "A message on one topic cannot be told from its own answer.",
        "probe: {request: /image, response: /image}",
        "probe: {request: /image, response: /pose}",
    ),
    "FS514": Code(
        "match is for topics",
        "It says how a response finds its request; a callback knows by itself.",
        "probe: {callback: plan, match: stamp}",
        "probe: {callback: plan}",
    ),
    "FS515": Code(
        "a metric is a topic's field, or a callback's keyword",
        "One of the two, whole.",
        "path_length: {topic: /plan}",
        "path_length: {callback: path_length}",
    ),
    "FS516": Code(
        "a callback metric needs a callback probe",
        "The value is handed to fogspec_probe.stop, which ends the request that the probe times.",
        "probe: {request: /a, response: /b}\nmetrics: {m: {callback: m}}",
        "probe: {callback: plan}\nmetrics: {m: {callback: m}}",
    ),
    "FS517": Code(
        "a metric that is named must exist",
        "Objective and limits name metrics of spec.metrics. Latency and cost are always there and have fields "
        "of their own.",
        "objective: {metric: path}",
        "metrics: {path: {callback: path}}\nobjective: {metric: path}",
    ),
    "FS518": Code(
        "provisioned billing goes with a rate",
        "The cost of one request is then the hour's price divided by the requests of an hour. Busy billing "
        "pays for the seconds of a request, whatever the rate.",
        "objective: {billing: provisioned}",
        "objective: {billing: provisioned, rate: 10/s}",
    ),
    "FS519": Code(
        "the latency limit must leave time for the request",
        "The network's allowance is taken off the limit.",
        "constraints: {latency: 50ms, network_allowance: 60ms}",
        "constraints: {latency: 100ms, network_allowance: 60ms}",
    ),
    "FS520": Code(
        "a sample must outlast one request",
        "With a limit on latency above stop.duration, a machine that meets the limit could not be measured.",
        "constraints: {latency: 10min}",
        "constraints: {latency: 10min}\nbenchmark: {stop: {duration: 30min}}",
    ),
    "FS521": Code(
        "a sample must measure more requests than it throws away",
        "The first warmup requests do not count.",
        "benchmark: {warmup: 10, stop: {requests: 10}}",
        "benchmark: {warmup: 10, stop: {requests: 100}}",
    ),
    "FS522": Code(
        "measuring needs a budget",
        "It is refused before when the plan would cost more, and stopped during. Only local samples need none.",
        "benchmark: {sampler: grid}",
        "benchmark: {sampler: grid, budget: $2.50}",
    ),
    "FS524": Code(
        "weighted scenarios need a callback probe",
        "Which kind a request is of only the workload knows: it says so to fogspec_probe.stop. Topics do not tell.",
        "probe: {request: /image, response: /pose}\nbenchmark: {scenarios: {easy: 3, hard: 1}}",
        "probe: {callback: plan}\nbenchmark: {scenarios: {easy: 3, hard: 1}}",
    ),
    "FS525": Code(
        "a way of watching cannot see everything",
        "A subscriber sees topics and the state of actions; a library in the node's process sees services too, but not into "
        "messages; what a callback counts as a success, it says itself.",
        "probe: {service: /plan, via: rclpy}",
        "probe: {service: /plan}",
    ),
    "FS526": Code(
        "requests come from a bag, or from a node",
        "A bag is played on the probe's request topic, or as calls of the probe's service, each after the response to the one "
        "before, or at a rate. A node sends what it likes.",
        "probe: {callback: plan}\nbenchmark: {workload: {bag: data/kitchen}}",
        "probe: {callback: plan}\nbenchmark: {workload: {node: {cmd: [python3, client.py]}}}",
    ),
    "FS527": Code(
        "a cost that would count for nothing",
        "Data transfer costs its amount times its price: both are needed. Interruptions are those of spot machines, which "
        "hardware must allow.",
        "objective: {transfer: {per_request: 2MB}}",
        "objective: {transfer: {per_request: 2MB, price: $0.09/GiB}}",
    ),
    "FS523": Code(
        "the topics are still those that init made up",
        "A sample would wait for a response that never comes, and the machine would be paid for. This is a warning.",
        "probe: {request: /request, response: /response}",
        "probe: {request: /camera/image, response: /pose}",
    ),
}

MACHINES = {
    "FS531": Code(
        "infra is cloud, cloud/region or cloud/region/zone",
        "In SkyPilot's words.",
        "infra: [us-east-1]",
        "infra: [aws/us-east-1]",
    ),
    "FS532": Code(
        "a GPU is named as SkyPilot names it",
        "A name that no machine has would rule out all of them. The count is not part of the name.",
        "gpus: [t4]",
        "gpus: [T4]",
    ),
    "FS533": Code(
        "an entry is there once",
        "The second was meant to be something else, or contradicts the first.",
        "gpus: [T4, T4]",
        "gpus: [none, T4]",
    ),
    "FS534": Code(
        "a sampled machine is one instance type, or a shape of this host",
        "Patterns choose what is admissible; a list of samples names each.",
        "machines: [c6i.*]",
        "machines: [c6i.large, local/2cpu-4gib]",
    ),
    "FS535": Code(
        "some machine must be possible",
        "The ranges of cpus, memory and memory_per_cpu contradict each other.",
        "hardware: {cpus: 64.., memory: ..64GiB, memory_per_cpu: 2GiB..}",
        "hardware: {cpus: 64.., memory: ..256GiB, memory_per_cpu: 2GiB..}",
    ),
}

LINKS = {
    "FS541": Code(
        "a link works with some ROS 2 environments",
        "zenoh runs rmw_zenoh's routers, so it needs spec.ros. wireguard relies on ROS_STATIC_PEERS, which ROS 2 has "
        "since Iron, and makes a network interface, which a container that SkyPilot starts is not allowed to.",
        "ros: {distro: humble}\nconnectivity: {link: wireguard}",
        "ros: {distro: humble}\nconnectivity: {link: zenoh}",
    ),
    "FS542": Code(
        "what passes is said for a link, a policy for nodes",
        "Names and a port mean nothing where there is no link, and SROS2 knows nodes by their names.",
        "connectivity: {topics: [/tf]}",
        "connectivity: {link: zenoh, topics: [/tf]}",
    ),
    "FS543": Code(
        "what passes the link has a whole name",
        "A link lets nothing pass but what is named. A name that begins with ~ or has a substitution in it is "
        "relative to a node, which the link does not know. Some name there must be.",
        "connectivity: {link: zenoh, topics: [~/debug]}",
        "connectivity: {link: zenoh, topics: [/planner/debug]}",
    ),
    "FS544": Code(
        "a link's port is opened by SkyPilot, or by you",
        "WireGuard needs a UDP port, and SkyPilot opens TCP ports only. Apply tells the command that opens it on AWS, GCP "
        "and Azure once it knows the machine's address. This is a warning.",
        "infra: [aws/us-east-1]\nconnectivity: {link: wireguard}",
        "infra: [aws/us-east-1]\nconnectivity: {link: zenoh}",
    ),
}
