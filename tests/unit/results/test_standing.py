"""Laws of waivers: what is suggested leads back to what was measured, and covers nothing else."""

import copy
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fogspec.language.fingerprints import differing_rows, measured_record
from fogspec.language.schema import Application, Waiver
from fogspec.results.schema import Results, ResultsBody, results_of
from fogspec.results.standing import Standing, standing, waiver_lines
from tests.unit.compile.test_tasks import application

OLD, NEW, OTHER = ("sha256:" + digit * 64 for digit in "abc")
VALUES = st.one_of(st.integers(), st.booleans(), st.text(max_size=5), st.lists(st.integers(), max_size=3))
KEYS = st.sampled_from(["a", "b", "a.b", "a[0]", "a.b[1]", "c d", "", "spec.cloud"]).filter(bool)
PARAMETERS = st.dictionaries(KEYS, st.one_of(VALUES, st.dictionaries(KEYS, VALUES, max_size=3)), max_size=4)
NODES = st.builds(
    lambda env, parameters, prefix, arguments: {
        "package": "p", "executable": "e", "env": env, "parameters": parameters, "arguments": arguments,
        **({"launch": {"prefix": prefix}} if prefix else {}),
    },
    st.dictionaries(KEYS, st.text(max_size=4), max_size=3), PARAMETERS, st.sampled_from(["", "nice", "nice -n 5"]),
    st.lists(st.text(min_size=1, max_size=3), max_size=3),
)  # fmt: skip


def of(node: dict[str, Any], waivers: list[Waiver] | None = None) -> Application:
    found = application(cloud=[node])
    benchmark = found.spec.benchmark.model_copy(update={"waivers": waivers or []})
    return found.model_copy(update={"spec": found.spec.model_copy(update={"benchmark": benchmark})})


def measured(one: Application, files: dict[str, str] | None = None) -> Results:
    inputs = record(one, files)
    return results_of(ResultsBody(inputs=inputs, runner="local", samples=[]))


def record(one: Application, files: dict[str, str] | None = None) -> dict[str, Any]:
    exact = {name: value for name, value in (files or {}).items() if name == "image"}
    return {
        **measured_record(one, None, {name: at for name, at in (files or {}).items() if name not in exact}),
        **exact,
    }


def now(results: Results, one: Application, files: dict[str, str] | None = None) -> Standing:
    return standing(results, record(one, files), one.spec.benchmark.waivers)


@settings(max_examples=50, deadline=None)
@given(NODES, NODES, NODES)
def test_suggested_waivers_cover_that_change_and_no_other(
    before: dict[str, Any], after: dict[str, Any], later: dict[str, Any]
) -> None:
    results = measured(of(before))
    found = now(results, of(after))
    same = not differing_rows(record(of(before)), record(of(after)))
    assert found.counts == same
    if not found.suggested:
        assert same or found.changes
        return
    assert now(results, of(after, list(found.suggested))).counts
    assert now(results, of(after, list(found.suggested)[::-1])).counts, "in any order"
    if differing_rows(record(of(later)), record(of(before))) and differing_rows(record(of(later)), record(of(after))):
        further = now(results, of(later, list(found.suggested)))
        assert not further.counts or reached(results, of(later), found.suggested)


def reached(results: Results, later: Application, waivers: tuple[Waiver, ...]) -> bool:
    """Whether some of the waived changes alone make what is there now of what was measured."""
    suggested = now(results, later).suggested
    known = [(one.change, one.old, one.new) for one in waivers]
    return bool(suggested) and all((one.change, one.old, one.new) in known for one in suggested)


def test_the_values_are_not_changed_by_looking_at_them() -> None:
    node = {"package": "p", "executable": "e", "parameters": {"a": {"b": [1, 2]}}}
    before = copy.deepcopy(node)
    now(measured(of({**node, "parameters": {"a": {"b": [1, 3]}}})), of(node))
    assert node == before


@pytest.mark.parametrize(
    ("waivers", "counts"),
    [
        ([("image", OLD, NEW)], True),
        ([("image", OTHER, NEW)], False),
        ([("image", OLD, OTHER)], False),
        ([("image", OLD, OTHER), ("image", OTHER, NEW)], True),
        ([("other", OLD, NEW)], False),
        ([], False),
    ],
)
def test_an_image_is_waived_by_its_digests(waivers: list[tuple[str, str, str]], counts: bool) -> None:
    node = {"cmd": ["./node"]}
    named = [Waiver(change=name, old=old, new=new, reason="rebuilt") for name, old, new in waivers]
    found = now(measured(of(node), {"image": OLD}), of(node, named), {"image": NEW})
    assert found.counts == counts
    assert [one.change for one in found.suggested] == ([] if counts else ["image"])
    if not counts:
        assert found.reasons == ["image changed"]


def test_the_order_of_remappings_is_part_of_what_was_measured() -> None:
    node = {
        "package": "p",
        "executable": "e",
        "parameters": {"x": 1, "y": 2},
        "remappings": {"scan": "/a", "/scan": "/b"},
    }
    other = {**node, "remappings": {"/scan": "/b", "scan": "/a"}}
    found = now(measured(of(node)), of(other))
    assert [one.change for one in found.suggested] == ["spec.cloud[0].remappings"]
    assert now(measured(of(node)), of({**node, "parameters": {"y": 2, "x": 1}})).counts
    assert now(
        measured(of({**node, "remappings": {}})),
        of({"package": "p", "executable": "e", "parameters": {"x": 1, "y": 2}}),
    ).counts


def test_a_file_that_is_named_like_a_field_is_not_one() -> None:
    node = {"cmd": ["./node"]}
    results = measured(of(node), {"spec.cloud": OLD})
    found = now(results, of(node), {"spec.cloud": NEW})
    assert [one.change for one in found.suggested] == ["./spec.cloud"]
    assert now(results, of(node, list(found.suggested)), {"spec.cloud": NEW}).counts


def test_hostile_text_stays_text_in_what_is_printed() -> None:
    lines = waiver_lines([Waiver(change="spec.cloud[0].env.A", old="x\n  evil: 1", new="\x1b[31m", reason="r")])
    assert all("\n" not in line and "\x1b" not in line for line in lines)
