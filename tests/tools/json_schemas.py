"""JSON Schema 2020-12 of each kind of document, made from the types: `python -m tests.tools.json_schemas [--check]`.

An editor teaches the language from these files alone: descriptions, examples, defaults as people write them.
"""

import importlib
import json
import sys
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from fogspec_lab.generated import ROOT, write_or_check

KINDS = {
    "Application": "fogspec.language.schema:Application",
    "SamplingPlan": "fogspec.plan.schema:Plan",
    "Lock": "fogspec.language.lockfile:Lock",
    "Result": "fogspec.results.schema:Result",
    "Models": "fogspec.model.fit:Models",
    "Menu": "fogspec.choice.menu:Menu",
    "DeploymentManifest": "fogspec.compile.manifest:Manifest",
    "LiveState": "fogspec.deploy.schema:LiveState",
    "SharedState": "fogspec.deploy.schema:SharedState",
    "Project": "fogspec.deploy.schema:Project",
}
POSITIVE = "(?=[^eE/]*[1-9])"  # a quantity above zero, before its exponent and its unit


def model_of(kind: str) -> type[BaseModel]:
    """Return the type of a kind of document, imported on demand."""
    module, _, name = KINDS[kind].partition(":")
    found: type[BaseModel] = getattr(importlib.import_module(module), name)
    return found


def schema_of(kind: str) -> dict[str, Any]:
    """Return the JSON Schema of a kind of document, as a YAML 1.2 reader sees it."""
    model = model_of(kind)
    schema = model.model_json_schema(by_alias=True)
    _with_defaults(model, schema)
    for name, definition in schema.get("$defs", {}).items():
        found = _models(model).get(name)
        if found is not None:
            _with_defaults(found, definition)
    _tidy(schema)
    version = "v1alpha1"
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "$id": f"urn:fogspec:{version}:{kind}"}
    return {**head, "title": kind, **{key: value for key, value in schema.items() if key != "title"}}


def _models(model: type[BaseModel]) -> dict[str, type[BaseModel]]:
    """Return every model that a model contains, by name."""
    from fogspec.language.introspect import part

    found: dict[str, type[BaseModel]] = {}
    queue: list[Any] = [model]
    while queue:
        kind, items = part(queue.pop())
        queue += [items] if items is not None else []
        if isinstance(kind, type) and issubclass(kind, BaseModel) and kind.__name__ not in found:
            found[kind.__name__] = kind
            queue += [field.annotation for field in kind.model_fields.values()]
    return found


def _with_defaults(model: type[BaseModel], definition: dict[str, Any]) -> None:
    """Write defaults with their units; leave out those that say nothing, and titles that repeat the name."""
    defaults = model.model_construct().model_dump(mode="json", by_alias=True, warnings=False)
    by_key = {field.alias or name: field for name, field in model.model_fields.items()}
    for name, declared in definition.get("properties", {}).items():
        declared.pop("title", None)
        if any(getattr(mark, "gt", None) == 0 for mark in by_key[name].metadata) and declared.get("type") == "string":
            declared["gt"] = 0
        if "default" in declared:
            declared["default"] = defaults.get(name)
            if declared["default"] in (None, [], {}) or "$ref" in declared:
                del declared["default"]
    if definition.get("additionalProperties") is False:
        definition["patternProperties"] = {"^x-": {"description": "a key of your own; ignored"}}


def _tidy(node: Any) -> None:
    """Merge `X or null` into one type, and turn limits on quantities, which are strings, into patterns."""
    for child in node.values() if isinstance(node, dict) else node if isinstance(node, list) else ():
        _tidy(child)
    if not isinstance(node, dict):
        return
    if "patternProperties" in node:
        node.setdefault("additionalProperties", False)  # keys that are no names
    choices = node.get("anyOf")
    if isinstance(choices, list) and len(choices) == 2 and choices[1] == {"type": "null"} and "type" in choices[0]:
        del node["anyOf"]
        inner = dict(choices[0])
        kinds = inner["type"] if isinstance(inner["type"], list) else [inner["type"]]
        examples = node.get("examples") or inner.get("examples")
        node.update(inner, type=[*kinds, "null"])
        if examples:
            node["examples"] = examples
        if "enum" in node:
            node["enum"] = [*node["enum"], None]
    if node.get("type") in ("string", ["string", "null"]):
        above = node.pop("gt", None) == 0
        above = node.pop("exclusiveMinimum", None) == 0 or above
        node.pop("ge", None)
        node.pop("minimum", None)
        if above and "pattern" in node:
            node["pattern"] = f"^{POSITIVE}{node['pattern'].removeprefix('^')}"


def generated() -> dict[Path, str]:
    """Return every file that is made from the types, with its text."""
    return {
        ROOT / "schemas" / f"{kind}.json": json.dumps(schema_of(kind), indent=2, ensure_ascii=False) + "\n"
        for kind in KINDS
    }


if __name__ == "__main__":
    sys.exit(write_or_check(generated(), sys.argv[1:], "python -m tests.tools.json_schemas"))
