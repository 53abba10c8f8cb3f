"""Rules between fields: the second of two passes, run on the fields that the first one found valid.

Invalid fields are skipped and rules touching them stay silent, so that each error is reported once.
"""

from collections.abc import Iterator, Sequence
from typing import Any

from pydantic import ValidationError

from fogspec.base.diagnostics import Diagnostic
from fogspec.base.yaml.positions import Node, Path, find, key_span, span_of
from fogspec.language.rules import benchmark, link, machines, nodes
from fogspec.language.schema import Application
from fogspec.language.validate import Validation

RULES = (*nodes.RULES, *benchmark.RULES, *machines.RULES, *link.RULES)

STAND_INS: dict[Path, Any] = {
    ("apiVersion",): "fogspec.dev/v1alpha1",
    ("kind",): "Application",
    ("metadata",): {"name": "unnamed"},
    ("metadata", "name"): "unnamed",
    ("spec", "cloud"): [{"cmd": ["true"]}],
    ("spec", "probe"): {"callback": "request"},
    ("spec", "infra"): ["aws"],
}


def run_rules(checked: Validation[Application]) -> Iterator[Diagnostic]:
    """Yield the broken rules of one document beyond its single fields."""
    application, node = checked.value or _lenient(checked), checked.node
    if application is None:
        return
    for rule in RULES:
        for one in rule(application):
            if not any(_touches(path, checked.broken) for path in (one.path, *one.about)):
                span = (key_span(node, one.path) if one.at_key else None) or span_of(node, one.path)
                yield Diagnostic(one.code, one.message, span, one.fix, severity=one.severity)


def run_rules_together(documents: Sequence[tuple[Node, Validation[Application]]]) -> Iterator[Diagnostic]:
    """Yield the broken rules between documents."""
    path = ("metadata", "name")
    first: dict[str, Node] = {}
    for node, checked in documents:
        name = find(node, path)
        if name is None or not isinstance(name.value, str) or _touches(path, checked.broken):
            continue
        if name.value in first:
            there = first[name.value].span
            message = f"metadata.name {name.value} is taken by {there.path}:{there.line}"
            yield Diagnostic("FS510", message, name.span, "give each application a name of its own")
        first.setdefault(name.value, name)


def _touches(path: Path, broken: set[Path]) -> bool:
    """Return whether something at, around or under the path is wrong by itself."""
    return any(path[: len(one)] == one or one[: len(path)] == path for one in broken)


def _lenient(checked: Validation[Application]) -> Application | None:
    """Return the application without its broken fields; None if too little is left of it."""
    data = checked.data
    if not isinstance(data, dict) or not isinstance(data.get("spec"), dict):
        return None
    for path in sorted(checked.broken, key=len, reverse=True):
        _drop(data, path)
    for path, value in STAND_INS.items():
        parent = data if len(path) == 1 else data.get(path[0])
        if isinstance(parent, dict) and path[-1] not in parent:
            parent[path[-1]] = value
            checked.broken.add(path)
    try:
        return Application.model_validate(data, strict=True)
    except ValidationError:
        return None


def _drop(data: Any, path: Path) -> None:
    """Remove a field; remove the whole list for an item of one, so that no index moves."""
    while path and isinstance(path[-1], int):
        path = path[:-1]
    for step in path[:-1]:
        try:
            data = data[step]
        except (KeyError, IndexError, TypeError):
            return
    if isinstance(data, dict) and path:
        data.pop(path[-1], None)
