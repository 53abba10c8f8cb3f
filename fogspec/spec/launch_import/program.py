"""What a Python launch file's values are besides Python's own: functions, names of other modules, errors."""

import ast
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from fogspec.spec.launch_import.found import Made, Place, Unknown

if TYPE_CHECKING:
    from fogspec.spec.launch_import.interpreter import Interpreter

MOST_ITEMS = 100_000


class Raised(Exception):
    """The launch file itself raises an error, at this place."""

    def __init__(self, place: Place, why: str) -> None:
        super().__init__(why)
        self.place, self.why = place, why


class Return(Exception):
    """A function returns."""

    def __init__(self, value: Any) -> None:
        self.value = value


class Loop(Exception):
    """A loop ends, or continues with its next item."""

    def __init__(self, again: bool) -> None:
        self.again = again


@dataclass(slots=True)
class Scope:
    """Names of a function, and those around it."""

    names: dict[str, Any]
    around: "Scope | None" = None

    def find(self, name: str) -> Any:
        """Return a name's value, or raise KeyError."""
        scope: Scope | None = self
        while scope is not None:
            if name in scope.names:
                return scope.names[name]
            scope = scope.around
        raise KeyError(name)


@dataclass(slots=True)
class Function:
    """A function of the launch file."""

    node: ast.FunctionDef | ast.Lambda
    scope: Scope
    defaults: list[Any] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Named:
    """Something of a module that is not the launch file's own: its dotted name."""

    name: str

    @property
    def last(self) -> str:
        """The name without its module."""
        return self.name.rpartition(".")[2]


@dataclass(slots=True)
class Bound:
    """A method of a value."""

    of: Any
    name: str


Call = Callable[["Interpreter", str, list[Any], dict[str, Any], Place], Any]


class Key:
    """A substitution as the name of a parameter."""

    def __init__(self, made: Made) -> None:
        self.made = made


def key_of(key: Any) -> Any:
    """Return a dictionary's key as it was written: a text, or substitutions."""
    return key.made if isinstance(key, Key) else list(key) if isinstance(key, tuple) else key


def truth(value: Any) -> bool:
    """Return whether Python takes a value as true: an object of a class is."""
    return True if isinstance(value, (Made, Unknown, Function, Named)) else bool(value)


def wide(text: str) -> bool:
    """Whether a format asks for a field that is very wide."""
    run = 0
    for one in text:
        run = run + 1 if one.isdigit() else 0
        if run > 3 and ("{" in text or "%" in text):
            return True
    return False
