"""Every field of the spec declares which stages read it, and a change of it makes exactly these stale."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, get_args, get_origin

import pytest
from pydantic import TypeAdapter
from pydantic.fields import FieldInfo

from fogspec.base.quantities import Strict
from fogspec.base.units import Range
from fogspec.language import fingerprints
from fogspec.language.fingerprints import differing_rows, measured_record, part_read_by
from fogspec.language.introspect import part
from fogspec.language.loader import check_text
from fogspec.language.schema import Application, Node, affects

# Every optional part is there, so that every leaf has a place; the rules that concern several fields do not matter here.
FULL = """
apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {name: full}
spec:
  cloud: [{package: p, executable: e, name: c, composable_node_descriptions: [{package: p, plugin: "p::A"}]}]
  robot: [{package: p, executable: e, name: r, composable_node_descriptions: [{package: p, plugin: "p::A"}]}]
  ros: {distro: humble}
  probe: {callback: plan}
  metrics: {length: {callback: length, unit: m}}
  constraints: {latency: 2s, metrics: {length: 3}}
  objective: {alpha: 0.5, scale: {latency: 1s}, load: {rate: 1/s, session: 1h, sessions: 1/day}}
  hardware: {cpus: 2..64}
  infra: [aws/us-east-1]
  benchmark:
    budget: $2
    sampler: adaptive
    waivers: [{change: plan.py, new: "sha256:1", reason: a comment}]
    workload:
      node: {package: p, executable: e, name: w, composable_node_descriptions: [{package: p, plugin: "p::A"}]}
  connectivity: {link: none}
"""
LEAVES = dict(fingerprints.stages_of_fields())
DIGESTS = {
    "plan": lambda one: part_read_by("plan", one),
    "results": measured_record,
    "choice": lambda one: fingerprints.chosen_record(one, {}),
}


@pytest.fixture(scope="module")
def full() -> Application:
    loaded, problems = check_text(FULL.encode(), "full.yaml")
    assert [one.message for one in problems if one.severity == "error"] == []
    return loaded[0].application


def changed(value: Any, path: tuple[str, ...], field: FieldInfo | None = None) -> Any:
    """The value with the leaf at the path changed to another valid one."""
    if not path:
        assert field is not None
        return other(value, field)
    step, *rest = path
    if step == "*" and isinstance(value, list):
        return [changed(value[0], tuple(rest)), *value[1:]]
    if step == "*" and isinstance(value, Mapping):
        first = next(iter(value))
        return {**value, first: changed(value[first], tuple(rest))}
    assert isinstance(value, Strict), (step, value)
    below = changed(getattr(value, step), tuple(rest), type(value).model_fields[step])
    return value.model_copy(update={step: below})


def other(value: Any, field: FieldInfo) -> Any:
    """A value of the field's type that is not this one: an example of the field, or one that is made from it."""
    kind = part(field.annotation)[0]
    if get_origin(kind) is Literal:
        return next((one for one in get_args(kind) if one != value), f"{value}-other")
    reader = TypeAdapter(Annotated[field.annotation, *field.metadata, None])
    for example in field.examples or ():
        found = reader.validate_python(example)
        if found != value:
            return found
    if isinstance(value, bool):
        return not value
    if isinstance(value, (int, float)):
        return value + 1
    if isinstance(value, Range):
        return Range(1.0, 3.0)
    return [*value, "other"] if isinstance(value, list) else f"{value}-other"


def test_there_are_as_many_leaves_as_the_language_has() -> None:
    assert len(LEAVES) > 100
    assert ("spec", "cloud", "*", "package") in LEAVES
    assert ("spec", "benchmark", "stop", "requests") in LEAVES


@pytest.mark.parametrize("path", LEAVES, ids=".".join)
def test_a_change_makes_stale_exactly_what_reads_the_field(full: Application, path: tuple[str, ...]) -> None:
    after = changed(full, path)
    assert after != full
    stale = {stage for stage, digest_of in DIGESTS.items() if digest_of(after) != digest_of(full)}
    assert stale == LEAVES[path] - {"estimate"}


@pytest.mark.parametrize("path", LEAVES, ids=".".join)
def test_a_field_that_changed_is_named(full: Application, path: tuple[str, ...]) -> None:
    names = differing_rows(measured_record(full), measured_record(changed(full, path)))
    assert bool(names) == ("results" in LEAVES[path])
    fixed = ".".join(path).partition(".*")[0]
    assert all(name.startswith(fixed) or fixed.startswith(name) for name in names)


def test_a_field_without_a_declaration_is_a_mistake() -> None:
    class Undeclared(Strict):
        node: Annotated[Node, affects("plan")]
        other: int

    with pytest.raises(TypeError, match="other does not declare"):
        list(fingerprints.stages_of_fields(Undeclared))


def test_a_field_may_declare_less_than_the_part_that_it_belongs_to() -> None:
    class Inner(Strict):
        read: int = 1
        unread: Annotated[int, affects()] = 2

    class Outer(Strict):
        inner: Annotated[Inner, affects("plan")] = Inner()

    assert dict(fingerprints.stages_of_fields(Outer)) == {("inner", "read"): {"plan"}, ("inner", "unread"): set()}
    assert fingerprints.part_read_by("plan", Outer()) == {"inner": {"read": 1}}
