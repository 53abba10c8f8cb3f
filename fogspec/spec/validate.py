"""From a tree of values to a typed document: the first of two passes, one error per field.

The types define what is valid (pydantic); `fogspec.spec.field_errors` words the errors and locates them in the file.
Rules between fields are `fogspec.spec.rules`.
"""

from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from pydantic import BaseModel, ValidationError

from fogspec.base.diagnostics import Diagnostic
from fogspec.base.yaml.positions import Node, Path, plain
from fogspec.spec.field_errors import diagnose
from fogspec.spec.typos import repair

M = TypeVar("M", bound=BaseModel)


@dataclass
class Validation(Generic[M]):
    """The document as far as it is valid: `value` is None if there is any error, `broken` are the paths of errors.

    `node` is the document as it was meant, with misspelt keys repaired, and `data` its values.
    """

    value: M | None
    node: Node
    data: Any
    wrong: list[Diagnostic]
    broken: set[Path]


def validate(model: type[M], node: Node, strict: bool = True) -> Validation[M]:
    """Return the typed document, or every field error."""
    repaired = repair(model, node)
    wrong, broken = repaired.wrong, repaired.broken
    data, value = plain(repaired.node), None
    try:
        value = model.model_validate(data, strict=strict)
    except ValidationError as problems:
        for error in problems.errors(include_url=False):
            path = tuple(step for step in error["loc"] if step != "[key]")
            echo = error["type"] == "missing" and path in repaired.meant
            if path not in broken and not echo:
                wrong.append(diagnose(model, repaired.node, path, error))
            broken.add(path)
    return Validation(None if wrong else value, repaired.node, data, wrong, broken)
