"""`python -m tests.tools.aws [COMMAND...]`, as root: a command, or a shell, beside an AWS account with a SkyPilot.

Both are in namespaces of their own, end with the command, and leave nothing.
"""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

from tests.tools import apart, network
from tests.tools.aws import cloud, engine, shapes
from tests.tools.slurm import nodes

PROGRAMS = ("sshd", "ssh", "rsync", "sudo", "patch", "useradd", "unshare", "nsenter", "ip", "curl")
PACKAGES = "openssh-server openssh-client rsync sudo patch curl iproute2"
UV = "/home/ubuntu/sky-user-env/bin/uv-real"


def missing() -> str | None:
    """What stands in the way here, and the one command that helps; None where nothing does."""
    path = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])
    if os.geteuid() != 0:
        return "needs root, for namespaces and machines in them: sudo make aws-test"
    if absent := [name for name in PROGRAMS if shutil.which(name, path=path) is None]:
        return f"needs {', '.join(absent)}: apt-get install --no-install-recommends {PACKAGES}; then: make aws-test"
    if not (cloud.IMAGE / "bin" / "ray").exists():
        return "needs what SkyPilot installs on a machine, for /usr/bin/python3.11: make aws-env"
    return None


def up(folder: Path) -> None:
    """The machines' image, the network, the API."""
    for name in ("disks", "log"):
        (folder / name).mkdir()
    uv = Path(sysconfig.get_path("scripts")) / "uv"
    nodes.environment(folder / "user", None, uv)
    shutil.copy(uv, folder / "user" / "bin" / "uv-real")
    nodes.script(folder / "uv", nodes.UV.format(python=nodes.PYTHON, folder="/tmp", uv=UV))
    (folder / "images.json").write_text(json.dumps(shapes.images()))
    engine.configure(folder)
    network.start()
    with open(folder / "log" / "cloud.log", "wb") as log:
        words = [sys.executable, "-m", "tests.tools.aws.cloud", str(folder)]
        subprocess.Popen(
            words, stdout=log, stderr=log, env=os.environ | {"MOTO_AMIS_PATH": str(folder / "images.json")}
        )
    cloud.until(answers, 180.0)  # however busy this machine is
    engine.furnish()


def answers() -> bool:
    """Whether the API does."""
    try:
        engine.ask("/_machines")
    except OSError:
        return False
    return True


def shell(folder: Path) -> str:
    """Set the environment of a shell beside the account; return what to say first."""
    os.environ.update(engine.environment(folder))
    return "# aws, sky and fogspec are this account's here; everything ends with this shell"


if __name__ == "__main__":
    sys.exit(apart.main("tests.tools.aws", sys.argv[1:], missing() if os.getpid() != 1 else None, up, shell))
