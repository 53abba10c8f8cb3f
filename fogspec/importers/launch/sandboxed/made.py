"""What launch's classes have in common: objects that keep what they were given, and where."""

import os
from typing import Any

from fogspec.importers.launch.sandboxed.context import CONTEXT, truth
from fogspec.importers.launch.sandboxed.values import Fatal, Missing, Place, Refused, Stop, Unknown, here, note

NAMES: dict[str, dict[str, Any]] = {
    "launch": {},
    "launch_ros": {},
    "nav2_common": {},
    "fogros2": {},
}  # classes by library


# How a process is shown and ended, and what people are shown, which is no part of what runs; what FogROS2's classes take over.
HARMLESS = {
    "output", "output_format", "emulate_tty", "exec_name", "log_cmd", "cached_output", "sigterm_timeout", "sigkill_timeout",
    "condition", "machine", "stream_topics", "to_cloud", "launch_prefix_filter", "description", "cancel_on_shutdown",
}  # fmt: skip


class Given(dict[str, Any]):
    """Arguments or attributes by name, which knows which of them were read."""

    def __init__(self, *some: Any) -> None:
        super().__init__(*some)
        self.read: set[str] = set()

    def __getitem__(self, name: str) -> Any:
        self.read.add(name)
        return super().__getitem__(name)

    def get(self, name: str, default: Any = None) -> Any:
        """Return one, or the default."""
        self.read.add(name)
        return super().get(name, default)

    def left(self) -> list[tuple[str, Any]]:
        """Return what nothing has read and says something, but what is harmless; once."""
        found = [(name, super(Given, self).get(name)) for name in sorted(self.keys() - self.read - HARMLESS)]
        self.read.update(self)
        return [
            one for one in found if not (one[1] is None or one[1] is False or (isinstance(one[1], list) and not one[1]))
        ]


class Made:
    """An action, substitution or description: what its class was given, by the names of its arguments."""

    FIELDS: tuple[str, ...] = ()
    place: Place

    def __init__(self, *args: Any, **words: Any) -> None:
        if "*" in self.FIELDS:
            words["args"] = list(args)
        elif len(args) > len(self.FIELDS):
            raise TypeError(
                f"{type(self).__name__} takes {len(self.FIELDS)} positional arguments, {len(args)} were given"
            )
        self.__dict__.update(place=here(), given=Given({**dict(zip(self.FIELDS, args, strict=False)), **words}))

    def __getattr__(self, name: str) -> Any:
        given = self.__dict__.setdefault("given", Given())
        if name in given:
            return given[name]
        if name.startswith("__") or name in ("perform", "execute", "visit", "place"):
            raise AttributeError(name)
        if name in self.FIELDS or name == "condition":
            return None
        return Unknown(f"{name} of {type(self).__name__} is not read")

    def word(self, name: str, default: Any = None) -> Any:
        """Return an argument, or the default where it is none."""
        value = self.__dict__.setdefault("given", Given()).get(name, default)
        return default if value is None else value


def where(made: Any) -> Place | None:
    """Return where an object is made, if it knows."""
    if isinstance(made, Unknown):
        return made._place
    return made.__dict__.get("place") if isinstance(made, Made) else None


def make(library: str, name: str, *fields: str, base: type[Made] = Made, **methods: Any) -> Any:
    """Return a class of a library's, with these arguments by position and these methods."""
    made = type(name, (base,), {"FIELDS": fields, "__module__": library, **methods})
    NAMES[library][name] = made
    return made


class Condition(Made):
    """A condition of an action; a launch file's own may have a predicate."""

    FIELDS = ("predicate",)

    def evaluate(self, context: Any) -> bool:
        """Return whether it holds."""
        predicate = self.given.get("predicate")
        return bool(predicate(context)) if predicate else True


def _if(self: Made, context: Any) -> bool:
    return truth(self.predicate_expression)


def _unless(self: Made, context: Any) -> bool:
    return not truth(self.predicate_expression)


def _equal(self: Made, context: Any) -> bool:
    from fogspec.importers.launch.sandboxed.context import perform

    value = context.launch_configurations.get(perform(self.launch_configuration_name))
    return bool(value == (None if self.expected_value is None else perform(self.expected_value)))


def _unequal(self: Made, context: Any) -> bool:
    return not _equal(self, context)


NAMES["launch"]["Condition"] = Condition
make("launch", "IfCondition", "predicate_expression", base=Condition, evaluate=_if)
make("launch", "UnlessCondition", "predicate_expression", base=Condition, evaluate=_unless)
for _name, _do in (("Equals", _equal), ("NotEquals", _unequal)):
    make(
        "launch",
        f"LaunchConfiguration{_name}",
        "launch_configuration_name",
        "expected_value",
        base=Condition,
        evaluate=_do,
    )


def applies(made: Any) -> bool:
    """Return whether an action's condition holds; one that only a launch decides is noted and taken as if it did."""
    condition = (
        made.__dict__.get("given", {}).get("condition") if isinstance(made, Made) else getattr(made, "condition", None)
    )
    if condition is None:
        return True
    try:
        if isinstance(condition, Unknown):
            raise Stop(condition._why, condition._place)
        return bool(condition.evaluate(CONTEXT))
    except Stop as stop:
        note(stop.place, f"a condition is taken as true: {stop.why}")
        return True


class Action(Made):
    """An action that starts nothing; a launch file's own may have an `execute`."""

    def execute(self, context: Any) -> Any:
        """Play the action; return actions that it starts."""
        note(where(self), f"{type(self).__name__} is not taken over")
        self.given.left()

    def visit(self, context: Any) -> Any:
        """Play the action if its condition holds; note what of it was not read."""
        if not applies(self):
            return None
        found = self.execute(context)
        unread(self, f" of {type(self).__name__}")
        for place, what in self.__dict__.get("left", ()):
            note(place, f"{what} is not taken over: a spec has no place for it")
        return found


NAMES["launch"]["Action"] = Action


def unread(made: Made, whose: str = "") -> None:
    """Note what an object was given that nothing has read."""
    for name, value in made.given.left():
        note(where(value) or made.place, f"{name}{whose} is not taken over: a spec has no place for it")


def visit(entity: Any) -> None:
    """Play an action, or a list of them."""
    if isinstance(entity, Unknown):
        note(entity._place, f"what this starts is not taken over: {entity._why}")
    elif isinstance(entity, Missing):
        note(None, f"{type(entity).__name__} is not taken over: its module is not here")
    elif hasattr(entity, "visit"):
        try:
            visit(entity.visit(CONTEXT))
        except (Refused, Stop) as refused:
            note(refused.place or where(entity), f"{type(entity).__name__} is not taken over: {refused.why}")
        except (Fatal, RecursionError):
            raise
        except Exception as problem:
            note(
                where(entity),
                f"{type(entity).__name__} is not taken over: it fails: {type(problem).__name__}: {problem}",
            )
    elif entity is not None and not isinstance(entity, (str, bytes, os.PathLike)):
        for one in entity:
            visit(one)
