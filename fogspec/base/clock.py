"""A monotonic clock, whose seconds never jump and are comparable between processes of one boot, and the wall clock."""

import time
from pathlib import Path
from typing import Protocol


class Clock(Protocol):
    """A monotonic clock; two readings may be subtracted if and only if their `boot` is the same."""

    def now_s(self) -> float:
        """Seconds since some moment of this boot."""
        ...

    def boot(self) -> str:
        """Names the boot of this machine."""
        ...

    def unix_s(self) -> float:
        """Seconds since 1970 by the wall clock, which survives a restart and may be wrong or changed."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait."""
        ...


class SystemClock:
    """The kernel's clock since boot: time asleep counts, changes of the wall clock do not."""

    def __init__(self) -> None:
        self._boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()

    def now_s(self) -> float:
        """Seconds since this machine was started."""
        return time.clock_gettime(time.CLOCK_BOOTTIME)

    def boot(self) -> str:
        """Return the kernel's identifier of this boot."""
        return self._boot

    def unix_s(self) -> float:
        """Return the reading of the wall clock."""
        return time.time()

    def sleep(self, seconds: float) -> None:
        """Wait; a signal's handler runs at once, the wait continues after it."""
        time.sleep(seconds)
