"""YAML 1.1 as ROS 2 and its launch system read it (PyYAML's safe loader): `on` is true, `010` is 8, `1e5` is a text."""

import re
from functools import cache
from typing import Any

# A text that YAML 1.1 takes for nothing else: most values of launch arguments.
PLAIN = re.compile(r"[A-Za-z_/$][\w/$().-]*(?: ?[\w/$().-]+)*")
OTHER = re.compile(r"(?i:true|false|yes|no|on|off|null|\.nan|\.inf)")
MOST_NODES = 200_000
SCALARS = (
    ("bool", "yes|Yes|YES|no|No|NO|true|True|TRUE|false|False|FALSE|on|On|ON|off|Off|OFF", "yYnNtTfFoO"),
    (
        "float",
        r"[-+]?(?:[0-9][0-9_]*)\.[0-9_]*(?:[eE][-+][0-9]+)?|\.[0-9][0-9_]*(?:[eE][-+][0-9]+)?"
        r"|[-+]?[0-9][0-9_]*(?::[0-5]?[0-9])+\.[0-9_]*|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
        "-+0123456789.",
    ),
    (
        "int",
        r"[-+]?0b[0-1_]+|[-+]?0[0-7_]+|[-+]?(?:0|[1-9][0-9_]*)|[-+]?0x[0-9a-fA-F_]+|[-+]?[1-9][0-9_]*(?::[0-5]?[0-9])+",
        "-+0123456789",
    ),
    ("merge", "<<", "<"),
    ("null", "~|null|Null|NULL", "~nN"),
    ("null", "", ("",)),
)


class NotYaml(Exception):
    """A text that is not YAML, or has tags or aliases that ROS 2 would not read."""


def read11_text(text: str) -> Any:
    """Return the value of a short text, such as a launch argument's; raise NotYaml."""
    if PLAIN.fullmatch(text) and not OTHER.fullmatch(text):
        return text
    return read11(text)


def read11(text: str) -> Any:
    """Return a document's value; raise NotYaml. Aliases are refused where they would multiply it."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    reader = YAML(typ="safe", pure=True)
    reader.Resolver = _resolver()
    reader.version = (1, 1)
    reader.allow_duplicate_keys = True
    try:
        value = reader.load(text)
    except (YAMLError, ValueError, TypeError, RecursionError, AttributeError) as wrong:
        raise NotYaml(type(wrong).__name__) from None
    _bounded(value, [0])
    return value


@cache
def _resolver() -> Any:
    """Return the class that tells numbers and booleans from text as PyYAML does: ruamel.yaml takes `1e5` and `y` otherwise."""
    from ruamel.yaml.resolver import VersionedResolver

    table: dict[str, list[Any]] = {}
    for tag, pattern, starts in SCALARS:
        for start in starts:
            table.setdefault(start, []).append((f"tag:yaml.org,2002:{tag}", re.compile(rf"(?:{pattern})$", re.X)))

    class Resolver(VersionedResolver):
        @property
        def versioned_resolver(self) -> Any:
            return table

    return Resolver


def _bounded(value: Any, count: list[int], depth: int = 0) -> None:
    count[0] += 1
    if count[0] > MOST_NODES or depth > 100:
        raise NotYaml("too large")
    for one in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _bounded(one, count, depth + 1)
