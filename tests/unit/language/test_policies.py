"""A team's own JSON Schemas, over the document with defaults filled in and quantities as numbers."""

import itertools
import json
import socket
from pathlib import Path
from typing import Any

import pytest

from fogspec.base.diagnostics import Diagnostic, DiagnosticError
from fogspec.base.quantities import Price, Strict
from fogspec.cli import main
from fogspec.language.loader import load
from fogspec.language.render import numeric_document, render_document
from fogspec.language.rules.policies import Policies

SPEC = """\
apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: { name: arm }
spec:
  cloud: [{ cmd: [plan] }]
  probe: { callback: plan }
  constraints: { latency: 2s, cost: $1/1000 requests, price: 150 cent/h }
  hardware: { cpus: 2..64, memory: 4GiB.. }
  infra: [aws/us-east-1]
  benchmark: { budget: $2.50, min_success_rate: 99% }
"""


@pytest.fixture(autouse=True)
def _project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("specs").mkdir()
    Path("specs/arm.yaml").write_text(SPEC, "utf-8")


def policy(content: Any, name: str = "team") -> str:
    path = Path(f"policies/{name}.schema.json")
    path.parent.mkdir(exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content), "utf-8")
    return str(path)


def about(path: str, schema: Any) -> dict[str, Any]:
    """Return the schema for the field at this dotted path."""
    for step in reversed(path.split(".")):
        schema = {"properties": {step: schema}}
    return schema


def broken(*named: str) -> list[Diagnostic]:
    return Policies(named).check_specs(load(["specs/arm.yaml"]))


def test_quantities_are_numbers_in_base_units() -> None:
    (loaded,) = load(["specs/arm.yaml"])
    spec = numeric_document(loaded.application)["spec"]
    text = render_document(loaded.application)["spec"]
    assert spec["constraints"] | text["constraints"] == text["constraints"]
    assert {name: spec["constraints"][name] for name in ("latency", "cost", "price", "confidence")} == {
        "latency": 2.0, "cost": 0.001, "price": 1.5, "confidence": 0.9,
    }  # fmt: skip
    assert (spec["hardware"]["cpus"], spec["hardware"]["memory"]) == ({"min": 2.0, "max": 64.0}, {"min": 4.0})
    assert (spec["benchmark"]["budget"], spec["benchmark"]["min_success_rate"]) == (2.5, 0.99)
    assert spec["benchmark"]["stop"] == {"requests": 200, "duration": 300.0}
    assert spec.keys() == text.keys()


@pytest.mark.parametrize(
    ("path", "schema", "span"),
    [
        ("spec.benchmark.budget", {"maximum": 10}, None),
        ("spec.benchmark.budget", {"maximum": 2}, (10, 24)),
        ("spec.benchmark.stop.duration", {"maximum": 60}, (10, 3)),
        ("spec.constraints.confidence", {"minimum": 0.95}, (7, 3)),
        ("spec.infra", {"items": {"pattern": "^aws/eu-"}}, (9, 11)),
        ("spec.hardware.cpus.max", {"maximum": 8}, (8, 21)),
        ("spec.hardware.memory", {"required": ["max"]}, (8, 36)),
        ("spec.hardware.spot", False, (8, 3)),
        ("spec", {"required": ["ros"]}, (4, 1)),
        ("metadata.name", {"pattern": "^team-"}, (3, 19)),
        ("spec.ros.image", {"pattern": "@sha256:"}, None),
    ],
)
def test_a_value_is_shown_or_what_is_around_it(path: str, schema: Any, span: tuple[int, int] | None) -> None:
    policy(about(path, schema))
    found = [(one.span.line, one.span.column) for one in broken()]
    assert found == ([span] if span else [])


def test_the_message_is_the_nearest_description_and_its_fix() -> None:
    limit = {"maximum": 2, "description": "a benchmark costs at most $2", "x-fix": "write '$2'"}
    policy(about("spec.benchmark.budget", limit))
    assert [(one.code, one.message, one.fix) for one in broken()] == [
        ("FS601", "a benchmark costs at most $2 (policies/team.schema.json)", "write '$2'")
    ]
    policy({"description": "small", **about("spec.benchmark.budget", {"maximum": 2})})
    assert [(one.message, one.fix) for one in broken()] == [("small (policies/team.schema.json)", None)]
    policy(about("spec.constraints.confidence", {"minimum": 0.95}))
    assert broken()[0].message == (
        "spec.constraints.confidence: 0.9 is less than the minimum of 0.95 "
        "(policies/team.schema.json; spec.constraints.confidence is 0.9 by default)"
    )


