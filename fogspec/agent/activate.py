"""Configure and activate managed nodes, as launch's `autostart` does, and again those that were started again.

    python3 agent.pyz activate --of /arm/planner --of /tracker

A node is given by its full name. One that was active and was deactivated on purpose stays so. It never ends by itself.
"""

import argparse
import contextlib
import sys
import time
from collections.abc import Sequence
from functools import partial
from typing import Any, cast

from .causes import ACTIVE
from .ros import need_rclpy

LOOKED_S = 0.25
AGAIN_S, AGAIN_AT_MOST_S = 0.5, 30.0  # after a transition, doubled for each that failed in a row
ACTIVE_S = 2.0  # between two looks at a node that is active
ANSWER_S = 5.0  # a node that configures may not answer before it has
UNCONFIGURED, INACTIVE, FINALIZED = 1, 2, 4  # of lifecycle_msgs/msg/State
NEXT = {UNCONFIGURED: (1, "configured"), INACTIVE: (3, "activated")}  # with ids of lifecycle_msgs/msg/Transition


class Activated:
    """A node that is to be active."""

    def __init__(self, node: Any, name: str) -> None:
        from lifecycle_msgs.srv import ChangeState, GetState

        self.name, self.request, self.change = name, GetState.Request, ChangeState.Request
        self.states = node.create_client(GetState, f"{name}/get_state")
        self.changes = node.create_client(ChangeState, f"{name}/change_state")
        self.wanted, self.failures, self.state = True, 0, 0
        self.due_s, self.asked = 0.0, cast(Any, None)

    def look(self) -> None:
        """Ask for its state when that is due."""
        now_s = time.monotonic()
        if now_s >= self.due_s and self.states.service_is_ready() and self.changes.service_is_ready():
            self.due_s, self.asked = now_s + ANSWER_S, self.states.call_async(self.request())
            self.asked.add_done_callback(self.take)

    def take(self, asked: Any) -> None:
        """Take its state, and have it changed if it is not the one that is wanted."""
        if asked is not self.asked or asked.result() is None:
            return  # the answer to an earlier question, which came too late
        state = asked.result().current_state.id
        if state == FINALIZED != self.state:
            self.say("is finalized: it has to be started again")
        self.state = state
        # A node starts unconfigured. One that was active and is inactive was deactivated on purpose.
        self.wanted = state == UNCONFIGURED or (self.wanted and state != ACTIVE)
        if not self.wanted or state not in NEXT:
            self.due_s = time.monotonic() + (AGAIN_S if self.wanted else ACTIVE_S)
            return
        transition, verb = NEXT[state]
        request = self.change()
        request.transition.id = transition
        self.changes.call_async(request).add_done_callback(partial(self.changed, verb))

    def changed(self, verb: str, asked: Any) -> None:
        """Take whether a transition succeeded."""
        succeeded = asked.result() is not None and asked.result().success
        self.failures = 0 if succeeded else self.failures + 1
        self.wanted = not succeeded or verb != NEXT[INACTIVE][1]
        self.say(f"is {verb}" if succeeded else f"could not be {verb}: its own output may say why")
        self.due_s = time.monotonic() + min(AGAIN_S * 2**self.failures, AGAIN_AT_MOST_S)

    def say(self, what: str) -> None:
        """Print a line."""
        print(f"{self.name} {what}", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Keep the nodes active until interrupted."""
    parser = argparse.ArgumentParser(prog="activate", allow_abbrev=False)
    parser.add_argument("--of", action="append", required=True, metavar="NODE")
    words = sys.argv[1:] if arguments is None else arguments
    options = parser.parse_args(words)
    need_rclpy("activate", words)
    import rclpy
    from rclpy.executors import ExternalShutdownException

    rclpy.init()
    node = rclpy.create_node("fogspec_activate", start_parameter_services=False, enable_rosout=False)
    activated = [Activated(node, name) for name in options.of]

    def look() -> None:
        for one in activated:
            one.look()

    node.create_timer(LOOKED_S, look)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
