"""Laws of the language: written and read is the same spec; types and schema accept the same documents."""

import copy
import itertools
import json
from pathlib import Path
from typing import Any

import jsonschema
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fogspec.base.units import Range
from fogspec.base.yaml import reader
from fogspec.base.yaml.positions import plain
from fogspec.base.yaml.writer import block, flow, yaml_text
from fogspec.language.loader import check_text
from fogspec.language.render import render_document
from fogspec.language.schema import (
    Application,
    Benchmark,
    Constraints,
    Hardware,
    Load,
    Metadata,
    Node,
    Objective,
    Probe,
    Ros,
    Scale,
    Spec,
    Stop,
)
from fogspec.language.validate import validate

ROOT = Path(__file__).resolve().parents[2]
SCHEMA = jsonschema.Draft202012Validator(json.loads((ROOT / "schemas" / "Application.json").read_text("utf-8")))

texts = st.text(
    st.characters(codec="utf-8", exclude_categories=("Cs", "Cc", "Cf", "Zl", "Zp", "Cn", "Co")), max_size=12
)
short = st.floats(min_value=1e-9, max_value=200, allow_nan=False)
positive = st.floats(min_value=1e-9, max_value=1e9, allow_nan=False)
scalars = st.one_of(
    st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False, allow_infinity=False), texts
)
values = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts.filter(bool), inner, max_size=3),
    max_leaves=8,
)
parameters = st.dictionaries(
    st.from_regex(r"[a-z_]{1,8}", fullmatch=True),
    st.one_of(
        scalars,
        st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=3),
        st.lists(texts, min_size=1, max_size=3),
    ),
    max_size=3,
)


def ranges(ends: st.SearchStrategy[float]) -> st.SearchStrategy[Range]:
    return st.one_of(
        st.tuples(ends, ends).map(lambda two: Range(min(two), max(two))), ends.map(lambda low: Range(low, None)),
        ends.map(lambda high: Range(None, high)),
    )  # fmt: skip


@st.composite
def applications(draw: st.DrawFn) -> Application:
    optional = lambda one: draw(st.none() | one)  # noqa: E731
    node = Node(
        package="a", executable="b", parameters=draw(parameters), arguments=draw(st.lists(texts, max_size=3)),
        env=draw(st.dictionaries(texts.filter(bool), texts, max_size=2)),
    )  # fmt: skip
    spec = Spec(
        cloud=[node], ros=Ros(distro="humble", setup=draw(st.lists(texts, max_size=2))), probe=Probe(callback="plan"),
        infra=["aws"],
        constraints=Constraints(latency=optional(short), cost=optional(positive), price=optional(positive)),
        objective=Objective(alpha=draw(st.floats(0, 1)), scale=Scale(latency=optional(positive), cost=optional(positive)),
                            load=Load(rate=draw(positive))),
        hardware=Hardware(
            spot=draw(st.booleans() | positive), cpus=optional(ranges(positive)), memory=optional(ranges(positive)),
        ),
        benchmark=Benchmark(
            budget=draw(positive), min_success_rate=draw(positive),
            stop=Stop(requests=optional(st.integers(2, 10**6)), precision=optional(positive)),
        ),
    )  # fmt: skip
    return Application(apiVersion="fogspec.dev/v1alpha1", kind="Application", metadata=Metadata(name="arm"), spec=spec)


@given(applications())
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_a_spec_that_is_written_and_read_is_the_same_spec(application: Application) -> None:
    text = "\n".join(line for line, _ in block(render_document(application))) + "\n"
    loaded, wrong = check_text(text.encode(), "spec.yaml")
    assert [one for one in wrong if one.severity == "error"] == []
    assert loaded[0].application == application
    again = "\n".join(line for line, _ in block(render_document(loaded[0].application))) + "\n"
    assert again == text


@given(values)
@settings(max_examples=200, deadline=None)
def test_a_value_in_flow_style_is_read_back_with_its_types(value: Any) -> None:
    (node,), wrong = reader.documents(f"value: {flow(value)}\n", "x.yaml")
    assert wrong == []
    assert json.dumps(plain(node)) == json.dumps({"value": value})


