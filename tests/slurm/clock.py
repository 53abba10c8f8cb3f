"""A host's clock that can be set, for the processes that are started with it: nobody else's date changes."""

import os
import struct
import subprocess
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Clock:
    """A folder with what is preloaded, and the file that says by how many seconds the date is off."""

    folder: Path

    @classmethod
    def made(cls, folder: Path) -> "Clock":
        """Compile it; the date is right at first."""
        clock = cls(folder)
        subprocess.run(["cc", "-O2", "-Wall", "-Werror", "-shared", "-fPIC", "-o", clock.library,
                        Path(__file__).with_suffix(".c")], check=True)  # fmt: skip
        clock.set(0)
        return clock

    @property
    def library(self) -> Path:
        return self.folder / "clock.so"

    @property
    def environment(self) -> dict[str, str]:
        """What a process must be started with."""
        return {"LD_PRELOAD": str(self.library), "FOGSPEC_TEST_CLOCK": str(self.folder / "clock")}

    def set(self, off_s: int) -> None:
        """The date is off by so many seconds from now on, also for who reads it already."""
        handle = os.open(self.folder / "clock", os.O_RDWR | os.O_CREAT, 0o644)
        os.pwrite(handle, struct.pack("=q", off_s), 0)
        os.close(handle)
