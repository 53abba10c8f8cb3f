"""Private network namespaces for ROS 2 on this host, and processes that end when they are told to.

Fast DDS binds sockets beyond loopback whatever it is told, so every test has a network of its own: loopback with
multicast, nothing else, and its own ROS_DOMAIN_ID.
"""

import contextlib
import ctypes
import functools
import itertools
import os
import signal
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import ParamSpec

ROOT = Path(__file__).resolve().parents[2]
PYTHON = ROOT / ".venv-ros" / "bin" / "python"
# The wheels' start-up hook sets these for its own children; another environment's Python must not see them.
LEAKED = ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH", "AMENT_PREFIX_PATH", "PYTHONPATH", "LD_PRELOAD")
ATTEMPTS = 12
P = ParamSpec("P")
UP = "ip link set lo up multicast on && ip route add 224.0.0.0/4 dev lo && echo up && exec sleep infinity"
_domains = itertools.count(10 + os.getpid() % 80)


def environment(domain: int, **extra: str) -> dict[str, str]:
    """What ROS 2 processes of one test see."""
    kept = {key: value for key, value in os.environ.items() if key not in LEAKED and not key.startswith("FOGSPEC_")}
    path = os.pathsep.join([str(PYTHON.parent), os.environ.get("PATH", os.defpath)])
    return {**kept, "PATH": path, "ROS_DOMAIN_ID": str(domain), **extra}


class Process:
    """A running process; `stop` sends INT, then TERM, then KILL to its group, and waits in between."""

    def __init__(self, argv: Sequence[str], env: Mapping[str, str], log: Path, cwd: Path | None = None) -> None:
        self.log = log
        with open(log, "ab") as file:
            self.popen = subprocess.Popen(argv, env=dict(env), stdin=subprocess.DEVNULL, stdout=file, cwd=cwd,
                                          stderr=subprocess.STDOUT, start_new_session=True)  # fmt: skip

    def stop(self) -> int:
        """End it and all of its group; returns the exit code."""
        for number, patience_s in ((signal.SIGINT, 3.0), (signal.SIGTERM, 2.0), (signal.SIGKILL, 5.0)):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.popen.pid, number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.popen.wait(patience_s)
                break
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.popen.pid, signal.SIGKILL)
        return self.popen.wait(600)

    def said(self) -> str:
        """What it has written so far."""
        return self.log.read_text("utf-8", "replace")


class Net:
    """One network namespace and one ROS domain; processes started in it end with it."""

    def __init__(self, folder: Path, own_memory: bool = False) -> None:
        """`own_memory`: shared memory of its own too, as another computer has, or middlewares would use it as a way."""
        self.folder, self.domain = folder, next(_domains) % 100
        self._own = ["--mount"] if own_memory else []
        mounted = "mount -t tmpfs none /dev/shm && " if own_memory else ""
        self._processes: list[Process] = []
        self._holder = subprocess.Popen(
            [*unshare(), *self._own, "sh", "-c", mounted + UP], stdout=subprocess.PIPE, stdin=subprocess.DEVNULL
        )
        assert self._holder.stdout is not None
        if self._holder.stdout.readline() != b"up\n":
            raise RuntimeError("the network namespace does not come up")

    @property
    def holder(self) -> str:
        """The process that holds the namespace: its number, as `ip` wants it."""
        return str(self._holder.pid)

    def command(self, argv: Sequence[str]) -> list[str]:
        """The argv that runs inside."""
        user = [] if os.geteuid() == 0 else ["--user", "--preserve-credentials"]
        return ["nsenter", "--target", str(self._holder.pid), *user, *self._own, "--net", "--", *argv]

    def enter(self) -> None:
        """Take this process inside, as `command` takes a program; it must have one thread. Raise OSError if it cannot."""
        names = [*([] if os.geteuid() == 0 else ["user"]), *(["mnt"] if self._own else []), "net"]
        # All of them before the first: what may be opened depends on the namespaces that one is in.
        files = [os.open(f"/proc/{self._holder.pid}/ns/{name}", os.O_RDONLY) for name in names]
        for name, file in zip(names, files, strict=True):
            if ctypes.CDLL(None, use_errno=True).setns(file, 0):
                raise OSError(ctypes.get_errno(), f"no way into the {name} namespace")
            os.close(file)

    def environment(self, **extra: str) -> dict[str, str]:
        """What processes inside see."""
        return environment(self.domain, **{"ROS_LOG_DIR": str(self.folder / "ros-log"), **extra})

    def start(self, name: str, argv: Sequence[str], **extra: str) -> Process:
        """Start a process inside; `extra` are environment variables."""
        log = self.folder / f"{name}.log"
        process = Process(self.command(argv), self.environment(**extra), log, self.folder)
        self._processes.append(process)
        return process

    def python(self, name: str, *words: str, **extra: str) -> Process:
        """Start ROS 2's Python inside."""
        return self.start(name, [str(PYTHON), *words], **extra)

    def run(self, argv: Sequence[str], timeout_s: float, **extra: str) -> subprocess.CompletedProcess[str]:
        """Run to its end inside; it is killed after `timeout_s`, which fails the test."""
        return subprocess.run(self.command(argv), env=self.environment(**extra), timeout=timeout_s, text=True,
                              capture_output=True, stdin=subprocess.DEVNULL, cwd=self.folder)  # fmt: skip

    def close(self) -> None:
        """End everything inside."""
        for process in reversed(self._processes):
            process.stop()
        self._holder.kill()
        self._holder.wait(600)


def unshare() -> list[str]:
    """The words that give a command a network of its own, for root and for everybody else."""
    return ["unshare", "--net"] if os.geteuid() == 0 else ["unshare", "--map-root-user", "--net"]


@contextlib.contextmanager
def network(folder: Path) -> Iterator[Net]:
    """A namespace for the length of a block."""
    net = Net(folder)
    try:
        yield net
    finally:
        net.close()


def undisturbed(test: Callable[P, None]) -> Callable[P, None]:
    """A test that compares times with the truth: made again, each in a network of its own, where it fails.

    What else the computer does spoils some of its attempts, and a defect spoils all.
    """

    @functools.wraps(test)
    def attempts(*words: P.args, **given: P.kwargs) -> None:
        net = given["net"]
        assert isinstance(net, Net)
        for number in range(ATTEMPTS):
            folder = net.folder / f"attempt{number}"
            folder.mkdir()
            with network(folder) as again:
                try:
                    test(*words, **{**given, "net": again})
                    return
                except AssertionError:
                    if number == ATTEMPTS - 1:
                        raise

    return attempts


def lacking() -> str | None:
    """Why these tests cannot run here, with the command that helps; None when they can."""
    if not PYTHON.is_file():
        return "needs real ROS 2: make ros-env"
    try:
        subprocess.run([*unshare(), "ip", "link", "set", "lo", "up"], check=True, capture_output=True, timeout=600)
    except (OSError, subprocess.SubprocessError):
        return "needs network namespaces: run as root, or sysctl -w kernel.unprivileged_userns_clone=1"
    return None
