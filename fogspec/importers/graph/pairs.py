"""Which of a node's outputs answers which of its inputs: by header stamps, by counts, and by cause.

A header stamp that comes back is proof. Without one, an output is an answer if its intervals follow those of the input: what
makes a request late makes its response late. A timer of the same rate, even at a fixed distance, has delays of its own. The
measure is Spearman's rank correlation of successive intervals, at the distance (in requests) where it is largest.
"""

import bisect
import itertools
import math
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from fogspec.agent.matching import Matcher
from fogspec.importers.graph.observed import Observed, Timed, Topic, heard

FEWEST = 8  # messages of each topic
MOST_CANDIDATES = 4000
SAME_STAMP = 0.2  # share of the responses whose stamp a request had: large requests may not reach the watcher
FORWARD = 0.98  # share of the responses that came after the request of their stamp
FARTHEST = 6  # requests that may wait for their response, where no stamp tells
ALIKE = 0.3  # least rank correlation of intervals
SIGMAS = 4.0
FEWEST_ANSWERED = 0.5  # share of the requests that have a response, where no stamp tells
EACH = (0.97, 1.03)  # responses per request if each request has one
NOISY = 10.0  # times the requests' jitter: too much for intervals to be alike
UNEVEN = 0.02  # of the period: a timer is more even
SHORTEST_S = 2e-5  # a message that another process answers takes longer
MS = 1e-3
NS = 1e-9


@dataclass(frozen=True, kw_only=True)
class Pair(Timed):
    """A request and its response at one node; `match` is None if nothing in the messages tells which belongs to which.

    `latencies_s` are those that the probe would read.
    """

    node: str
    request: str
    response: str
    match: str | None
    how: str
    requests: int
    answered: int
    rate: float
    request_bytes: float
    response_bytes: float

    def evidence(self) -> str:
        """Return what speaks for it, as a line of text."""
        counted = f"{self.answered} of {self.requests} {self.how}"
        return f"{self.request} -> {self.response}: {counted}, p50 {_ms(self.p50_s)}, p95 {_ms(self.p95_s)}"


def _ms(seconds: float) -> str:
    return f"{seconds / MS:.3g} ms"


@dataclass(frozen=True)
class _Fit:
    """How well an input explains an output: distances of each response to its request, and which request it is."""

    request: str
    how: str
    match: str | None
    share: float
    answers: tuple[tuple[int, int], ...]  # (index of the request, index of the response)
    delay_s: float


def find_pairs(seen: Observed) -> list[Pair]:
    """Return at most one request for each output of each node, those that take most time first."""
    times = {name: _Series.of(topic) for name, topic in seen.topics.items() if _regular(topic)}
    found, left = [], MOST_CANDIDATES
    work = []
    for node in sorted(seen.nodes):
        inputs = [name for name in times if node in seen.topics[name].subscribers]
        outputs = [name for name in times if node in seen.topics[name].publishers]
        work.append((len(inputs) * len(outputs), node, inputs, outputs))
    # A recorder or a bridge hears everything: it comes last.
    for _, node, inputs, outputs in sorted(work):
        for response in outputs:
            others = [name for name in inputs if name != response and seen.topics[name].publishers != [node]][:left]
            left -= len(others)
            fits = [fit for name in others for fit in _fits(name, times[name], times[response])]
            best = _best(fits, times)
            if best is not None:
                found.append(_pair(node, response, best, times))
    return sorted(found, key=lambda one: (-one.p50_s * one.rate, one.request, one.response))


def _regular(topic: Topic) -> bool:
    return topic.watched and not topic.latched and not topic.dropped and len(topic.messages) >= FEWEST


@dataclass(frozen=True)
class _Series:
    """A topic's messages: times sent (s since its first was sent, exact to 100 ns), stamps and sizes."""

    at_s: tuple[float, ...]
    stamps: tuple[int | None, ...]
    bytes: float
    stamped: bool
    rate: float

    @staticmethod
    def of(topic: Topic) -> "_Series":
        messages = heard(topic)
        stamps = tuple(stamp for _, stamp, _ in messages)
        told = [stamp for stamp in stamps if stamp]
        stamped = bool(topic.has_header) and len(set(told)) >= 0.9 * len(messages)
        at_s = tuple(at * NS for at, _, _ in messages)
        rate = (len(at_s) - 1) / max(at_s[-1] - at_s[0], 1e-9) * topic.sent_per_heard
        return _Series(at_s, stamps, topic.bytes / max(topic.count, 1), stamped, rate)


