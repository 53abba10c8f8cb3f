"""A graph of nodes with known times: graph.py GRAPH_JSON TRUTH_FILE. Each node has a thread and an executor of its own.

GRAPH_JSON is a list of nodes: {"node", then any of "sends", "answers", "latched", "serves", "acts", "calls"}. Truth is one line
of JSON for each response: when its request was sent, and when it was sent itself, in ns of the wall clock.
"""

import contextlib
import json
import random
import sys
import threading
import time

import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionClient, ActionServer
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from std_msgs.msg import String
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

KINDS = {"image": Image, "pose": PoseStamped, "text": String}
graph = json.loads(sys.argv[1])
truth = open(sys.argv[2], "a", buffering=1)  # noqa: SIM115 - as long as the robot runs
dice = random.Random(7)
rclpy.init()


def quality(part):
    reliability = ReliabilityPolicy.BEST_EFFORT if part.get("best_effort") else ReliabilityPolicy.RELIABLE
    return QoSProfile(depth=part.get("depth", 50), reliability=reliability)


def message(part, stamp=None):
    """A message that says when it is sent; its stamp is that time, or another's, or none."""
    now = time.time_ns()
    stamp = now if stamp is None else stamp
    if part["kind"] == "text":
        return now, String(data=f"{now}:" + "x" * part.get("size", 10))
    made = KINDS[part["kind"]]()
    made.header.stamp = Time(sec=stamp // 10**9, nanosec=stamp % 10**9)
    made.header.frame_id = str(now)
    if part["kind"] == "image":
        made.data = bytes(part.get("size", 1000))
    return now, made


def sent_ns(one):
    return int(one.data.partition(":")[0] if isinstance(one, String) else one.header.frame_id)


def stamp_ns(one):
    return None if isinstance(one, String) else one.header.stamp.sec * 10**9 + one.header.stamp.nanosec


def sends(node, part):
    """Publish at a rate: by a timer, or at random intervals; some messages are lost on the way out."""
    publishers = [
        (node.create_publisher(KINDS[one["kind"]], one["topic"], quality(one)), one) for one in part["topics"]
    ]
    jitter_s = part.get("jitter", 0.0)

    def tick():
        if jitter_s:
            time.sleep(dice.random() * jitter_s)
        if dice.random() < part.get("loss", 0.0):
            return
        stamp = time.time_ns()
        for publisher, one in publishers:
            publisher.publish(message(one, stamp)[1])

    if not part.get("random"):
        node.create_timer(1 / part["rate"], tick)
        return

    def forever():
        while rclpy.ok():
            time.sleep(dice.expovariate(part["rate"]))
            tick()

    threading.Thread(target=forever, daemon=True).start()


def answers(node, part):
    """Answer each message after a known time; or only some, or out of order, or with a stamp of its own."""
    out = node.create_publisher(KINDS[part["kind"]], part["response"], quality(part))

    def work(one):
        if dice.random() < part.get("loss", 0.0):
            return
        time.sleep(part["busy"] * dice.uniform(1 - part.get("spread", 0.0), 1 + part.get("spread", 0.0)))
        now, answer = message(part, stamp_ns(one) if part.get("stamp", True) else None)
        out.publish(answer)
        truth.write(json.dumps([part["request"], part["response"], sent_ns(one), now]) + "\n")

    def begin(one):
        if part.get("threads"):
            threading.Thread(target=work, args=(one,), daemon=True).start()
        else:
            work(one)

    node.create_subscription(KINDS[part["of"]], part["request"], begin, quality(part))
    for topic, kind in part.get("also", {}).items():
        node.create_subscription(KINDS[kind], topic, lambda _: None, 10)


def latched(node, part):
    """Publish once, for those who come later too."""
    stays = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE)
    node.kept = node.create_publisher(KINDS[part["kind"]], part["topic"], stays)
    node.kept.publish(message(part)[1])


def serves(node, part):
    """Offer a service, and if asked publish the events of its calls."""
    from rclpy.qos import qos_profile_services_default
    from rclpy.service_introspection import ServiceIntrospectionState

    def serve(_request, response):
        begun = time.time_ns()
        time.sleep(part["busy"])
        truth.write(json.dumps([part["service"], part["service"], begun, time.time_ns()]) + "\n")
        return response

    service = node.create_service(Trigger, part["service"], serve)
    if part.get("introspected"):
        state = ServiceIntrospectionState.METADATA
        service.configure_introspection(node.get_clock(), qos_profile_services_default, state)


def acts(node, part):
    """Offer an action."""

    begins = []

    def accepted(goal):
        begins.append(time.time_ns())
        goal.execute()

    def pursue(goal):
        begun = begins.pop(0)
        time.sleep(part["busy"])
        truth.write(json.dumps([part["action"], part["action"], begun, time.time_ns()]) + "\n")
        goal.succeed()
        return Fibonacci.Result()

    node.server = ActionServer(node, Fibonacci, part["action"], pursue, handle_accepted_callback=accepted)


def calls(node, part):
    """Call a service or an action now and then."""
    if "service" in part:
        client = node.create_client(Trigger, part["service"])
        node.create_timer(part["every"], lambda: client.service_is_ready() and client.call_async(Trigger.Request()))
    else:
        client = ActionClient(node, Fibonacci, part["action"])
        node.create_timer(part["every"], lambda: client.server_is_ready() and client.send_goal_async(Fibonacci.Goal()))


nodes = []
for entry in graph:
    node = rclpy.create_node(entry["node"])
    for name, value in entry.get("parameters", {}).items():
        node.declare_parameter(name, value)
    for role in (sends, answers, latched, serves, acts, calls):
        for part in entry.get(role.__name__, []):
            role(node, part)
    executor = MultiThreadedExecutor(2) if entry.get("acts") else SingleThreadedExecutor()
    executor.add_node(node)
    nodes.append(threading.Thread(target=executor.spin, daemon=True))
for one in nodes:
    one.start()
print("ready", flush=True)
with contextlib.suppress(KeyboardInterrupt):
    threading.Event().wait()
