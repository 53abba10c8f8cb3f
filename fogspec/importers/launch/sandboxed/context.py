"""What `launch` calls its context, as far as launch files see it, and what is recorded of what would start."""

import os
from collections.abc import Mapping
from typing import Any

from fogspec.importers.launch.found import Started
from fogspec.importers.launch.sandboxed.paths import spelled
from fogspec.importers.launch.sandboxed.values import Place, Refused, Stop, Unknown, kept, marked, note, unknown, why

# Variables that a sourced ROS 2 has on every machine; others are taken to be unset before the launch.
EVERYWHERE = {"HOME", "USER", "PATH", "LD_LIBRARY_PATH", "PYTHONPATH", "AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH"}
BASE = {"ROS_VERSION": "2", "ROS_PYTHON_VERSION": "3"}


FOUND = Started()


class Environ(dict[str, Any]):
    """os.environ of a machine where nothing is set but what every one has, and what the launch file sets."""

    def __contains__(self, name: object) -> bool:
        return name in EVERYWHERE or dict.__contains__(self, name)

    def get(self, name: str, default: Any = None) -> Any:
        """Return a variable's value: the machine's own text where it has one."""
        return self[name] if name in self else default  # noqa: SIM401  (a missing variable has a text)

    def __missing__(self, name: Any) -> Any:
        if not isinstance(name, str):
            raise KeyError(name)
        return kept(f"$(env {name})")

    def copy(self) -> "Environ":
        """Return a copy."""
        return Environ(self)


class Context:
    """launch's context: configurations, environment, and the scopes that were pushed."""

    def __init__(self, **_: Any) -> None:
        self.launch_configurations: dict[str, Any] = {}
        self.pushed: list[dict[str, Any]] = []
        self.environments: list[Environ] = []
        self.argv: list[str] = []
        self.is_shutdown = False

    @property
    def environment(self) -> Any:
        """The environment of what starts."""
        return os.environ

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return Unknown(f"{name} is of a running launch")

    def perform_substitution(self, value: Any) -> str:
        """Return a substitution's text."""
        return perform(value)

    def push_configurations(self) -> None:
        """Begin a scope of launch configurations; as in launch, a list of parameters or remappings is shared with it."""
        self.pushed.append(self.launch_configurations)
        self.launch_configurations = dict(self.launch_configurations)

    def pop_configurations(self) -> None:
        """End the last scope of launch configurations."""
        if self.pushed:
            self.launch_configurations = self.pushed.pop()

    def push_environment(self) -> None:
        """Begin a scope of the environment."""
        self.environments.append(Environ(os.environ))

    def pop_environment(self) -> None:
        """End the last scope of the environment."""
        if self.environments:
            reset_environment(self.environments.pop())


CONTEXT = Context()


def reset_environment(values: Mapping[str, Any]) -> None:
    """Replace the environment."""
    os.environ.clear()
    os.environ.update(values)


def perform(value: Any) -> str:
    """Return the text of a substitution, or of a list of them; what is not known is marked in it."""
    if isinstance(value, Unknown):
        return unknown(value._why, value._place)
    if isinstance(value, (str, os.PathLike)):
        return os.fspath(value)
    if isinstance(value, (bool, int, float)):
        return str(value)
    if hasattr(value, "perform"):
        return value.perform(CONTEXT)  # type: ignore[no-any-return]
    if hasattr(value, "__iter__"):
        text = ""
        for one in value:
            text += perform(one)
        return text
    return unknown(f"a value of type {type(value).__name__} is not a string")


def said(value: Any) -> str:
    """Return a performed text as the spec has it; raise Refused."""
    return spelled(perform(value))


def all_said(values: Any) -> list[str]:
    """Return several texts as the spec has them; raise Refused."""
    return [said(one) for one in values]


def truth(value: Any) -> bool:
    """Return a condition's value as launch reads it; raise Stop if only a launch decides it."""
    text = perform(str(value) if isinstance(value, bool) else value)
    if marked(text):
        raise Stop(why(text))
    word = text.strip().lower()
    if word in ("true", "1", "false", "0"):
        return word in ("true", "1")
    raise Stop(f"'{text[:60]}' is not a condition: launch refuses it")


def environment(place: Place | None = None) -> dict[str, str]:
    """Return the environment that the launch file has set so far, as the spec has it."""
    found = {}
    for key, value in os.environ.items():
        if BASE.get(key) == value or (key == "ROS_DISTRO" and value == DISTRO[0]):
            continue
        try:
            found[spelled(key)] = spelled(value)
        except Refused as refused:
            note(refused.place or place, f"the environment variable {key} is not taken over: {refused.why}")
    return found


DISTRO = ["jazzy"]
