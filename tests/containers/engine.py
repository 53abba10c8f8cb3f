"""A container as SkyPilot starts one on a machine, by podman, in namespaces of the test; the commands are SkyPilot's.

Source: sky.provision.docker_utils, 0.14: the container runs a shell, and everything after that is run in it from outside.
"""

import os
import resource
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.tools.aws import images

# crun refuses cgroups of version 1 with some of version 2 beside them, as some hosts have. Only the holder's mounts change.
HOLDER = """\
mount --make-rprivate / && { umount /sys/fs/cgroup/unified 2>/dev/null; :; } && ip link set lo up multicast on &&
ip route add 224.0.0.0/4 dev lo && echo up && exec sleep infinity
"""
RUN = (
    "run", "-d", "-it", "-e", "LC_ALL=C.UTF-8", "-e", "LANG=C.UTF-8", "--shm-size=1073741824.5b", "--net=host",
    "--cap-add=SYS_ADMIN", "--cap-add=SYS_RESOURCE", "--device=/dev/fuse", "--security-opt=apparmor:unconfined",
    "--entrypoint=/bin/bash",
)  # fmt: skip
NAME = "sky_container"


def missing() -> str | None:
    """What stands in the way here, and the one command that helps; None where nothing does."""
    if os.geteuid() != 0:
        return "needs root, for containers: sudo .venv/bin/python -m pytest tests/containers"
    if absent := [name for name in ("podman", "crun", "ip") if shutil.which(name) is None]:
        return f"needs {', '.join(absent)}: apt-get install --no-install-recommends podman crun iproute2"
    if not images.ROOT.exists():
        return "needs the root of an image: make image-root"
    return None


@dataclass
class Podman:
    """Podman with its images in `folder` and its state in `run`, in the mounts and network of the process `holder`."""

    folder: Path
    run: Path
    holder: int

    def __call__(self, *words: str, code: int | None = 0, text: str | None = None) -> str:
        """Run podman; return what it and its container print."""
        within = ["nsenter", "--target", str(self.holder), "--mount", "--net", "--pid", "podman"]
        where = ["--root", f"{self.folder}/stored", "--runroot", str(self.run)]
        argv = [*within, *where, "--cgroup-manager", "cgroupfs", "--runtime", "crun", *words]
        ended = subprocess.run(argv, input=text, capture_output=True, text=True, timeout=600)
        assert code is None or ended.returncode == code, f"{words}: {ended.returncode}\n{ended.stdout}\n{ended.stderr}"
        return ended.stdout

    @contextmanager
    def running(self, image: str, *options: str) -> Iterator[None]:
        """A container of the image, as SkyPilot starts it; `options` come before its own."""
        files, processes = (resource.getrlimit(one)[1] for one in (resource.RLIMIT_NOFILE, resource.RLIMIT_NPROC))
        limits = [f"--ulimit=nofile={files}:{files}"] if files != resource.RLIM_INFINITY else []
        processes = min(32768, processes) if processes != resource.RLIM_INFINITY else 32768
        self(RUN[0], *limits, f"--ulimit=nproc={processes}:{processes}", *options, *RUN[1:], "--name", NAME, image)
        try:
            yield
        finally:
            self("rm", "-f", "-t", "0", NAME)

    def inside(self, script: str, *options: str, code: int | None = 0) -> str:
        """Run a script in the container as its user; return what it prints."""
        return self("exec", *options, NAME, "/bin/bash", "-c", script, code=code)


@contextmanager
def podman(folder: Path) -> Iterator[Podman]:
    """Podman, until the end; whatever it started ends with its namespaces."""
    words = ["unshare", "--mount", "--net", "--pid", "--fork", "--kill-child", "--mount-proc", "sh", "-c", HOLDER]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as outer:
        assert outer.stdout is not None
        try:
            assert outer.stdout.readline() == "up\n"
            holder = int(Path(f"/proc/{outer.pid}/task/{outer.pid}/children").read_text().split()[0])
            with tempfile.TemporaryDirectory(prefix="pod") as run:  # podman takes no more than 50 characters
                yield Podman(folder, Path(run), holder)
        finally:
            outer.kill()