def test_a_named_policy_is_read_besides_the_folder_and_once() -> None:
    inside = policy(about("spec.benchmark.budget", {"maximum": 2}))
    Path("elsewhere.json").write_text(json.dumps(about("spec.infra", {"maxItems": 0})), "utf-8")
    Path("policies/notes.json").write_text("not a policy", "utf-8")
    assert sorted(one.message.partition("(")[2] for one in broken("elsewhere.json", inside)) == [
        "elsewhere.json)", "policies/team.schema.json)",
    ]  # fmt: skip
    assert next((one.code, one.span.path) for one in broken("missing.json")) == ("FS101", "missing.json")


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("", 1), ("{\n'a': 1}", 2), ("[]", 1), ("true", 1), ('{"maximum": NaN}', 1), ("[" * 100_000, 1),
        ('{\n"type": "map"}', 2), ('{\n"pattern": "("}', 2), ('{"$schema":\n"http://json-schema.org/draft-07/schema#"}', 2),
        ('{"$ref":\n"https://example.com/a.json"}', 2), ('{"$ref":\n"other.schema.json"}', 2),
        ('{"allOf": [{"$ref":\n"#/$defs/nowhere"}]}', 2), ('{"$ref": "#"}', 1),
        ('{"properties":\n{"kind": {"const": ["Application"]}}}', 2), ('{"properties": {"spec": {"required":\n["prob"]}}}', 2),
        ('{"anyOf": [{"properties": {"spec": {"properties": {"infra": {"items": {}}, \n"cluod": false}}}}]}', 2),
    ],
)  # fmt: skip
def test_a_policy_that_is_wrong_is_an_error_at_its_place(
    content: str, line: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_network(*_: object) -> None:
        raise AssertionError("a policy must not use the network")

    monkeypatch.setattr(socket, "socket", no_network)
    path = policy(content)
    found = broken()
    assert [(one.code, one.span.path, one.span.line) for one in found] == [("FS602", path, line)]
    assert found[0].source_line is not None


def test_a_repeated_key_and_another_encoding_have_codes_of_their_own() -> None:
    policy('{"maximum": 1,\n"maximum": 2}')
    assert [(one.code, one.span.line) for one in broken()] == [("FS106", 2)]
    Path("policies/team.schema.json").write_bytes(b"\xff{}")
    assert [one.code for one in broken()] == ["FS102"]
    Path("policies/team.schema.json").write_bytes(b'\xef\xbb\xbf\t{"properties": {}}')
    assert broken() == []


class _Body(Strict):
    image_pinned: bool | None
    price: Price


class _Manifest(Strict):
    kind: str
    spec: _Body


def test_a_manifest_is_checked_by_policies_of_its_kind() -> None:
    kind = {"const": "DeploymentManifest"}
    pinned = {"const": True, "description": "images are pinned"}
    body = {"properties": {"image_pinned": pinned, "price": {"maximum": 1}}}
    policy({"properties": {"kind": kind, "spec": body}})
    loaded = load(["specs/arm.yaml"])
    assert Policies().check_specs(loaded) == []
    assert Policies().check_manifests(loaded, _Manifest) == []
    Path("compiled/arm").mkdir(parents=True)
    written = Path("compiled/arm/manifest.yaml")
    written.write_text("kind: DeploymentManifest\nspec:\n  image_pinned: false\n  price: $1.50/h\n", "utf-8")
    found = Policies().check_manifests(loaded, _Manifest)
    assert [(one.span.path, one.span.line) for one in found] == [(str(written), 3), (str(written), 4)]
    with pytest.raises(DiagnosticError, match="images are pinned"):
        Policies().require_manifests(loaded, _Manifest)
    policy({"properties": {"kind": kind, "spec": {"properties": {"image_pined": pinned}}}})
    assert [(one.code, one.fix) for one in Policies().check_manifests(loaded, _Manifest)] == [
        ("FS602", "write 'image_pinned'")
    ]
    written.write_text("cut", "utf-8")
    assert Policies().check_manifests(loaded, _Manifest) == []


def test_policies_share_the_time_of_a_command_and_each_that_gets_none_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A clock that goes on by 2.6 s whenever it is looked at: reading a policy takes that long, and judging by it."""
    ticks = itertools.count()
    monkeypatch.setattr("fogspec.base.signals.process_time", lambda: 2.6 * next(ticks))
    for name in "abcdefghijkl":
        policy(about("spec.hardware.spot", False), name)
    with pytest.raises(SystemExit) as end:
        main(["validate", "-o", "json"])
    assert end.value.code == 1
    found = json.loads(capsys.readouterr().out)
    assert [(one["path"], one["message"]) for one in found] == [
        (
            f"policies/{name}.schema.json",
            "the policy is not read: policies before it took 20 s of processor time together",
        )
        for name in "abcdefghijkl"
    ]


def test_many_quick_policies_take_none_of_the_time_of_a_command(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = itertools.count()
    monkeypatch.setattr("fogspec.base.signals.process_time", lambda: 0.099 * next(ticks))
    for number in range(110):
        policy(about("spec.hardware.spot", False), f"p{number}")
    assert [one.code for one in broken(*sorted(map(str, Path("policies").iterdir())))] == ["FS601"] * 110
