"""Parameters with the types that launch_ros gives them."""

from collections.abc import Iterator
from pathlib import PurePosixPath
from typing import Any

from fogspec.base.yaml.reader11 import NotYaml
from fogspec.spec.launch_import.found import Made, Place, Unknown
from fogspec.spec.launch_import.program import Named, key_of
from fogspec.spec.launch_import.substitutions import WRITTEN, Context

SCALARS = (bool, int, float, str)
CONVERTED = {"str": str, "int": int, "float": float, "bool": bool}


class Refused(Exception):
    """A value that launch_ros would refuse, or that only a launch determines."""

    def __init__(self, place: Place, why: str) -> None:
        super().__init__(why)
        self.place, self.why = place, why


def value_of(context: Context, value: Any, place: Place) -> Any:
    """Return a parameter's value: substituted text is read as YAML unless ParameterValue has a type; raise Refused."""
    if isinstance(value, Unknown):
        raise Refused(value.place, value.why)
    if isinstance(value, Made) and value.kind == "ParameterValue":
        return _with_type(context, value)
    if isinstance(value, Made):
        return _yaml(context, value, value.place)
    if isinstance(value, SCALARS):
        return value
    if isinstance(value, PurePosixPath):
        raise Refused(place, "launch_ros refuses a path as a parameter: it must be a text")
    if isinstance(value, (list, tuple)):
        return _list(context, list(value), place)
    raise Refused(place, "launch_ros refuses a value of this type")


def _with_type(context: Context, made: Made) -> Any:
    value, kind = made.word("value", 0), made.word("value_type", 1)
    if kind is None:
        if isinstance(value, (str, Made)) or (isinstance(value, list) and any(isinstance(one, Made) for one in value)):
            return _yaml(context, value, made.place)
        return value_of(context, value, made.place)
    name = kind.last if isinstance(kind, Named) else str(kind)
    convert = CONVERTED.get(name)
    if convert is None:
        raise Refused(made.place, "this value_type is not read")
    if isinstance(kind, Named) and kind.name.startswith("list."):
        some = value if isinstance(value, (list, tuple)) and not any(isinstance(one, Made) for one in value) else None
        if some is None:
            some = _yaml(context, value, made.place)
        return [_converted(one, name, made.place) for one in (some if isinstance(some, (list, tuple)) else [some])]
    if isinstance(value, (str, Made, list, tuple)):
        text = context.perform(value, made.place)
        if isinstance(text, Unknown):
            raise Refused(text.place, text.why)
        if convert is str:
            return text
        return _converted(_read(context, text, made.place), name, made.place)
    return _converted(value, name, made.place)


def _converted(value: Any, name: str, place: Place) -> Any:
    if name == "float" and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if name == "str" and isinstance(value, SCALARS):
        return str(value)
    if type(value) is not CONVERTED[name]:
        raise Refused(place, f"launch_ros refuses this value as {name}")
    return value


def _list(context: Context, items: list[Any], place: Place) -> Any:
    if not items:
        raise Refused(place, "launch_ros refuses an empty list")
    for one in items:
        if isinstance(one, Unknown):
            raise Refused(one.place, one.why)
    kinds = {type(one) for one in items}
    if kinds <= {int, float} or kinds == {bool}:
        return [float(one) for one in items] if float in kinds else items
    if Made in kinds and kinds <= {str, Made}:
        return _yaml(context, items, place)
    if kinds == {str}:
        return items
    found = [_yaml(context, one, place) if isinstance(one, (Made, list, tuple)) else one for one in items]
    if len({type(one) for one in found}) > 1 or not isinstance(found[0], SCALARS):
        raise Refused(place, "launch_ros refuses a list of values of several types")
    return found


def _yaml(context: Context, value: Any, place: Place) -> Any:
    text = context.perform(value, place)
    if isinstance(text, Unknown):
        raise Refused(text.place, text.why)
    return _read(context, text, place)


def _read(context: Context, text: str, place: Place) -> Any:
    if text.startswith(("$(command ", "$(env ")):
        return text
    try:
        value = context.typed(text)
    except NotYaml:
        raise Refused(place, f"launch_ros refuses '{text[:60]}': it is not YAML") from None
    if isinstance(value, list):
        if not value or len({type(one) for one in value}) > 1 or not isinstance(value[0], SCALARS):
            raise Refused(place, f"launch_ros refuses '{text[:60]}': a list must have values of one type")
        return value
    if not isinstance(value, SCALARS):
        raise Refused(place, f"launch_ros refuses '{text[:60]}' as a value")
    return value


