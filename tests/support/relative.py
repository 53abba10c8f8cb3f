"""How much work something is, whatever the speed and the load of the host that does it."""

import time
from collections.abc import Callable

LOOPS = 100_000


def work_of(call: Callable[[], object], runs: int) -> float:
    """Return the least CPU time of some calls, in units of that of a plain Python loop run in between.

    The loop takes 4 ms on a machine of 2024.
    """
    calls_s, loops_s = [], []
    for _ in range(runs):
        loops_s.append(_cpu_s(_loop))
        calls_s.append(_cpu_s(call))
    return min(calls_s) / min(loops_s)


def _cpu_s(call: Callable[[], object]) -> float:
    start_s = time.process_time()
    call()
    return time.process_time() - start_s


def _loop() -> int:
    return sum(number * number for number in range(LOOPS))
