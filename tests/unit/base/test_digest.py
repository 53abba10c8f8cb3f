"""Digests, against `sha256sum` and canonical texts that were written by hand."""

import subprocess

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogspec.base import digest


def by_the_system(content: bytes) -> str:
    return "sha256:" + subprocess.run(["sha256sum"], input=content, capture_output=True).stdout.split()[0].decode()


@pytest.mark.parametrize("content", [b"", b"abc", b"\0" * 1000])
def test_bytes(content: bytes) -> None:
    assert digest.of_bytes(content) == by_the_system(content)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ({"b": 1, "a": [1.5, None, True]}, '{"a":[1.5,null,true],"b":1}'),
        ({"α": "ü", "a": {"z": 1, "y": ""}}, '{"a":{"y":"","z":1},"α":"ü"}'),
        ([], "[]"),
        ("é\n", '"é\\n"'),
    ],
)
def test_values_by_their_canonical_text(value: object, text: str) -> None:
    assert digest.of_value(value) == by_the_system(text.encode())


@pytest.mark.parametrize("value", [float("nan"), [float("inf")], {"a": -float("inf")}])
def test_a_value_without_an_exact_text_is_refused(value: object) -> None:
    with pytest.raises(ValueError, match="JSON"):
        digest.of_value(value)


@given(st.dictionaries(st.text(), st.integers(), min_size=2))
def test_the_order_of_keys_is_no_content_and_a_value_is(value: dict[str, int]) -> None:
    assert digest.of_value(dict(reversed(value.items()))) == digest.of_value(value)
    key = next(iter(value))
    assert digest.of_value({**value, key: value[key] + 1}) != digest.of_value(value)


def test_a_short_digest_is_its_beginning() -> None:
    whole = by_the_system(b"abc")
    assert digest.shorten(whole) == whole[7:19]
    assert digest.shorten(whole, 4) == whole[7:11]


def test_a_digest_survives_being_a_label() -> None:
    whole = digest.of_bytes(b"x")
    label = digest.as_label(whole)
    assert label is not None
    assert len(label) <= 63
    assert label.isalnum()
    assert label == label.lower()
    assert digest.from_label(label) == whole
    assert [digest.as_label(text) for text in ("", "unknown", "sha256:2", f"{whole}0")] == [None] * 4
    assert [digest.from_label(text) for text in ("", "!", "a", "a" * 51, "\n", "ü" * 52)] == [None] * 6
