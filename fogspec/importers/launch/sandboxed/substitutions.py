"""launch's substitutions, performed as launch does."""

import importlib
import math
import os
from collections.abc import Callable
from typing import Any

from fogspec.importers.launch.sandboxed.context import perform, truth
from fogspec.importers.launch.sandboxed.made import NAMES, Made, make
from fogspec.importers.launch.sandboxed.paths import content, prefix, share, virtual
from fogspec.importers.launch.sandboxed.values import (
    CURRENT,
    Refused,
    Stop,
    Text,
    kept,
    marked,
    missing,
    plain,
    unknown,
    why,
)

Do = Callable[[Any], str]


class Substitution(Made):
    """A substitution of a kind that is not read."""

    def perform(self, context: Any) -> str:
        """Return its text."""
        return unknown(f"only a launch determines {type(self).__name__}", self.place)

    def describe(self) -> str:
        """Return its name."""
        return type(self).__name__


def substitution(
    name: str, *fields: str, library: str = "launch", base: type[Made] = Substitution
) -> Callable[[Do], Any]:
    """Return a decorator that makes a substitution's class of the function that gives its text."""

    def do(function: Do) -> Any:
        return make(library, name, *fields, base=base, perform=lambda self, context: function(self))

    return do


@substitution("LaunchConfiguration", "variable_name", "default")
def _variable(self: Made) -> str:
    from fogspec.importers.launch.sandboxed.context import CONTEXT

    name = perform(self.variable_name)
    if name in CONTEXT.launch_configurations:
        return perform(CONTEXT.launch_configurations[name])
    if self.default is None:
        return missing(name, self.place)
    return perform(self.default)


@substitution("LaunchConfigAsBool", "variable_name", "default", library="nav2_common")
def _as_bool(self: Made) -> str:
    text = NAMES["launch"]["LaunchConfiguration"](self.variable_name, self.default).perform(None)
    return text if marked(text) else str(text.strip().lower() in ("true", "1", "yes", "on"))


def _joined(parts: list[str]) -> str:
    """Return a path as os.path.join puts it together; a part that only the machine has is taken as relative."""
    try:
        return os.path.join(*parts) if parts else ""
    except Stop:
        text = plain(parts[0])
        for part in parts[1:]:
            text += ("" if text.endswith("/") or not text else "/") + plain(part)
        return Text(text)


@substitution("PathJoinSubstitution", "substitutions")
def PathJoinSubstitution(self: Made) -> str:
    """Perform a path of parts."""
    return _joined([perform(one) for one in self.word("substitutions", [])])


@substitution("PathSubstitution", "path", base=PathJoinSubstitution)
def PathSubstitution(self: Made) -> str:
    """Perform a path whose parts are put together by `/`."""
    return _joined([perform(one) for one in self.given.get("parts") or [self.path]])


def _slash(self: Made, other: Any) -> Any:
    longer = PathSubstitution(self.given.get("path"))
    before = self.given.get("parts") or self.given.get("substitutions") or [self.given.get("path")]
    longer.given["parts"] = [*before, other]
    return longer


PathJoinSubstitution.__truediv__ = _slash


@substitution("StringJoinSubstitution", "substitutions", "delimiter")
def _string_join(self: Made) -> str:
    text, glue = "", perform(self.word("delimiter", ""))
    for i, one in enumerate(self.word("substitutions", [])):
        text += (glue if i else "") + perform(one)
    return text


@substitution("EnvironmentVariable", "name", "default_value")
def _environment(self: Made) -> str:
    name = perform(self.name)
    if name in os.environ or self.default_value is None:
        return os.environ[name]
    return perform(self.default_value)


@substitution("Command", "command", "on_stderr")
def _command(self: Made) -> str:
    return kept(f"$(command '{plain(perform(self.command))}')", self.place)


