"""The cost of one request on a machine, and the latency that a limit on the cost allows.

Busy billing pays the time in which at least one request is open at the exact price (FogROS2-Config, section 2.D, where
requests follow one another and none fails); provisioned billing shares
the time that the machine is up among its requests: always, or in sessions with a start-up each. Data transfer is added to
both. On a spot machine interruptions come at random (Poisson) and a request that is interrupted starts over on another
machine after a restart, so that a request of L seconds takes (1/rate + restart) * (exp(rate * L) - 1) paid seconds on average
(Daly, A higher order estimate of the optimum checkpoint interval for restart dumps, FGCS 22 (2006), without checkpoints); a
provisioned machine is paid while it restarts and serves nothing.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fogspec.language.schema import Spec

Floats = NDArray[np.float64]
Rows = NDArray[np.intp]


@dataclass(frozen=True, kw_only=True)
class Costs:
    """The cost model of n machines: price in USD per hour (n,), and the mask of spot machines (n,).

    `beside_usd_per_hour`, (n,) or (1,) for all, is what is paid beside that price, for disk and address.
    `requests_per_s` is None for busy billing. A provisioned machine is paid for `up` of all time, and serves requests for
    `used` of it.

    `busy_ratio`, (n,) or (1,) for all, is the time in which at least one request was open, for each that succeeded, over the
    latency that is bounded: 1 where that is the mean of requests that follow one another.
    """

    price_usd_per_hour: Floats
    spot: NDArray[np.bool_]
    interruptions_per_s: float
    restart_s: float
    transfer_usd: float
    requests_per_s: float | None
    up: float = 1.0
    used: float = 1.0
    busy_ratio: Floats = field(default_factory=lambda: np.ones(1))
    beside_usd_per_hour: Floats = field(default_factory=lambda: np.zeros(1))

    @classmethod
    def of(
        cls,
        spec: Spec,
        price_usd_per_hour: Floats,
        spot: NDArray[np.bool_],
        busy_ratio: Floats | None = None,
        beside_usd_per_hour: Floats | None = None,
    ) -> "Costs":
        """Return the cost model of a spec for machines with these prices."""
        load = spec.objective.load
        return cls(
            price_usd_per_hour=price_usd_per_hour,
            spot=spot,
            interruptions_per_s=spec.hardware.interruptions_per_s,
            restart_s=spec.hardware.startup,
            transfer_usd=spec.objective.transfer,
            requests_per_s=load.rate if load else None,
            up=spec.up,
            used=load.used if load else 1.0,
            busy_ratio=np.ones(1) if busy_ratio is None else busy_ratio,
            beside_usd_per_hour=np.zeros(1) if beside_usd_per_hour is None else beside_usd_per_hour,
        )

    @classmethod
    def busy(cls, price_usd_per_hour: Floats) -> "Costs":
        """Return busy billing on on-demand machines, without data transfer."""
        spot = np.zeros(len(price_usd_per_hour), dtype=bool)
        return cls(
            price_usd_per_hour=price_usd_per_hour,
            spot=spot,
            interruptions_per_s=0.0,
            restart_s=0.0,
            transfer_usd=0.0,
            requests_per_s=None,
        )

    def take(self, rows: Rows) -> "Costs":
        """Return the cost model of some of the machines."""
        ratio = self.busy_ratio if len(self.busy_ratio) == 1 else self.busy_ratio[rows]
        beside = self.beside_usd_per_hour if len(self.beside_usd_per_hour) == 1 else self.beside_usd_per_hour[rows]
        price = self.price_usd_per_hour[rows]
        return replace(
            self, price_usd_per_hour=price, spot=self.spot[rows], busy_ratio=ratio, beside_usd_per_hour=beside
        )

    @property
    def typical_busy_ratio(self) -> float:
        """The middle one of the busy ratios, for machines between those on offer."""
        return float(np.sort(self.busy_ratio)[len(self.busy_ratio) // 2])

    @property
    def typical_beside_usd_per_hour(self) -> float:
        """The middle one of what is paid beside the prices, for machines between those on offer."""
        return float(np.sort(self.beside_usd_per_hour)[len(self.beside_usd_per_hour) // 2])

    @cached_property
    def usd_per_s(self) -> Floats:
        """Return the cost of a second of use (n,), restarts and start-ups included: exact but for long requests on spot."""
        extra = np.where(self.spot, self.interruptions_per_s * self.restart_s, 0.0)
        usd_per_hour = self.price_usd_per_hour + self.beside_usd_per_hour
        return np.asarray(usd_per_hour / 3600 * (1 + extra) * (self.up / self.used))

    def per_request(self, latency_s: Floats) -> Floats:
        """Return USD per successful request (n,) at this bounded latency; NaN where the latency is NaN."""
        if self.requests_per_s:
            return self.usd_per_s / self.requests_per_s + self.transfer_usd + 0 * latency_s
        return self.usd_per_s * self._paid(latency_s * self.busy_ratio) + self.transfer_usd

    def latency_within(self, usd_per_request: float) -> Floats:
        """Return the largest bounded latency (n,) whose request costs at most so much; 0 if there is none."""
        left = usd_per_request - self.transfer_usd
        if self.requests_per_s:
            return np.where(self.usd_per_s / self.requests_per_s <= left, np.inf, 0.0)
        free: Floats = np.full(len(self.usd_per_s), np.inf if left >= 0 else 0.0)
        seconds: Floats = np.divide(max(left, 0.0), self.usd_per_s, out=free, where=self.usd_per_s > 0)
        rate = self.interruptions_per_s
        if rate and self.spot.any():
            seconds = np.where(self.spot, np.log1p(rate * seconds) / rate, seconds)
        return seconds / self.busy_ratio

    def _paid(self, busy_s: Floats) -> Floats:
        """Return the paid seconds of a request, without restarts."""
        rate = self.interruptions_per_s
        if not rate or not self.spot.any():
            return busy_s
        with np.errstate(over="ignore"):
            return np.where(self.spot, np.expm1(rate * busy_s) / rate, busy_s)
