"""Pairing requests and responses: each way of matching, and what is lost."""

import struct

import pytest

from fogspec.probe.fogspec_topics import PENDING, Pairing, stamp_of


def played(match: str, *events: tuple[str, float]) -> list[tuple[float, float | None]]:
    """Plays `>k` (request k) and `<k` (response k) at their times."""
    pairing, done = Pairing(match), []
    for what, now_s in events:
        take = pairing.take_request if what[0] == ">" else pairing.take_response
        done += take(what[1:], now_s)
    return done


def test_by_stamp_a_late_response_still_finds_its_request():
    assert played("stamp", (">a", 0), (">b", 1), ("<b", 2), ("<a", 5)) == [(1, 1), (0, 5)]


def test_by_stamp_a_foreign_response_is_not_counted():
    assert played("stamp", (">a", 0), ("<x", 1)) == []


def test_by_order_responses_go_to_the_oldest_open_request():
    assert played("order", (">a", 0), (">b", 1), ("<", 2), ("<", 5)) == [(0, 2), (1, 4)]


def test_first_request_ignores_requests_until_a_response():
    assert played("first_request", (">a", 0), (">b", 1), ("<", 3), (">c", 4), ("<", 6)) == [(0, 3), (4, 2)]


def test_last_response_closes_a_request_with_the_last_response_before_the_next():
    events = [(">a", 0), ("<", 1), ("<", 2), (">b", 10), (">c", 20)]
    assert played("last_response", *events) == [(0, 2), (10, None)]


def test_a_request_without_response_is_reported_once_too_many_are_open():
    done = played("stamp", *((f">{i}", float(i)) for i in range(PENDING + 1)))
    assert done == [(0.0, None)]


@pytest.mark.parametrize("order", "<>")
def test_the_stamp_is_read_in_the_message_s_own_byte_order(order):
    header = bytes([0, order == "<", 0, 0])
    assert stamp_of(header + struct.pack(f"{order}iI", 12, 345) + b"rest") == (12, 345)
