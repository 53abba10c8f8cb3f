"""How long the requests of a sample take at the rate at which they will come, which waits for those before are a part of.

Requests of a sample that followed one another waited for none. Their times, in their order, say how long they would have waited
for each other had one come each period (`fogspec.numerics.waiting`). Several at a time waited while they were measured, if they
came as fast.
"""

import io
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fogspec.agent.intervals import QUANTILES
from fogspec.base.errors import InvalidInput
from fogspec.numerics.waiting import BUSY, table, waits_s
from fogspec.results.io import raw_timings
from fogspec.results.ranges import ERROR
from fogspec.results.requests import RecordRules, Requests, parse_requests
from fogspec.results.schema import Arrivals, Measured
from fogspec.results.statistics import errors_of, weights

AT_ONCE = 0.01  # of the time in which requests are open: so much of it may be of two at once
SLOWER = 0.95  # of the declared rate: requests that came less often waited less


def arrivals_in(
    records: Sequence[Measured], folder: Path, rules: RecordRules, requests_per_s: float
) -> dict[str, Arrivals]:
    """Return the arrivals of samples by id, from their raw timings in `folder`; of those without timings none are known."""
    found = {}
    for record in records:
        if record.state != "ok" or record.timings is None or record.latency is None:
            continue
        try:
            content = raw_timings(record, folder)
        except InvalidInput:  # `check` says so
            continue
        requests = parse_requests(io.BytesIO(content), rules)
        if requests.latencies_s and (one := arrivals_of(record, requests, rules, requests_per_s)) is not None:
            found[record.id] = one
    return found


def arrivals_of(record: Measured, requests: Requests, rules: RecordRules, requests_per_s: float) -> Arrivals | None:
    """Return the arrivals of a sample with at least one valid request; None for figures that nothing can be reckoned with."""
    if not one_by_one(requests):
        sent_per_s = _sent_per_s(requests)
        slower = sent_per_s < SLOWER * requests_per_s
        return Arrivals(
            requests_per_s=requests_per_s,
            table=None if slower else tuple(BUSY.tolist()),
            sent_per_s=sent_per_s if slower else None,
        )
    mean_s = record.latency.mean if record.latency is not None else 0.0
    open_s = requests.busy_s(mean_s)
    times_s = np.array([one.open_s for one in requests.spans])
    if not open_s > 0:
        return None
    # What the machine does after a request, for as long as the sample's bill says.
    between_s = float(times_s.mean()) * max((record.busy or 0.0) / open_s - 1, 0.0)
    share = QUANTILES.get(rules.statistic)
    counts = [one.valid if share is None else one.waited for one in requests.spans]
    shares = np.zeros(len(times_s))
    kinds = [one.scenario for one, count in zip(requests.spans, counts, strict=True) if count]
    shares[counts] = weights(kinds, rules.scenarios)
    with np.errstate(all="ignore"):
        found = table(times_s, between_s, shares, share)
        errors = errors_of(at_rate(requests, requests_per_s, between_s), rules.scenarios)
    if not (np.isfinite(found).all() and (np.diff(found) > 0).all()):
        return None
    return Arrivals(
        requests_per_s=requests_per_s,
        table=tuple(found.tolist()),
        error=errors.get(rules.statistic, ERROR.most),
    )


def one_by_one(requests: Requests) -> bool:
    """Return whether requests followed one another: no two were open at once."""
    return math.fsum(one.open_s for one in requests.spans) <= (1 + AT_ONCE) * requests.open_s


def at_rate(requests: Requests, requests_per_s: float, between_s: float = 0.0) -> Requests:
    """Return the requests as if one had come each period; as they are where several were open at once."""
    if not requests.spans or not one_by_one(requests):
        return requests
    times_s = np.array([one.open_s for one in requests.spans])
    latencies_s = (times_s + waits_s(times_s, between_s, 1 / requests_per_s)).tolist()
    spans = [one._replace(open_s=own) for one, own in zip(requests.spans, latencies_s, strict=True)]
    return replace(
        requests,
        latencies_s=[one.open_s for one in spans if one.valid],
        scenarios=[one.scenario for one in spans if one.valid],
        waits_s=[(one.open_s, one.scenario) for one in spans if one.waited],
        spans=spans,
    )


def _sent_per_s(requests: Requests) -> float:
    starts_s = [one.start_s for one in requests.spans if one.start_s is not None]
    wide_s = max(starts_s, default=0.0) - min(starts_s, default=0.0)
    return (len(starts_s) - 1) / wide_s if wide_s > 0 else math.inf
