"""The schemas are those of the types, and teach an editor what the types know."""

import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from fogspec.base.yaml.positions import plain
from fogspec.language.documents import Reading, SourceMap, documents_of
from tests.tools.json_schemas import KINDS, generated, schema_of

ROOT = Path(__file__).resolve().parents[3]
SPECS = sorted((ROOT / "specs").glob("*.yaml"))


def test_committed_schemas_and_pages_are_those_of_the_types() -> None:
    for path, text in generated().items():
        assert path.read_text("utf-8") == text, f"{path.name}: python -m tests.tools.json_schemas writes it"


@pytest.mark.parametrize("kind", KINDS)
def test_each_is_json_schema_2020_12(kind: str) -> None:
    schema = schema_of(kind)
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    jsonschema.Draft202012Validator.check_schema(schema)


def mistakes(document: Any) -> list[str]:
    validator = jsonschema.Draft202012Validator(json.loads((ROOT / "schemas" / "Application.json").read_text("utf-8")))
    return ["/".join(map(str, one.absolute_path)) for one in validator.iter_errors(document)]


def documents(path: Path) -> list[Any]:
    return [plain(node) for node in documents_of(path, SourceMap(), [], Reading())[0]]


@pytest.mark.parametrize("path", SPECS, ids=lambda path: path.stem)
def test_shipped_specs_have_no_mistake_and_the_line_for_the_editor(path: Path) -> None:
    assert [mistakes(document) for document in documents(path)] == [[]] * len(documents(path))
    assert path.read_text("utf-8").startswith("# yaml-language-server: $schema=../schemas/Application.json\n")


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("spec/constraints/latency", 2), ("spec/constraints/latency", "2"), ("spec/constraints/latency", "2 minutes"),
        ("spec/constraints/cost", "$0.001"), ("spec/objective/alpha", 1.5), ("spec/objective/alpha", "0.5"),
        ("spec/hardware/cpus", "2-64"), ("spec/hardware/memory", 4), ("spec/benchmark/sampler", "gird"),
        ("spec/benchmark/stop/requests", 0), ("spec/benchmark/stop/duration", "0s"), ("spec/infra", "aws"), ("spec/infra", []),
        ("spec/cloud", {}), ("metadata/name", "Arm"), ("kind", "Deployment"), ("spec/hardware/spot", "no"),
        ("spec/objective/load", "10/s"), ("spec/objective/load", {}), ("spec/hardware/spot", 0.1),
    ],
)  # fmt: skip
def test_an_editor_underlines(path: str, value: Any) -> None:
    (document,) = documents(ROOT / "specs" / "grasp-planning-recorded.yaml")
    place = document
    *parents, last = path.split("/")
    for step in parents:
        place = place.setdefault(step, {})
    place[last] = value
    assert mistakes(document) == [path]


def test_an_unknown_key_is_underlined_and_one_of_ones_own_is_not() -> None:
    (document,) = documents(ROOT / "specs" / "grasp-planning-recorded.yaml")
    document["spec"]["x-team"] = 1
    assert mistakes(document) == []
    document["spec"]["latancy"] = "2s"
    assert mistakes(document) == ["spec"]


def test_every_field_has_a_meaning_and_an_example_that_its_own_schema_accepts() -> None:
    schema = schema_of("Application")
    for name, definition in schema["$defs"].items():
        assert definition["description"], name
        for key, field in definition["properties"].items():
            assert field["description"], f"{name}.{key}"
            for example in [*field.get("examples", []), *([field["default"]] if "default" in field else [])]:
                part = {**field, "$defs": schema["$defs"]}
                assert list(jsonschema.Draft202012Validator(part).iter_errors(example)) == [], (
                    f"{name}.{key}: {example}"
                )


def test_defaults_are_written_with_their_units() -> None:
    stop = schema_of("Application")["$defs"]["Stop"]["properties"]
    assert stop["duration"]["default"] == "5min"
