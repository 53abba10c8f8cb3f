"""Conditions on a message's fields, and the records of probes."""

import json
from types import SimpleNamespace as Message

import pytest

from fogspec.agent.records import Condition, Done, Writer, field_of

PLAN = Message(found=True, cost=3.5, name="rrt", poses=[Message(x=1), Message(x=2)], code=Message(val=1))


@pytest.mark.parametrize(
    "text",
    ["found == true", "cost < 4", "cost >= 3.5", "name == 'rrt'", 'name != "prm"', "len(poses) > 1", "poses[1].x == 2",
     "code.val == 1", "  code.val   <=1 "],
)  # fmt: skip
def test_conditions_that_hold(text):
    assert Condition.parse(text).failure(PLAN) is None


def test_a_condition_that_does_not_hold_says_what_is():
    assert Condition.parse("len(poses) > 5").failure(PLAN) == "len(poses) > 5 does not hold: it is 2"


@pytest.mark.parametrize("text", ["", "cost", "cost = 3", "len(poses > 3", "3 == cost", "cost <"])
def test_what_is_no_condition(text):
    with pytest.raises(ValueError, match="is not a condition"):
        Condition.parse(text)


@pytest.mark.parametrize("text", ["nothing == 1", "poses[9].x == 1", "code.val.deep == 1"])
def test_a_field_that_is_not_there(text):
    with pytest.raises(ValueError, match="has no field"):
        Condition.parse(text).failure(PLAN)


def test_a_comparison_that_cannot_be_decided():
    with pytest.raises(ValueError, match="cannot be decided"):
        Condition.parse("name < 3").failure(PLAN)


def test_fields_are_reached_by_name_and_index():
    assert field_of(PLAN, "poses[0].x") == 1


def test_records_are_lines(tmp_path):
    path = tmp_path / "timings.jsonl"
    writer = Writer("/pose", str(path))
    writer.request(Done(1.0, 0.5, 0.25, (3, 4)))
    writer.request(Done(2.0, 0.5), "found == true does not hold: it is False")
    writer.request(Done(3.0, None))
    writer.unmatched(4.0)
    writer.metric({"length": 2.0}, 5.0, (3, 4))
    writer.warning(None)
    writer.warning("beware")
    first, second, third, *others = (json.loads(line) for line in path.read_text().splitlines())
    assert (first["ok"], first["service_s"], first["stamp"]) == (True, 0.25, [3, 4])
    assert (second["ok"], second["reason"]) == (False, "found == true does not hold: it is False")
    assert (third["ok"], third["lost"], third["latency_s"]) == (False, True, 0.0)
    assert others == [
        {"name": "/pose", "unmatched": True, "at_s": 4.0},
        {"metric": {"length": 2.0}, "at_s": 5.0, "stamp": [3, 4]},
        {"warning": "beware"},
    ]