BASES = [
    plain(node)
    for path in sorted((ROOT / "specs").glob("*.yaml"))
    for node in reader.documents(path.read_text("utf-8"), path.name)[0]
]
ODD = st.one_of(
    st.none(), st.booleans(), st.integers(-5, 500), st.floats(-2, 100).filter(lambda one: not one.is_integer()), texts,
    st.sampled_from([
        "2s", "0s", "2", "1e-3s", "$1", "$0", "$1/request", "5%", "2..64", "64", "..", "4GiB..", "..8GiB", "grid", "jazzy",
        "none", "mean", " 2 s ", "1 TiB", "$1/0 requests", "10/s", "3 cent", "$ 2.5", "$1/h", "x-1", "A", "aws",
    ]),
    st.lists(texts, max_size=2), st.dictionaries(texts, texts, max_size=1),
)  # fmt: skip


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(found for key, one in inner for found in places(one, (*path, key)))]


@given(st.data())
@settings(max_examples=300, deadline=None)
def test_types_and_schema_accept_the_same_documents(data: st.DataObject) -> None:
    """Except what no schema can say: a range from large to small, a cost per less than one request, overflow,
    and that 200.0 is no whole number here.
    """
    document = copy.deepcopy(data.draw(st.sampled_from(BASES)))
    *parents, last = data.draw(st.sampled_from(places(document)[1:]))
    target = document
    for step in parents:
        target = target[step]
    target[last] = data.draw(ODD)
    node, wrong = reader.documents(f"{flow(document)}\n", "x.yaml")
    assert wrong == []
    by_types = validate(Application, node[0]).wrong
    by_schema = [*itertools.islice(SCHEMA.iter_errors(document), 1)]
    if target[last] != "$1/0 requests":
        assert bool(by_types) == bool(by_schema), (by_types, by_schema)


def read(content: bytes) -> Any:
    """What the reader that knows places makes of a file of one document; None for one that it refuses."""
    text, wrong = reader.decode(content, "a file", 64 << 20)
    nodes, more = ([], []) if wrong else reader.documents(text, "a file")
    return None if wrong or more or len(nodes) != 1 else plain(nodes[0])


def same_types(one: Any, other: Any) -> bool:
    """Whether two values are equal and of the same types, which `==` does not tell of 1, 1.0 and True."""
    if type(one) is not type(other):
        return False
    if isinstance(one, dict):
        return [*one] == [*other] and all(same_types(value, other[key]) for key, value in one.items())
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same_types, one, other))
    return bool(one == other)


PIECES = [
    "",
    " ",
    "\n",
    ": ",
    "- ",
    "&a ",
    "*a",
    "!!str ",
    "0",
    "on",
    "1:30",
    "#",
    "'",
    '"',
    "{",
    "}",
    "\t",
    "\r",
    "---\n",
]
PIECES += ["? ", "<<: ", "~", "|", ">", "%", "\u2028"]
generated = st.dictionaries(texts.filter(bool), values | st.text(max_size=12).map("a\n{}".format), max_size=4)


@given(generated)
def test_what_is_generated_is_read_fast_and_the_same(data: dict[str, Any]) -> None:
    content = yaml_text(data, "a test").encode()
    slow = read(content)
    assert same_types(reader.canonical(content), slow), "also where both refuse it"


@settings(max_examples=150)
@given(generated, st.data())
def test_what_was_edited_is_never_read_otherwise(data: dict[str, Any], draw: st.DataObject) -> None:
    content = yaml_text(data, "a test").encode()
    for _ in range(draw.draw(st.integers(1, 3))):
        start = draw.draw(st.integers(0, len(content)))
        end = draw.draw(st.integers(start, min(len(content), start + 3)))
        piece = draw.draw(st.sampled_from(PIECES))
        content = content[:start] + piece.encode() + content[end:]
    fast = reader.canonical(content)
    assert fast is None or same_types(fast, read(content))
