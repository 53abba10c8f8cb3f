"""Which request a topic's value is about."""

from fogspec.results.join import Request, Value, join


def request(start_s: float, end_s: float, stamp: tuple[int, int] | None = None) -> Request:
    return Request(name="r", latency_s=end_s - start_s, ok=True, metrics={}, start_s=start_s, stamp=stamp)


def joined(requests: list[Request], *values: Value) -> list[object]:
    join(requests, values)
    return [one.metrics.get("m") for one in requests]


def test_by_stamp_whatever_the_times():
    requests = [request(0, 1, (1, 0)), request(1, 2, (2, 0))]
    assert joined(requests, Value({"m": 5}, 9.0, (1, 0)), Value({"m": 6}, 0.0, (2, 0))) == [5, 6]


def test_by_time_just_before_and_long_after_the_end():
    requests = [request(0, 1), request(2, 3)]
    assert joined(requests, Value({"m": 1}, 0.9), Value({"m": 2}, 3.5)) == [1, 2]
    requests = [request(0, 1), request(2, 3)]
    assert joined(requests, Value({"m": 1}, 1.7), Value({"m": 2}, 2.1)) == [1, 2]


def test_requests_that_overlap_get_one_each_in_the_order_of_their_ends():
    requests = [request(0, 1), request(0.1, 2), request(0.2, 3)]
    values = [Value({"m": i}, t) for i, t in enumerate((1.01, 2.01, 3.01))]
    assert joined(requests, *values) == [0, 1, 2]
    requests = [request(0, 1), request(0.1, 2), request(0.2, 3)]
    values = [Value({"m": i}, t) for i, t in enumerate((0.99, 1.99, 2.99))]
    assert joined(requests, *values) == [0, 1, 2]


def test_a_value_before_everything_and_a_second_one_are_dropped():
    requests = [request(5, 6)]
    assert joined(requests, Value({"m": 1}, 1.0)) == [None]
    assert joined(requests, Value({"m": 2}, 6.5), Value({"m": 3}, 9.0)) == [2]


def test_what_the_code_itself_says_stands_and_metrics_do_not_hinder_each_other():
    one = request(0, 1)
    one.metrics = {"m": 7}
    join([one], [Value({"m": 8, "other": 1}, 0.5)])
    assert one.metrics == {"m": 7, "other": 1}


def test_lost_requests_get_nothing_by_time():
    lost = Request(name="r", latency_s=0.0, ok=False, metrics={}, start_s=1.0, lost=True)
    assert joined([lost], Value({"m": 1}, 1.5)) == [None]


def test_what_a_client_thinks_of_an_answer_decides():
    requests = [request(0, 1), request(1, 2)]
    join(requests, [Value({"!": "found == true does not hold"}, 2.001), Value({"!": None}, 1.002)])
    assert [(one.ok, one.reason, one.metrics) for one in requests] == [
        (True, None, {}), (False, "found == true does not hold", {}),
    ]  # fmt: skip
