"""Introspection of the schema's types: the keys that a mapping may have, and the type at a path."""

import types
from typing import Annotated, Any, Union, get_args, get_origin

from fogspec.base.quantities import Strict
from fogspec.base.yaml.positions import Path


def part(annotation: Any) -> tuple[Any, Any]:
    """Return an annotation without `None` and `Annotated`, and the type of its items or values."""
    while True:
        origin = get_origin(annotation)
        if origin is Annotated:
            annotation = get_args(annotation)[0]
        elif origin in (Union, types.UnionType):
            annotation = next(one for one in get_args(annotation) if one is not type(None))
        else:
            break
    arguments = get_args(annotation)
    items = arguments[-1] if origin in (list, dict) and arguments else None
    return annotation, items


def fields_of(annotation: Any) -> dict[str, Any]:
    """Return the keys of a mapping of the schema with their annotations; empty for any other type."""
    kind = part(annotation)[0]
    if not (isinstance(kind, type) and issubclass(kind, Strict)):
        return {}
    return {field.alias or name: field.annotation for name, field in kind.model_fields.items()}


def annotation_at(model: Any, path: Path) -> Any:
    """Return the annotation at a path of a document of this type; None if the schema has none."""
    for step in path:
        fields, items = fields_of(model), part(model)[1]
        model = fields.get(step) if isinstance(step, str) and fields else items
        if model is None:
            return None
    return model


def home_of(model: Any, key: str, here: Path) -> Path | None:
    """Return the path nearest to `here` in the schema that has a field of this name, lists left out."""
    found: list[Path] = []
    queue: list[tuple[Path, Any]] = [((), model)]
    while queue:
        path, annotation = queue.pop(0)
        for name, below in fields_of(annotation).items():
            if name == key:
                found.append((*path, name))
            queue.append(((*path, name), below))

    def shared(path: Path) -> int:
        return sum(1 for a, b in zip(path, here, strict=False) if a == b)

    return max(found, key=lambda path: (shared(path), -len(path)), default=None)
