"""Words without stamps: `talk RATE` sends them, `answer SECONDS` answers each so much later, several at once."""

import sys
import threading
import time

import rclpy
from std_msgs.msg import String

kind, number = sys.argv[1], float(sys.argv[2])
rclpy.init()
node = rclpy.create_node(kind)
publisher = node.create_publisher(String, "/words" if kind == "talk" else "/said", 100)


def later(word: String) -> None:
    threading.Timer(number, publisher.publish, (word,)).start()


if kind == "answer":
    node.create_subscription(String, "/words", later, 100)
    rclpy.spin(node)
begun_s, sent = time.monotonic(), 0
while True:
    publisher.publish(String(data=str(sent)))
    sent += 1
    time.sleep(max(0.0, begun_s + sent / number - time.monotonic()))
