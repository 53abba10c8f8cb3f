"""Real rclpy over the tunnel: a service with a known time of work, its client.

tunnel.py serve WORK_S          service /plan, until it is told to end
tunnel.py ask COUNT PATIENCE_S  round trips of /plan in seconds; [] when nobody answers in time
tunnel.py echo                  sends every /image back on /pose
tunnel.py times COUNT BYTES     round trips of an image of that size, in seconds
"""

import contextlib
import json
import sys
import time

import rclpy
from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger


def serve(words: list[str]) -> None:
    node = rclpy.create_node("planner")

    def answer(_request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        time.sleep(float(words[0]))
        response.success = True
        return response

    node.create_service(Trigger, "/plan", answer)
    print("up", flush=True)
    rclpy.spin(node)


def ask(words: list[str]) -> None:
    node, took = rclpy.create_node("client"), []
    client = node.create_client(Trigger, "/plan")
    if client.wait_for_service(timeout_sec=float(words[1])):
        for _ in range(int(words[0]) + 2):
            begun = time.perf_counter()
            future = client.call_async(Trigger.Request())
            rclpy.spin_until_future_complete(node, future, timeout_sec=float(words[1]))
            if not future.done():
                break
            took.append(time.perf_counter() - begun)
    print(json.dumps(took[2:]))


def echo(words: list[str]) -> None:
    node = rclpy.create_node("echo")
    publisher = node.create_publisher(Image, "/pose", 5)
    node.create_subscription(Image, "/image", publisher.publish, 5)
    print("up", flush=True)
    rclpy.spin(node)


def times(words: list[str]) -> None:
    node, took, back = rclpy.create_node("client"), [], []
    publisher = node.create_publisher(Image, "/image", 5)
    node.create_subscription(Image, "/pose", back.append, 5)
    while not (publisher.get_subscription_count() and node.count_publishers("/pose")):
        rclpy.spin_once(node, timeout_sec=0.1)
    time.sleep(1)
    message = Image(data=bytes(int(words[1])))
    for _ in range(int(words[0]) + 5):
        begun = time.perf_counter()
        publisher.publish(message)
        while not back:
            if time.perf_counter() - begun > 20:
                sys.exit("no answer")
            rclpy.spin_once(node, timeout_sec=0.1)
        took.append(time.perf_counter() - begun)
        back.clear()
    print(json.dumps(took[5:]))


if __name__ == "__main__":
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        globals()[sys.argv[1]](sys.argv[2:])
