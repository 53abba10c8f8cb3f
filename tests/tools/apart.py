"""Namespaces for one command and all that it starts: network, mounts and processes; nothing of it outlives the command.

Users, host names and memory cgroups are the command's own too. What it changes in /etc is kept in memory, and /opt/ros is
the ROS 2 of `make ros-env`.
"""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from tests.tools.slurm import nodes, ros

UNSHARE = ("unshare", "--net", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc")
FOLDER = "FOGSPEC_APART"
# Short, as sockets' names must be; after it comes the process that the namespaces end with.
STATE = Path(tempfile.gettempdir(), "fog-lab-")
OPT = Path("/opt")
SHARES = "16384"  # of CPU time; else a group has no more than one process by itself, however many are in it
CPU = Path("/sys/fs/cgroup/cpu")
CGROUPS = (CPU.with_name("memory"), CPU.with_name("freezer"), CPU)


def enter(module: str, words: Sequence[str]) -> None:
    """Become `python -m module words` in namespaces of its own, as their first process."""
    for name in {one.name for place in (STATE.parent, *CGROUPS) for one in place.glob(f"{STATE.name}*")}:
        if not Path("/proc", name.removeprefix(STATE.name)).exists():
            _forget(STATE.with_name(name))
    os.environ[FOLDER] = f"{STATE}{os.getpid()}"
    os.execvp(UNSHARE[0], [*UNSHARE, sys.executable, "-m", module, *words])


def main(
    module: str,
    words: Sequence[str],
    why: str | None,
    up: Callable[[Path], None],
    shell: Callable[[Path], str],
) -> int:
    """The command line of `python -m module`, outside and then inside.

    Where there can be no namespaces, for the reason `why`, a command runs without them. `up` starts what the command is beside;
    `shell` sets the environment of a shell and returns what to say first.
    """
    if os.getpid() != 1:
        if why:
            if not words:
                raise SystemExit(why)
            os.execvp(words[0], list(words))
        enter(module, words)
    os.environ["PATH"] += ":/usr/sbin:/sbin"
    # A first process that does not say what it does on TERM is never ended by it.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    with furnished() as folder:
        up(folder)
        if not words:
            print(shell(folder))
        return run(words or [os.environ.get("SHELL", "bash")])


def _forget(folder: Path) -> None:
    """What is left when the first process was killed."""
    for group in _groups(folder):
        _remove(group)
    shutil.rmtree(folder, ignore_errors=True)


def _groups(folder: Path) -> list[Path]:
    return [one / folder.name for one in CGROUPS]


@contextlib.contextmanager
def furnished() -> Iterator[Path]:
    """Inside: what the namespaces are given, and a folder for all state."""
    folder = Path(os.environ[FOLDER])
    folder.mkdir(mode=0o755)
    groups = [one for one in _groups(folder) if os.access(one.parent / "cgroup.procs", os.W_OK)]
    try:
        _run("ip", "link", "set", "lo", "up")
        _own_etc()
        if ros.prepare(folder / "opt", nodes.PYTHON):
            _run("mount", "-t", "overlay", "overlay", "-o", f"lowerdir={folder}/opt:{OPT}", str(OPT))
            _run("mount", "--bind", f"{folder}/opt/ros", f"{OPT}/ros")
        for group in groups:
            group.mkdir()
            if group.parent == CPU:
                (group / "cpu.shares").write_text(SHARES)
                _enter(group)
        with _bound(groups):
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _own_etc() -> None:
    """Users and host names of our own; a host's /etc/hosts may be a mount of its own, which an overlay does not show."""
    hosts = Path("/etc/hosts").read_text()
    scratch = Path(tempfile.mkdtemp(prefix="fog-etc-"))
    _run("mount", "-t", "tmpfs", "none", str(scratch))
    for name in ("upper", "work"):
        (scratch / name).mkdir()
    _run("mount", "-t", "overlay", "overlay", "-o", f"lowerdir=/etc,upperdir={scratch}/upper,workdir={scratch}/work",
         "/etc")  # fmt: skip
    _run("umount", "--lazy", str(scratch))
    scratch.rmdir()
    Path("/etc/hosts").write_text(hosts)


@contextlib.contextmanager
def _bound(groups: Sequence[Path]) -> Iterator[None]:
    """These cgroups in the place of their hierarchies' roots, so that two clusters have nothing in common."""
    for group in groups:
        _run("mount", "--bind", str(group), str(group.parent))
    try:
        yield
    finally:
        _end_all()
        for group in groups:
            _run("umount", "--lazy", str(group.parent))
            if group.parent == CPU:
                _enter(CPU)
            _remove(group)


def _enter(group: Path) -> None:
    """Put this process, and what it starts from now on, into a cgroup."""
    (group / "cgroup.procs").write_text("0")


def _remove(group: Path) -> None:
    for path, _, _ in os.walk(group, topdown=False):
        with contextlib.suppress(OSError):
            os.rmdir(path)


def _end_all() -> None:
    """Every process here but this one, which is the first."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(-1, signal.SIGKILL)
    with contextlib.suppress(ChildProcessError):
        while True:
            os.wait()


def run(words: Sequence[str]) -> int:
    """A command as a child of the first process, which also takes leave of those whose parents are gone; its exit code."""
    # Ctrl-C is the command's to answer.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Kept, for one that is forgotten takes leave of its process by itself.
    child = subprocess.Popen(words, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    while True:
        ended, status = os.wait()
        if ended == child.pid:
            return os.waitstatus_to_exitcode(status)


def _run(*words: str) -> None:
    subprocess.run(words, check=True)
