"""From a tree of values to a typed document: the first of two passes, one error per field.

The types define what is valid (pydantic); `fogspec.language.field_errors` words the errors and locates them in the file.
Rules between fields are `fogspec.language.rules`.
"""

from dataclasses import dataclass
from typing import Any, Generic, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from fogspec.base.diagnostics import Diagnostic
from fogspec.base.yaml.positions import Node, Path, find, plain
from fogspec.language.field_errors import diagnose
from fogspec.language.typos import repair

M = TypeVar("M", bound=BaseModel)

# The files of an application that a command may be given in place of each other.
OURS = ("Application", "SamplingPlan", "Result", "Models", "Menu", "DeploymentManifest")
ANOTHER = "give the name of its application in place of the file: "


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
    """Return the typed document, or every field error; only one if it is another of fogspec's files."""
    if (other := _another(model, node)) is not None:
        return Validation(None, node, plain(node), [other], {()})
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


def _another(model: type[BaseModel], node: Node) -> Diagnostic | None:
    """Return the diagnostic of a document of another of our kinds than that of the model; None if it is none."""
    kind, name = find(node, ("kind",)), find(node, ("metadata", "name"))
    expected = get_args(model.model_fields["kind"].annotation) if "kind" in model.model_fields else ()
    if kind is None or kind.value in expected or kind.value not in OURS or not set(OURS) & set(expected):
        return None
    known = name.value if name is not None and isinstance(name.value, str) else "NAME"
    message = f"kind must be {expected[0]}, not {kind.value}"
    return Diagnostic("FS307", message, kind.span, f"{ANOTHER}{known}")
