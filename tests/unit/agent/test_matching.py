"""Matching requests and responses: each way of matching, what is lost, and when the paper's heuristics mislead."""

import struct

import pytest

from fogspec.agent.matching import PENDING, Matcher, stamp_of, with_stamp

Played = list[tuple[float, float | None, float | None]]


def played(matcher: Matcher, *events: tuple[str, float]) -> Played:
    """Plays `>k` (request k) and `<k` (response k) at their times; (start, latency, service) of each that is over."""
    done = []
    for what, now_s in events:
        stamp = (ord(what[1]), 0) if len(what) > 1 else None
        if what[0] == ">":
            done += matcher.take_request(stamp, now_s)
        elif (one := matcher.take_response(stamp, now_s)) is not None:
            done.append(one)
    return [(one.start_s, one.latency_s, one.service_s) for one in done]


def test_by_stamp_a_late_response_still_finds_its_request():
    found = played(Matcher("stamp"), (">z", 0), ("<z", 0), (">a", 0), (">b", 1), ("<b", 2), ("<a", 5))
    assert found == [(0, 0, 0), (1, 1, 1), (0, 5, 3)]


def test_a_foreign_response_belongs_to_nobody():
    matcher = Matcher("stamp")
    assert matcher.take_request((1, 2), 0) == []
    assert matcher.take_response((7, 7), 1) is None
    assert Matcher("order").take_response(None, 1) is None


def test_responses_to_requests_from_before_the_first_that_was_heard_are_not_foreign():
    for match in ("stamp", "order"):
        matcher = Matcher(match)
        assert matcher.was_sent_before((5, 0) if match == "stamp" else None), "nothing was heard so far"
        matcher.take_request((5, 0) if match == "stamp" else None, 0)
        assert [matcher.was_sent_before((second, 0)) for second in (4, 5, 6)] == [match == "stamp", False, False]


def test_by_order_responses_go_to_the_oldest_open_request_and_waiting_is_not_service():
    assert played(Matcher("order"), (">", 0), (">", 1), ("<", 2), ("<", 5)) == [(0, 2, 2), (1, 4, 3)]


def test_without_a_response_in_time_a_request_is_lost():
    matcher = Matcher("stamp", timeout_s=3)
    played(matcher, (">z", 0), ("<z", 0))
    assert played(matcher, (">a", 0), (">b", 2), ("<b", 3), (">c", 4)) == [(2, 1, 1), (0, None, None)]
    assert [one.latency_s for one in matcher.expire(7.5)] == [None]
    assert matcher.take_response((ord("c"), 0), 8) is None


@pytest.mark.parametrize("delay_s", [0.05, 0.25])
def test_a_stamp_is_that_of_one_request(delay_s: float) -> None:
    """A driver that stamps nothing, ten a second: of a pipeline of 250 ms each response was the latest request's."""
    events = [(">z", 0.1 * n) for n in range(40)] + [("<z", 0.1 * n + delay_s) for n in range(40)]
    found = played(Matcher("stamp"), *sorted(events, key=lambda one: one[1]))
    assert sum(one[1] is None for one in found) > 0.9 * len(found)
    matcher = Matcher("stamp")
    played(matcher, (">a", 0), ("<a", 1))
    assert "its stamp 97.000000000 is that of an earlier request" in str(matcher.take_request((97, 0), 2.0)[0].why)
    assert not matcher.take_request((98, 0), 2.0)


def test_too_many_open_requests_lose_the_oldest():
    matcher = Matcher("stamp")
    played(matcher, (">a", 0), ("<a", 0))
    done = [one for i in range(PENDING + 1) for one in matcher.take_request((i, 1), float(i))]
    assert [(one.start_s, one.latency_s, one.stamp) for one in done] == [(0.0, None, (0, 1))]


def test_what_came_before_the_first_answer_is_not_lost_but_was_not_heard():
    matcher = Matcher("stamp", timeout_s=3)
    assert played(matcher, (">a", 0), (">b", 9), (">c", 10), ("<c", 11), (">d", 12)) == [(10, 1, 1)]
    assert len(matcher.open) == 1


def driven(match: str, busy_s: float, period_s: float, count: int = 50) -> tuple[float, str | None]:
    """The mean latency that is read of a node that works `busy_s` on each request, one by one, sent every `period_s`."""
    matcher, free_s, events = Matcher(match), 0.0, []
    for i in range(count):
        free_s = max(free_s, i * period_s) + busy_s
        events += [(">", i * period_s), ("<", free_s)]
    found = played(matcher, *sorted(events, key=lambda one: one[1]))[1:]
    return sum(one[1] or 0.0 for one in found) / len(found), matcher.warning()


def test_first_request_is_right_for_a_node_that_is_idle_between_requests():
    assert driven("first_request", 0.02, 0.1) == (pytest.approx(0.02), None)


def test_first_request_misleads_for_a_saturated_node_and_says_so():
    read_s, warning = driven("first_request", 0.06, 0.05)
    assert read_s < 0.05
    assert "of the requests came while another was open" in warning


def test_last_response_is_right_for_a_saturated_node():
    assert driven("last_response", 0.06, 0.05) == (pytest.approx(0.06), None)


def test_last_response_reads_the_period_of_an_idle_node_and_says_so():
    read_s, warning = driven("last_response", 0.02, 0.1)
    assert read_s == pytest.approx(0.1)
    assert "found the node idle" in warning


@pytest.mark.parametrize("order", "<>")
def test_the_stamp_is_read_and_written_in_the_message_s_own_byte_order(order):
    message = bytes([0, order == "<", 0, 0]) + struct.pack(f"{order}iI", 12, 345) + b"rest"
    assert stamp_of(message) == (12, 345)
    assert stamp_of(with_stamp(message, (7, 8))) == (7, 8)
    assert with_stamp(message, (7, 8))[12:] == b"rest"


def test_a_message_that_is_too_short_for_a_header():
    with pytest.raises(ValueError, match="too short"):
        stamp_of(b"\0\1\0\0\0")