def _fits(name: str, requests: _Series, responses: _Series) -> Iterator[_Fit]:
    stamped = _by_stamp(name, requests, responses) if requests.stamped and responses.stamped else None
    fit = stamped or _by_cause(name, requests, responses)
    if fit is not None:
        yield fit


def _by_stamp(name: str, requests: _Series, responses: _Series) -> _Fit | None:
    sent = {stamp: i for i, stamp in enumerate(requests.stamps) if stamp}
    # Responses to requests from before the watch are not counted.
    first = min(sent)
    asked = [j for j, stamp in enumerate(responses.stamps) if stamp is not None and stamp >= first]
    answers = [(sent[stamp], j) for j in asked if (stamp := responses.stamps[j]) in sent]
    if len(answers) < FEWEST or len(answers) < SAME_STAMP * len(asked):
        return None
    delays = [responses.at_s[j] - requests.at_s[i] for i, j in answers]
    if sum(one > 0 for one in delays) < FORWARD * len(delays):
        return None
    return _Fit(name, "by stamp", "stamp", len(answers) / len(asked), tuple(answers), statistics.median(delays))


def _by_cause(name: str, requests: _Series, responses: _Series) -> _Fit | None:
    tried = [
        (_alike(requests, responses, answers), answers)
        for answers in _alignments(requests, responses)
        if len(answers) >= 0.9 * (len(responses.at_s) - answers[0][1])
    ]
    if not tried:
        return None
    # Of two that explain the intervals about as well, the shorter delay: it comes first.
    most = max(alike for alike, _ in tried)
    alike, answers = next(one for one in tried if one[0] > most - 0.05)
    if alike >= max(ALIKE, SIGMAS / math.sqrt(len(answers))):
        each = _each(requests, responses, answers)
        how = "in order" if each else "by cause"
        # Of a topic of a higher rate, some message always comes shortly before.
        if not each and len(answers) < FEWEST_ANSWERED * (answers[-1][0] - answers[0][0] + 1):
            return None
    else:
        alike, answers = tried[0]
        each = _each(requests, responses, answers)
        how = "in order, by count alone"
        if not each or not _too_noisy(requests, responses, answers):
            return None
    delays = [responses.at_s[j] - requests.at_s[i] for i, j in answers]
    return _Fit(name, how, "order" if each else None, max(alike, 0.0), tuple(answers), statistics.median(delays))


def _alignments(requests: _Series, responses: _Series) -> Iterator[list[tuple[int, int]]]:
    """Yield ways to give each response its request: so many requests before it, and one after the other."""
    last = [bisect.bisect_right(requests.at_s, at - SHORTEST_S) - 1 for at in responses.at_s]
    begun = next((j for j, i in enumerate(last) if i >= 0), len(last))
    for distance in range(FARTHEST + 1):
        answers = [(i - distance, j) for j, i in enumerate(last) if i >= distance]
        # A request has one response: of several, the first.
        answers = [next(group) for _, group in itertools.groupby(answers, key=lambda one: one[0])]
        if len(answers) >= FEWEST:
            yield answers
        if begun == len(last) or last[begun] < distance:
            continue
        # A queue: the n-th after the first, however many wait by then.
        first = last[begun] - distance
        queue = [(i, begun + k) for k, i in enumerate(range(first, len(requests.at_s))) if begun + k < len(last)]
        forward = sum(responses.at_s[j] > requests.at_s[i] for i, j in queue)
        if len(queue) >= FEWEST and forward >= FORWARD * len(queue):
            yield queue


def _each(requests: _Series, responses: _Series, answers: Sequence[tuple[int, int]]) -> bool:
    """Return whether each request has one response, but for those at either end of the watch."""
    asked, said = len(requests.at_s) - answers[0][0], len(responses.at_s) - answers[0][1]
    # The last requests may wait.
    waiting = 1 + sum(at > requests.at_s[answers[-1][0]] for at in requests.at_s)
    return EACH[0] <= (said + waiting) / asked and said / (asked + 1) <= EACH[1] and len(answers) >= 0.95 * said


