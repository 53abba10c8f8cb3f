"""How much longer requests take that come at a fixed rate than requests that are sent one after the other.

The node works on one request at a time, in the order in which they come: each waits by Lindley's recursion,
W' = max(0, W + S - T), for a service time S and a time T between arrivals (D. V. Lindley, The theory of queues with a single
server, 1952). The service times are those of a sample, in their order: which ones follow each other decides how long they wait.
"""

from dataclasses import dataclass, replace

import numpy as np

from fogspec.numerics.kernels import Floats, Ints, distinct, quantised

BUSY = np.linspace(0.0, 1.0, 101)  # fractions of all time in which the machine works
NEAR = 1.02  # so many times more or less


def table(service_s: Floats, between_s: float, shares: Floats, quantile: float | None) -> Floats:
    """Return the latency (G,) of n requests that come one a period, at each fraction `BUSY` of time in which the machine works.

    In units of the latency of the same requests one after the other at which it would work all the time. `service_s` (n,) are
    their times, in their order; after each one the machine works on for `between_s`. The latency is the mean by `shares` (n,),
    which sum to 1, or a `quantile` between 0 and 1.
    """
    whole_s = float(service_s.mean()) + between_s
    served = BUSY[:, None] * (service_s / whole_s)
    latency = served + _waits(served + BUSY[:, None] * (between_s / whole_s))
    alone = _statistic(served[-1:], shares, quantile)
    return quantised(_statistic(latency, shares, quantile) / alone)


def steepness(table: Floats, busy: float) -> float:
    """Return by how much more the latency at the rate changes than that of requests one after the other, as logarithms."""
    ends = np.array([busy / NEAR, min(busy * NEAR, 1.0)])
    low, high = np.log(np.interp(ends, BUSY, table))
    return float((high - low) / np.log(ends[1] / ends[0]))


def waits_s(service_s: Floats, between_s: float, period_s: float) -> Floats:
    """Return for how long each of n requests (n,) waits that come one a period, the first to an idle machine."""
    return np.asarray(_waits((service_s + between_s)[None, :] / period_s)[0] * period_s)


def _waits(periods: Floats) -> Floats:
    """Return how long requests (G, n) that occupy the machine for so many periods wait, in periods."""
    steps = np.cumsum(periods - 1, axis=1)
    sums = np.concatenate([np.zeros((len(periods), 1)), steps[:, :-1]], axis=1)
    return np.asarray(sums - np.minimum.accumulate(sums, axis=1))


def _statistic(values: Floats, shares: Floats, quantile: float | None) -> Floats:
    """Return the mean (G,) of values (G, n), or a quantile."""
    if quantile is None:
        return np.asarray((values * shares).sum(axis=1))
    return np.array([_quantile(row, shares, quantile) for row in values])


def _quantile(values: Floats, shares: Floats, quantile: float) -> float:
    """Return the value below which so much of the weight lies, linear between values as in `fogspec.agent.intervals`."""
    some = np.flatnonzero(shares > 0)
    order = some[np.argsort(values[some], kind="stable")]
    own = shares[order]
    upto = np.cumsum(own)
    target = quantile * (upto[-1] - own[-1])
    if len(order) == 1:
        return float(values[order[0]])
    at = min(int(np.searchsorted(upto, target)), len(order) - 2)
    low, high = values[order[at]], values[order[at + 1]]
    return float(low + (high - low) * (target - (upto[at] - own[at])) / own[at])


@dataclass(frozen=True, eq=False)
class Waiting:
    """The latency at a rate for that of requests one after the other, on N machines.

    `tables` (K, G) are latencies at the fractions of work `BUSY` (G,), and `of` (N,) says which one is a machine's, the first
    where it was not measured: both in units of `saturated_s` (N,), the latency of one after the other at which the machine
    would work all the time. Beyond, where they wait ever longer, it grows by the last factor.
    """

    tables: Floats
    of: Ints
    saturated_s: Floats

    def take(self, rows: np.ndarray) -> "Waiting":
        """Return those of the machines at these indices."""
        return replace(self, of=self.of[rows], saturated_s=self.saturated_s[rows])

    @property
    def typical(self) -> "Waiting":
        """That of a machine between the others, by the first table."""
        middle = np.sort(self.saturated_s)[len(self.saturated_s) // 2]
        return replace(self, of=np.array(0), saturated_s=np.asarray(middle))

    def at_rate(self, alone_s: Floats) -> Floats:
        """Return latencies (..., N) at the rate for those of one after the other."""
        return self._mapped(alone_s, alone=True)

    def alone(self, latency_s: Floats) -> Floats:
        """Return latencies (..., N) of one after the other for those at the rate."""
        return self._mapped(latency_s, alone=False)

    def _mapped(self, latency_s: Floats, *, alone: bool) -> Floats:
        units = np.asarray(latency_s / self.saturated_s)
        found, of = np.empty_like(units), np.broadcast_to(self.of, units.shape)
        for number in distinct(self.of).tolist():
            x, y = (BUSY, self.tables[number]) if alone else (self.tables[number], BUSY)
            own = units[of == number]
            found[of == number] = np.where(own <= x[-1], np.interp(own, x, y), own * (y[-1] / x[-1]))
        return quantised(found * self.saturated_s)
