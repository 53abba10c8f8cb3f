"""A node with a known busy time: a service, an action, or a topic that answers another. Writes how long it really took.

busy.py service|action|topic BUSY_S TRUTH_FILE [--depth N] [--die-after N] [--silent] [--fail-every N] [--hears TOPIC]
"""

import argparse
import contextlib
import json
import time

import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionServer
from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

parser = argparse.ArgumentParser()
parser.add_argument("kind", choices=("service", "action", "topic"))
parser.add_argument("busy_s", type=float)
parser.add_argument("truth")
parser.add_argument("--depth", type=int, default=100)
parser.add_argument("--watchers", type=int, default=0, help="answer only once so many listen")
parser.add_argument("--die-after", type=int)
parser.add_argument("--silent", action="store_true")
parser.add_argument("--fail-every", type=int)
parser.add_argument("--hears", action="append", default=[], help="topics that no node publishes")
options = parser.parse_args()
rclpy.init()
node = rclpy.create_node("busy")
done = 0


def work() -> bool:
    """Be busy, write down for how long; whether this request succeeds."""
    global done
    begun = time.monotonic()
    time.sleep(options.busy_s)
    done += 1
    with open(options.truth, "a") as file:
        file.write(json.dumps({"begun": begun, "busy_s": time.monotonic() - begun}) + "\n")
    if options.die_after and done >= options.die_after:
        raise SystemExit("the node gives up half-way")
    return not options.fail_every or done % options.fail_every != 0


def serve(_request, response):
    response.success = work()
    return response


def pursue(goal):
    good = work()
    (goal.succeed if good else goal.abort)()
    return Fibonacci.Result()


def answer(message: Imu) -> None:
    good = work()
    pose = PoseStamped()
    pose.header.stamp = Time(sec=message.header.stamp.sec, nanosec=message.header.stamp.nanosec)
    pose.pose.position.x = float(done)
    pose.pose.position.z = 1.0 if good else 0.0
    if not options.silent:
        publisher.publish(pose)


if options.kind == "service":
    node.create_service(Trigger, "/plan", serve)
elif options.kind == "action":
    ActionServer(node, Fibonacci, "/navigate", pursue)
else:
    publisher = node.create_publisher(PoseStamped, "/pose", 10)
    while publisher.get_subscription_count() < options.watchers:
        time.sleep(0.05)
    node.create_subscription(Imu, "/imu", answer, options.depth)
    for topic in options.hears:
        node.create_subscription(Imu, topic, answer, options.depth)
with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.spin(node)
