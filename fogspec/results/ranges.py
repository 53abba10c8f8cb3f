"""Ranges of the figures that come from a machine.

A figure outside of its range fails its sample where it arrives (`fogspec.bench.record`), and no results file may have one
(`fogspec.results.schema`). Within these ranges all that is computed from them is finite.
"""

from typing import Annotated

from pydantic import AfterValidator, Field

from fogspec.base.quantities import Bounds, Duration, Memory, Money

REQUEST_S = Bounds(0.0, 1e6, "s")  # latency or service time of a request, and each statistic of them
LATENCY_S = Bounds(1e-9, 1e6, "s")  # that can be modelled: no clock resolves a shorter one
TIME_S = Bounds(0.0, 1e9, "s")  # set-up, measuring, waiting
CLOCK_S = Bounds(-1e12, 1e12, "s")  # a moment, by any clock
COUNT = Bounds(0, 10**9)
METRIC = Bounds(-1e12, 1e12)
MEMORY_GIB = Bounds(0.0, 1e9, " GiB")
VCPUS = Bounds(0.0, 1e5)
ERROR = Bounds(0.0, 10.0)  # relative: beyond it a sample says nothing, whatever more it could
MONEY_USD = Bounds(0.0, 1e9, " USD")
TEXT_LIMIT = 2000
SIZE_LIMIT = 256 * 2**20  # bytes of the raw timings of a sample

RequestTime = Annotated[Duration, AfterValidator(REQUEST_S.check)]
Time = Annotated[Duration, AfterValidator(TIME_S.check)]
Amount = Annotated[Money, AfterValidator(MONEY_USD.check)]
MetricValue = Annotated[float, AfterValidator(METRIC.check)]
MemoryUse = Annotated[Memory, AfterValidator(MEMORY_GIB.check)]
RelativeError = Annotated[float, AfterValidator(ERROR.check)]
Vcpus = Annotated[float, AfterValidator(VCPUS.check)]
Counted = Annotated[int, Field(ge=0, le=10**9)]
Text = Annotated[str, Field(max_length=TEXT_LIMIT)]
