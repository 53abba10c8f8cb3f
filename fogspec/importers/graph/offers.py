"""What is called by name: goals of actions, timed by their status topics, and calls of services, by their events."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from fogspec.importers.graph.observed import Observed, Offer, Timed

NS = 1e-9
INTROSPECTION = "configure_introspection(clock, qos, METADATA)"  # of rclcpp and rclpy since ROS 2 Iron


@dataclass(frozen=True, kw_only=True)
class Calls(Timed):
    """An action or a service at its server: how many goals or calls began, and how long those took that ended."""

    kind: Literal["action", "service"]
    name: str
    node: str
    callers: tuple[str, ...]
    begun: int
    rate: float

    def evidence(self) -> str:
        """Return what was seen, as a line of text."""
        what = "goals ended" if self.kind == "action" else "calls answered"
        ended = f"{len(self.latencies_s)} of {self.begun} {what}"
        times = f"p50 {1e3 * self.p50_s:.3g} ms, p95 {1e3 * self.p95_s:.3g} ms"
        return f"{self.name}: {self.kind}, {ended}, {times}, {self.rate:.2g}/s, {_called(self.callers)}"


def timed_calls(seen: Observed) -> list[Calls]:
    """Return the actions and services of which a goal or call ended while the robot was watched."""
    return [one for one in _all(seen) if one.latencies_s]


@dataclass(frozen=True)
class Untimed:
    """An action or a service with a caller, and why it is not known how long it takes."""

    what: Calls
    why: str

    def evidence(self) -> str:
        """Return what was seen, as a line of text."""
        return f"{self.what.name}: {self.what.kind} of {self.what.node}, {_called(self.what.callers)}; {self.why}"


def untimed(seen: Observed) -> list[Untimed]:
    """Return the actions and then the services of which no goal or call ended."""
    found = []
    for one in _all(seen):
        if one.latencies_s or not one.callers:
            continue
        if one.kind == "action":
            why = "no goal began and ended while it was watched, so its latency is not known yet: send one, or watch longer"
        elif seen.services[one.name].introspected:
            why = "no call was answered while it was watched, so its latency is not known yet: call it, or watch longer"
        else:
            why = (
                f"its calls are not visible, so its latency is not known yet: {INTROSPECTION} at its server shows them"
            )
        found.append(Untimed(one, why))
    return found


def _all(seen: Observed) -> Iterator[Calls]:
    for name, offer in sorted(seen.actions.items()):
        ended = tuple((end - begin) * NS for begin, end, _ in offer.goals if end is not None and end > begin)
        # One that had ended before the watch has no known beginning.
        begun = sum(end is None or end > begin for begin, end, _ in offer.goals)
        yield from _of("action", name, offer, begun, ended, seen.seconds)
    for name, offer in sorted(seen.services.items()):
        ended = tuple((end - begin) * NS for begin, end in offer.calls if end > begin)
        yield from _of("service", name, offer, len(offer.calls), ended, seen.seconds)


def _of(
    kind: Literal["action", "service"], name: str, offer: Offer, begun: int, ended: tuple[float, ...], seconds: float
) -> Iterator[Calls]:
    if offer.servers:
        yield Calls(kind=kind, name=name, node=offer.servers[0], callers=tuple(offer.callers), begun=begun,
                    latencies_s=ended, rate=begun / max(seconds, 1e-9))  # fmt: skip


def _called(callers: tuple[str, ...]) -> str:
    return f"called by {', '.join(callers)}" if callers else "called by no node that is visible"