@substitution("PythonExpression", "expression", "python_modules")
def _python(self: Made) -> str:
    text = perform(self.expression)
    if marked(text):
        return unknown(why(text), self.place)
    try:
        names = {
            perform(name): importlib.import_module(perform(name)) for name in self.word("python_modules", ["math"])
        }
        return str(eval(text.strip(), {**(vars(math) if "math" in names else {}), **names}))  # noqa: S307
    except Exception as problem:
        return unknown(f"'{text[:60]}' fails: {type(problem).__name__}: {problem}", self.place)


@substitution("NotSubstitution", "value")
def _not(self: Made) -> str:
    return str(not truth(self.value)).lower()


def _all(any_of: bool) -> Do:
    def do(self: Made) -> str:
        parts = self.given.get("args") or [self.given.get("left"), self.given.get("right")]
        stopped = None
        for one in parts:
            try:
                if truth(one) is any_of:
                    return str(any_of).lower()
            except Stop as stop:
                stopped = stop
        if stopped:
            raise stopped
        return str(not any_of).lower()

    return do


def _equals(negated: bool) -> Do:
    def do(self: Made) -> str:
        sides = []
        for side in (self.left, self.right):
            text = "" if side is None else perform(str(side).lower() if isinstance(side, bool) else side)
            if marked(text):
                return unknown(why(text), self.place)
            sides.append(text)
        lower = [one.lower() for one in sides]
        if all(one in ("true", "false", "1", "0") for one in lower):
            same = (lower[0] in ("true", "1")) == (lower[1] in ("true", "1"))
        else:
            try:
                same = math.isclose(float(sides[0]), float(sides[1]))
            except ValueError:
                same = sides[0] == sides[1]
        return str(same is not negated).lower()

    return do


for _any in (False, True):
    substitution("OrSubstitution" if _any else "AndSubstitution", "left", "right")(_all(_any))
    substitution("AnySubstitution" if _any else "AllSubstitution", "*")(_all(_any))
    substitution("NotEqualsSubstitution" if _any else "EqualsSubstitution", "left", "right")(_equals(_any))


@substitution("IfElseSubstitution", "condition", "if_value", "else_value")
def _if_else(self: Made) -> str:
    return perform(self.word("if_value", "") if truth(self.condition) else self.word("else_value", ""))


@substitution("FileContent", "path")
def _content(self: Made) -> str:
    try:
        return content(perform(self.path))
    except Refused as refused:
        return unknown(refused.why, self.place)


def _of_words(library: str, name: str, *fields: str, text: Callable[..., str]) -> Any:
    """Make a substitution whose text is a function of its performed arguments."""
    return substitution(name, *fields, library=library)(
        lambda self: text(*(perform(self.word(one, "")) for one in fields))
    )


def _folder(text: Callable[[str], str]) -> Callable[[str], str]:
    """Return what a package's name gives: nothing known if the name is not."""
    return lambda name: unknown(why(name)) if marked(name) else text(name)


_of_words("launch", "TextSubstitution", "text", text=lambda text: text)
_of_words("launch", "FindExecutable", "name", text=lambda name: name)
_of_words("launch", "ThisLaunchFile", text=lambda: virtual(CURRENT[0]))
_of_words("launch", "ThisLaunchFileDir", text=lambda: os.path.dirname(virtual(CURRENT[0])))
for _name, _do in (("FindPackageShare", share), ("FindPackagePrefix", prefix), ("FindPackage", prefix)):
    _made = _of_words("launch_ros", _name, "package", text=_folder(_do))
    _made.find = lambda self, name, _do=_do: _do(name)
_of_words(
    "launch_ros",
    "ExecutableInPackage",
    "executable",
    "package",
    text=lambda file, name: f"{prefix(name)}/lib/{name}/{file}",
)
for _name in ("AnonName", "LocalSubstitution", "BooleanSubstitution"):
    make("launch", _name, "name", base=Substitution)
NAMES["launch"]["Substitution"] = Substitution