def flat(context: Context, values: dict[Any, Any], place: Place, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the full name and the raw value of each parameter of a dictionary."""
    for key, value in values.items():
        context.found.spend(1)
        name = key_of(key)
        text = name if isinstance(name, str) else context.perform(name, place)
        if isinstance(text, Unknown):
            context.found.note(text.place, f"the name of a parameter is not known: {text.why}")
        elif isinstance(value, dict):
            yield from flat(context, value, place, f"{prefix}{text}.")
        else:
            yield f"{prefix}{text}", value


def take(context: Context, items: Any, place: Place, node: str | None = None) -> tuple[list[str], dict[str, Any]]:
    """Return parameter files and parameters of launch_ros' `parameters`, the pushed ones before; note what is left out."""
    files: list[str] = []
    values: dict[str, Any] = {}
    known = list(context.configurations.get("global_params", []))
    if isinstance(items, Unknown):
        context.found.note(items.place, f"parameters are not taken over: {items.why}")
        items = []
    for one in [*known, *(items if isinstance(items, (list, tuple)) else [] if items is None else [items])]:
        if isinstance(one, _Pushed):
            values[one.name] = one.value
        elif isinstance(one, dict):
            for name, value in flat(context, one, place):
                _take(context, values, name, value, place)
        elif isinstance(one, Made) and one.kind == "Parameter":
            named = context.perform(one.word("name", 0), one.place)
            if isinstance(named, str):
                _take(context, values, named, one.word("value", 1), one.place)
        else:
            text = context.perform(one, place)
            if isinstance(text, Unknown):
                what = "parameters are" if isinstance(one, Unknown) else "a parameter file is"
                context.found.note(text.place, f"{what} not taken over: {text.why}")
            elif (path := _path(context, text, place)) is not None:
                if _overlap(context, path, values, node) is None:
                    context.found.note(place, f"{PurePosixPath(path).name} is given after parameters that it may set as well; "
                                              "the spec sets them after it")  # fmt: skip
                else:
                    for name in _overlap(context, path, values, node) or ():
                        del values[name]
                files.append(path)
    return files, values


def _take(context: Context, values: dict[str, Any], name: str, value: Any, place: Place) -> None:
    try:
        values[name] = value_of(context, value, place)
    except Refused as refused:
        values.pop(name, None)
        context.found.note(refused.place, f"the parameter {name} is not taken over: {refused.why}")


class _Pushed:
    """A parameter that is set for all nodes of a scope."""

    def __init__(self, name: str, value: Any) -> None:
        self.name, self.value = name, value


def push(context: Context, name: str, value: Any, place: Place) -> None:
    """Set a parameter for all nodes of the scope."""
    try:
        one = _Pushed(name, value_of(context, value, place))
    except Refused as refused:
        context.found.note(refused.place, f"the parameter {name} is not taken over: {refused.why}")
        return
    context.configurations.setdefault("global_params", []).append(one)


def _path(context: Context, path: str, place: Place) -> str | None:
    """Return a parameter file as the spec names it; note what it cannot name."""
    if path.startswith((WRITTEN, "$(find-pkg")) or not path.startswith(("/", "$", "~")):
        return path
    text = context.read(path)
    if text is not None:
        return context.written(path, text)
    context.found.note(place, f"the parameter file {path} is not taken over: it is not in a package, and not here")
    return None


def applies_to(section: str, node: str | None) -> bool:
    """Whether a section of a parameter file is for the node with this full name."""
    words, own = section.strip("/").split("/"), (node or "").strip("/").split("/")
    if words[0] == "**":
        return len(words) == 1 or words[1:] == own[-len(words[1:]) :]
    return len(words) == len(own) and all(one in ("*", other) for one, other in zip(words, own, strict=True))


def _overlap(context: Context, path: str, values: dict[str, Any], node: str | None) -> list[str] | None:
    """Return which of the values a file sets for this node as well, so that they have no effect; None if that is not known."""
    if not values:
        return []
    text = context.read(path)
    if text is None:
        return None
    try:
        data = context.data(text)
    except NotYaml:
        return None
    names: set[str] = set()

    def walk(value: Any, section: str, inside: bool, prefix: str) -> None:
        context.found.spend(1)
        for key, below in value.items() if isinstance(value, dict) else ():
            if inside:
                names.add(f"{prefix}{key}")
                walk(below, section, True, f"{prefix}{key}.")
            elif key == "ros__parameters":
                walk(below, section, applies_to(section, node), "")
            else:
                walk(below, f"{section}/{key}".replace("//", "/"), False, "")

    walk(data, "", False, "")
    return [name for name in values if name in names]
