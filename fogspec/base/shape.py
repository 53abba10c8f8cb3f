"""From a tree of values to a typed document: the first of two passes, one mistake a field.

The types say what is right (pydantic); this module says what is wrong in the language's own words, each time at
its place in the file. Rules that concern several fields are `fogspec.rules`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from pydantic import BaseModel, ValidationError

from fogspec.base.diagnostics import Diagnostic
from fogspec.base.language import fields_of, part
from fogspec.base.mistakes import diagnose
from fogspec.base.nodes import Node, Path, dotted

M = TypeVar("M", bound=BaseModel)


@dataclass
class Checked(Generic[M]):
    """The document as far as it is right: `value` is None as soon as anything is wrong, `broken` says where."""

    value: M | None
    data: Any
    wrong: list[Diagnostic]
    broken: set[Path]


def check(model: type[M], node: Node, strict: bool = True) -> Checked[M]:
    """The typed document, or every field that is wrong."""
    wrong: list[Diagnostic] = []
    broken: set[Path] = set()
    data = _data(model, node, (), wrong, broken)
    value = None
    try:
        value = model.model_validate(data, strict=strict)
    except ValidationError as problems:
        for error in problems.errors(include_url=False):
            path = tuple(step for step in error["loc"] if step != "[key]")
            if path in broken:
                continue
            broken.add(path)
            wrong.append(diagnose(model, node, path, error))
        wrong = list(_without_echoes(wrong))
    return Checked(None if wrong else value, data, wrong, broken)


def _data(annotation: Any, node: Node, path: Path, wrong: list[Diagnostic], broken: set[Path]) -> Any:
    """Plain values without `x-` keys of the language's mappings; keys without a value are refused."""
    fields, items = fields_of(annotation), part(annotation)[1]
    if isinstance(node.value, list):
        return [_item(items, child, (*path, i), wrong, broken) for i, child in enumerate(node.value)]
    if not isinstance(node.value, dict):
        return node.value
    data = {}
    for key, child in node.value.items():
        if fields and key.startswith("x-"):
            continue
        at = (*path, key)
        if child.empty and (key in fields or not fields):
            _refuse_empty(node.keys[key], at, wrong, broken)
        else:
            data[key] = _data(fields.get(key, items), child, at, wrong, broken)
    return data


def _item(items: Any, node: Node, path: Path, wrong: list[Diagnostic], broken: set[Path]) -> Any:
    if node.empty:
        _refuse_empty(node.place, path, wrong, broken)
    return _data(items, node, path, wrong, broken)


def _refuse_empty(place: Any, path: Path, wrong: list[Diagnostic], broken: set[Path]) -> None:
    fix = "remove the key, or give it a value" if isinstance(path[-1], str) else "remove the '-', or give it a value"
    wrong.append(Diagnostic("FS115", f"{dotted(path)} has no value", place, fix))
    broken.add(path)


def _without_echoes(wrong: list[Diagnostic]) -> Iterator[Diagnostic]:
    """Drop `x is missing` where a misspelt `x` has been reported already, in the same mapping."""
    meant = {(_parent(one, " is not"), one.fix) for one in wrong if one.code == "FS301"}
    for one in wrong:
        if one.code == "FS302":
            parent, name = _parent(one, " is missing"), one.message.removesuffix(" is missing").rpartition(".")[2]
            if (parent, f"write '{name}'") in meant:
                continue
        yield one


def _parent(one: Diagnostic, end: str) -> str:
    return one.message.partition(end)[0].rpartition(".")[0]
