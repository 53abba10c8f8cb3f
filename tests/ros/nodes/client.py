"""Sends requests: closed-loop, or open-loop at a rate.

client.py service|action|topic COUNT [--rate R]
"""

import argparse
import time

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionClient
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

parser = argparse.ArgumentParser()
parser.add_argument("kind", choices=("service", "action", "topic"))
parser.add_argument("count", type=int)
parser.add_argument("--rate", type=float)
parser.add_argument("--watchers", type=int, default=0)
parser.add_argument("--limit", type=float, default=60.0)
options = parser.parse_args()
rclpy.init()
node = rclpy.create_node("client")
answers = 0


def answered(_answer) -> None:
    global answers
    answers += 1


if options.kind == "service":
    client = node.create_client(Trigger, "/plan")
    client.wait_for_service(20)

    def send() -> None:
        client.call_async(Trigger.Request()).add_done_callback(answered)

elif options.kind == "action":
    client = ActionClient(node, Fibonacci, "/navigate")
    client.wait_for_server(20)

    def send() -> None:
        def accepted(future) -> None:
            future.result().get_result_async().add_done_callback(answered)

        client.send_goal_async(Fibonacci.Goal()).add_done_callback(accepted)

else:
    publisher = node.create_publisher(Imu, "/imu", 100)
    node.create_subscription(PoseStamped, "/pose", answered, 100)
    while publisher.get_subscription_count() < 1 or node.count_publishers("/pose") < 1:
        rclpy.spin_once(node, timeout_sec=0.1)

    def send() -> None:
        message = Imu()
        message.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(message)


watched = {"service": (), "action": ("/navigate/_action/status",), "topic": ("/imu", "/pose")}[options.kind]
own = 0 if options.kind == "service" else 1
while any(node.count_subscribers(topic) < options.watchers + own for topic in watched):
    rclpy.spin_once(node, timeout_sec=0.1)
time.sleep(4.0 if options.watchers else 0.5)  # until everybody knows of everybody
begun, sent = time.monotonic(), 0
while answers < options.count and time.monotonic() - begun < options.limit:
    if sent < options.count and (time.monotonic() >= begun + sent / options.rate if options.rate else sent == answers):
        send()
        sent += 1
    rclpy.spin_once(node, timeout_sec=0.001 if options.rate else 0.1)
print(f"sent {sent}, answered {answers}", flush=True)
