"""Every field of the spec as a page for people: type, limits, default, unit, meaning, example."""

import re
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from fogspec.base.quantities import (
    Confidence,
    Cost,
    CountRange,
    Duration,
    MemoryRange,
    Money,
    Percent,
    Price,
    Rate,
    Spot,
    Until,
)
from fogspec.base.yaml.writer import flow
from fogspec.language.introspect import part
from fogspec.language.schema import BASIC, Tier

QUANTITIES = (
    (Duration, "duration", "ns, us, ms, s, min, h or d"),
    (Until, "duration or date", "ns, us, ms, s, min, h or d; a date has its time zone, such as 2027-03-31T18:00:00Z"),
    (Money, "money", "$ or cent"),
    (Cost, "cost per request", "$ or cent, per request or per a number of requests"),
    (Price, "price per hour", "$ or cent, per hour"),
    (Rate, "rate", "per s, min, h, day, week or month, or Hz"),
    (Spot, "true, false or rate", "per s, min, h, day, week or month"),
    (Percent, "share", "%"),
    (Confidence, "number between 0 and 1, or none", ""),
    (CountRange, "range or number", "none"),
    (MemoryRange, "range of memory, or size", "MiB, GiB or TiB"),
)  # fmt: skip
ADVANCED = Tier("advanced")
LIMITS = {
    "gt": "more than {}",
    "ge": "at least {}",
    "lt": "less than {}",
    "le": "at most {}",
    "min_length": "not empty",
}
PLAIN = {str: "string", int: "integer", float: "number", bool: "true or false", Any: "any value"}


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldPage:
    """One field: `path` has `[]` for the items of a list and `<name>` for the keys of a map."""

    path: str
    type: str
    limits: str
    default: str
    unit: str
    meaning: str
    example: Any
    required: bool
    tier: str


def pages(model: type[BaseModel]) -> list[FieldPage]:
    """Return all fields of a kind of document, in the order of the schema."""
    found: list[FieldPage] = []
    _collect(model, "", found)
    return found


def matching(known: list[FieldPage], name: str) -> list[FieldPage]:
    """Return the fields that a name means: a full path, a path without `spec.`, or the end of a path."""
    tidy = re.sub(r"\[\d*\]", "[]", name).strip(".")
    for path in (tidy, f"spec.{tidy}"):
        if exact := [page for page in known if path in (page.path, _plain(page.path))]:
            return exact
    return [page for page in known if f".{_plain(page.path)}".endswith(f".{_plain(tidy)}")]


def _plain(path: str) -> str:
    return path.replace("[]", "").replace(".<name>", "")


def _collect(model: type[BaseModel], prefix: str, found: list[FieldPage]) -> None:
    defaults = model.model_construct().model_dump(mode="json", by_alias=True, warnings=False)
    for name, field in model.model_fields.items():
        key = field.alias or name
        path = f"{prefix}.{key}" if prefix else key
        found.append(_page(path, field, defaults.get(key)))
        kind, items = part(field.annotation)
        below = part(items)[0] if items is not None else kind
        if isinstance(below, type) and issubclass(below, BaseModel):
            inside = {list: "[]", dict: ".<name>"}.get(get_origin(kind), "")
            _collect(below, f"{path}{inside}", found)


def _page(path: str, field: FieldInfo, default: Any) -> FieldPage:
    words, unit = _type(field.annotation, field.metadata)
    limits = [
        text.format(f"{getattr(one, name):g}")
        for one in field.metadata
        for name, text in LIMITS.items()
        if getattr(one, name, None) is not None
    ]
    shown = "required" if field.is_required() else _default(default)
    example = field.examples[0] if field.examples else default
    return FieldPage(
        path=path,
        type=words,
        limits=", ".join(limits),
        default=shown,
        unit=unit,
        meaning=field.description or _meaning(field.annotation),
        example=example,
        required=field.is_required(),
        tier=(BASIC if BASIC in field.metadata else ADVANCED).name,
    )


def _meaning(annotation: Any) -> str:
    """Return what the docstring of the fields below says; empty for a single value."""
    kind, items = part(annotation)
    below = part(items)[0] if items is not None else kind
    if not (isinstance(below, type) and issubclass(below, BaseModel)):
        return ""
    return " ".join((vars(below).get("__doc__") or "").split())


def _default(value: Any) -> str:
    if value is None:
        return "not set"
    return "as its fields say" if isinstance(value, dict) and value else flow(value)


def _type(annotation: Any, metadata: list[Any]) -> tuple[str, str]:
    """Return what may be written, in words, with the units allowed."""
    for quantity, words, unit in QUANTITIES:
        marks = get_args(quantity)[1:]
        if any(mark in metadata for mark in marks) or _has(annotation, quantity):
            return words, unit
    kind, items = part(annotation)
    if get_origin(kind) is Literal:
        return f"one of {', '.join(map(flow, get_args(kind)))}", ""
    if get_origin(kind) is list:
        return f"list of {_plural(_type(items, [])[0])}", ""
    if get_origin(kind) is dict:
        return f"object of {_plural(_type(items, [])[0])}", ""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return "object", ""
    patterned = re.search(r"pattern='([^']*)'", str(metadata) + str(annotation))
    return (f"string matching {patterned[1]}" if patterned else PLAIN.get(kind, "value")), ""


def _plural(words: str) -> str:
    """Return the words for several of a kind, such as strings matching a pattern."""
    noun, space, rest = words.partition(" ")
    return f"{noun}s{space}{rest}" if noun in ("string", "object", "number", "integer", "rate") else words


def _has(annotation: Any, quantity: Any) -> bool:
    """Return whether the annotation is the quantity, or the quantity or None."""
    if get_origin(annotation) is Annotated:
        return bool(annotation == quantity)
    return any(_has(one, quantity) for one in get_args(annotation) if get_origin(annotation) not in (list, dict))