def _intervals(
    requests: _Series, responses: _Series, answers: Sequence[tuple[int, int]]
) -> tuple[list[float], list[float]]:
    asked = [b - a for a, b in itertools.pairwise(requests.at_s[i] for i, _ in answers)]
    said = [b - a for a, b in itertools.pairwise(responses.at_s[j] for _, j in answers)]
    return asked, said


def _alike(requests: _Series, responses: _Series, answers: Sequence[tuple[int, int]]) -> float:
    """Return Spearman's rank correlation of the intervals, 0 if one of them never changes."""
    ranked = [_ranks(values) for values in _intervals(requests, responses, answers)]
    try:
        return statistics.correlation(*ranked)
    except statistics.StatisticsError:
        return 0.0


def _ranks(values: Sequence[float]) -> list[float]:
    order = sorted(range(len(values)), key=values.__getitem__)
    ranks = [0.0] * len(values)
    for rank, at in enumerate(order):
        ranks[at] = float(rank)
    return ranks


def _too_noisy(requests: _Series, responses: _Series, answers: Sequence[tuple[int, int]]) -> bool:
    """Return whether the responses are so uneven that neither intervals nor a timer can explain them."""
    asked, said = _intervals(requests, responses, answers)
    period = statistics.median(asked)
    jitter = [statistics.median(abs(one - statistics.median(values)) for one in values) for values in (asked, said)]
    return jitter[1] > NOISY * jitter[0] and jitter[1] > UNEVEN * period


def _best(fits: Sequence[_Fit], times: dict[str, _Series]) -> _Fit | None:
    """Return the input that starts the work: of those that explain the output about as well, the last to arrive.

    Of inputs that arrive together, such as an image and its camera's data, the largest.
    """
    timed = [fit for fit in fits if fit.match == "stamp"] or [fit for fit in fits if fit.match]
    stamped = timed or list(fits)
    if not stamped:
        return None
    most = max(fit.share for fit in stamped)
    good = [fit for fit in stamped if fit.share >= 0.8 * most]
    least_s = min(fit.delay_s for fit in good)
    together = [fit for fit in good if fit.delay_s <= max(1.1 * least_s, least_s + 2 * MS)]
    return max(together, key=lambda fit: (times[fit.request].bytes, fit.request))


def _pair(node: str, response: str, fit: _Fit, times: dict[str, _Series]) -> Pair:
    requests, responses = times[fit.request], times[response]
    latencies = [responses.at_s[j] - requests.at_s[i] for i, j in fit.answers]
    first, n = fit.answers[0], len(fit.answers)
    if fit.match is not None:
        latencies = _as_probe(fit.match, requests, responses, first) or latencies
    # The last requests may have had no time for a response.
    until_s = responses.at_s[-1] - statistics.median(latencies)
    asked = bisect.bisect_right(requests.at_s, until_s) - first[0]
    return Pair(
        node=node,
        request=fit.request,
        response=response,
        match=fit.match,
        how=fit.how,
        requests=max(asked, n),
        answered=n,
        latencies_s=tuple(latencies),
        rate=requests.rate,
        request_bytes=requests.bytes,
        response_bytes=responses.bytes,
    )


def _as_probe(match: str, requests: _Series, responses: _Series, first: tuple[int, int]) -> list[float]:
    """Return the latencies that the agent's own matcher reads in the same messages."""
    matcher = Matcher(match)
    events = [(at, 0, requests.stamps[i + first[0]]) for i, at in enumerate(requests.at_s[first[0] :])]
    events += [(at, 1, responses.stamps[j + first[1]]) for j, at in enumerate(responses.at_s[first[1] :])]
    found = []
    for at, is_response, stamp in sorted(events, key=lambda one: one[:2]):
        key = None if stamp is None else divmod(stamp, 10**9)
        if not is_response:
            matcher.take_request(key, at)
        elif (done := matcher.take_response(key, at)) is not None and done.latency_s is not None:
            found.append(done.latency_s)
    return found
