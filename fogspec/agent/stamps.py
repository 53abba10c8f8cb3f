"""The time that played messages say: their headers, wherever they are, and the clock of nodes with `use_sim_time`."""

import re
from typing import Any, cast

from .matching import HEADER
from .records import Stamp
from .ros import message_of, type_of

NESTED = re.compile(r"(\w+)/(\w+)")  # in what rclpy says of a field: sequence<geometry_msgs/TransformStamped>
SECOND, MOST_S = 10**9, 2**31 - 1
Headers = dict[str, Any]  # by the name of a field: None for headers, else those in it


def headers(message_type: Any) -> Headers:
    """Return the fields of a type in which there are headers."""
    found: Headers = {}
    for name, kind in message_type.get_fields_and_field_types().items():
        nested = NESTED.search(kind)
        if HEADER in kind:
            found[name] = None
        elif nested and (inner := headers(type_of(f"{nested[1]}/msg/{nested[2]}"))):
            found[name] = inner
    return found


def shift(message: Any, fields: Headers, by_ns: int) -> None:
    """Move the stamps of a message; those of 0, which say none, stay."""
    for name, inner in fields.items():
        value = getattr(message, name)
        for one in value if isinstance(value, (list, tuple)) else [value]:
            if inner is not None:
                shift(one, inner, by_ns)
            elif (at := shifted((one.stamp.sec, one.stamp.nanosec), by_ns)) is not None:
                one.stamp.sec, one.stamp.nanosec = at


def shifted(stamp: Stamp, by_ns: int) -> Stamp | None:
    """Return a stamp at another time, within what a stamp can say; None for one of 0."""
    at_ns = stamp[0] * SECOND + stamp[1]
    return divmod(min(max(at_ns + by_ns, 0), MOST_S * SECOND), SECOND) if at_ns else None


class Clock:
    """Gives the time, that of the new stamps, to nodes that have it from no other, as `ros2 bag play --clock` does."""

    TOPIC, LOOKED_S, EVERY_S = "/clock", 0.5, 0.01

    def __init__(self, node: Any) -> None:
        self.node, self.publisher = node, cast(Any, None)
        self.timer = node.create_timer(self.LOOKED_S, self.look)

    def look(self) -> None:
        """Begin if a node wants it, and none gives it."""
        if self.node.count_subscribers(self.TOPIC) and not self.node.count_publishers(self.TOPIC):
            self.timer.cancel()
            self.publisher = self.node.create_publisher(message_of("rosgraph_msgs/msg/Clock")[0], self.TOPIC, 10)
            self.timer = self.node.create_timer(self.EVERY_S, self.give)

    def give(self) -> None:
        """Give the time, if it is wanted; look no longer."""
        if self.publisher is None:
            self.timer.cancel()
            return
        message = self.publisher.msg_type()
        message.clock = self.node.get_clock().now().to_msg()
        self.publisher.publish(message)
