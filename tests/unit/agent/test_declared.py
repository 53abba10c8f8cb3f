"""When a node is known to lack a parameter that the spec sets: its answers are given, and so is the time."""

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from fogspec.agent import declared, graph
from fogspec.agent.declared import PATIENCE_S, Asked

STATE = "lifecycle_msgs/srv/GetState"


class Robot:
    """A graph whose nodes declare these parameters; `allows` have every one, `states` are of lifecycle nodes."""

    def __init__(self, **declared: list[str]) -> None:
        self.declared, self.allows, self.states = declared, set[str](), dict[str, int]()
        self.node, self.asked = self, 0

    def nodes(self) -> list[tuple[str, str]]:
        return [("/", name) for name in self.declared]

    def get_service_names_and_types_by_node(self, name: str, _namespace: str) -> list[tuple[str, list[str]]]:
        state = [(f"/{name}/get_state", [STATE])] if name in self.states else []
        return [(f"/{name}/list_parameters", ["rcl_interfaces/srv/ListParameters"]), *state]

    def create_client(self, _service: Any, name: str) -> Any:
        node, what = name[1:].split("/")

        def answer(request: Any) -> Any:
            self.asked += 1
            if what == "get_state":
                return SimpleNamespace(current_state=SimpleNamespace(id=self.states[node]))
            if what == "list_parameters":
                return SimpleNamespace(result=SimpleNamespace(names=self.declared[node]))
            has = node in self.allows or request.names[0] in self.declared[node]
            return SimpleNamespace(values=[None] if has else [])

        def call(request: Any) -> Any:
            return SimpleNamespace(done=lambda: True, result=lambda: answer(request))

        return SimpleNamespace(service_is_ready=lambda: True, call_async=call)

    def destroy_client(self, _client: Any) -> None: ...


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A tenth of a second passes with each look at the clock; interfaces are stand-ins."""
    now = SimpleNamespace(s=0.0)

    def monotonic() -> float:
        now.s += 0.1
        return now.s

    for module in (declared, graph):
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=monotonic))
    service = SimpleNamespace(Request=lambda names=(): SimpleNamespace(names=names))
    for package, names in (("rcl_interfaces", ("ListParameters", "GetParameters")), ("lifecycle_msgs", ("GetState",))):
        made = ModuleType(f"{package}.srv")
        vars(made).update(dict.fromkeys(names, service))
        monkeypatch.setitem(sys.modules, package, ModuleType(package))
        monkeypatch.setitem(sys.modules, f"{package}.srv", made)
    return now


def ask(robot: Any, key: str, *names: str, turns: int = 10_000) -> str | None:
    """What is certainly missing after so many turns."""
    one = Asked(robot, key, names)
    for _, _turn in zip(one.asking(), range(turns), strict=False):
        pass
    return one.undeclared


@pytest.mark.parametrize("key", ["plan", "/plan"])
def test_a_parameter_is_missing_once_the_node_has_not_declared_it_for_a_while(clock: Any, key: str) -> None:
    said = "/plan declares no parameter wrok (there is work), zz: ROS 2 ignores it"
    assert ask(Robot(plan=["rate", "work"], other=["wrok"]), key, "wrok", "zz", "rate") == said
    assert clock.s >= PATIENCE_S


def test_a_node_that_has_all_is_asked_once(clock: Any) -> None:
    robot = Robot(plan=["rate", "work"])
    assert ask(robot, "plan", "work", "rate") is None
    assert robot.asked == 1


def test_a_parameter_that_is_declared_late_is_not_missing(clock: Any) -> None:
    robot = Robot(plan=["rate"])
    one = Asked(robot, "plan", ["work"])  # type: ignore[arg-type]
    for _ in one.asking():
        if clock.s > PATIENCE_S - 1:
            robot.declared["plan"] = ["work"]
    assert one.undeclared is None


def test_a_node_that_allows_what_it_does_not_declare_lacks_nothing(clock: Any) -> None:
    robot = Robot(plan=["rate"])
    robot.allows = {"plan"}
    assert ask(robot, "plan", "wrok") is None
    assert clock.s < PATIENCE_S


@pytest.mark.parametrize(("state", "missing"), [(1, False), (10, False), (2, True), (3, True)])
def test_a_lifecycle_node_is_waited_for_until_it_is_configured(clock: Any, state: int, missing: bool) -> None:
    robot = Robot(plan=["rate"])
    robot.states = {"plan": state}
    assert (ask(robot, "plan", "wrok", turns=1000) is not None) == missing


def test_nothing_is_said_of_a_node_that_is_not_there(clock: Any) -> None:
    assert ask(Robot(other=["rate"]), "plan", "work", turns=1000) is None


def test_what_is_said_of_several_nodes_and_of_nothing() -> None:
    assert declared.said({"/a": ["x"], "/b": ["work"]}, ["wrok"]) == (
        "/a, /b declare no parameter wrok (there is work): ROS 2 ignores it"
    )
    assert declared.said({"/a": []}, []) == ""
