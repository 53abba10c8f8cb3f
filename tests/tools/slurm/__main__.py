"""`python -m tests.tools.slurm [COMMAND...]`, as root: a command, or a shell, beside a Slurm cluster with a SkyPilot.

Both are in namespaces of their own, end with the command, and leave nothing.
"""

import os
import shutil
import sys
from pathlib import Path

from tests.tools import apart, network
from tests.tools.slurm import daemons, engine, login, nodes, shapes

PROGRAMS = ("slurmctld", "slurmd", "munged", "sshd", "ssh", "rsync", "useradd", "unshare", "nsenter", "ip")
PACKAGES = "slurm-wlm munge openssh-server openssh-client rsync iproute2"


def missing() -> str | None:
    """What stands in the way here, and the one command that helps; None where nothing does."""
    path = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])
    if os.geteuid() != 0:
        return "needs root, for namespaces and a cluster's daemons: sudo make slurm-test"
    if absent := [name for name in PROGRAMS if shutil.which(name, path=path) is None]:
        return f"needs {', '.join(absent)}: apt-get install --no-install-recommends {PACKAGES}; then: make slurm-test"
    return None


def up(folder: Path) -> None:
    """Bring the cluster up."""
    daemons.configure(folder)
    nodes.prepare(folder)
    engine.configure(folder)
    (folder / "catalog.csv").write_text(shapes.catalog())
    network.start()
    daemons.start(folder)
    login.start(folder)
    daemons.idle(folder)
    os.environ["SLURM_CONF"] = str(folder / "slurm.conf")


def shell(folder: Path) -> str:
    """Set the environment of a shell beside the cluster; return what to say first."""
    os.environ.update(engine.environment(folder))
    os.environ["PATH"] = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    return (
        f"# sinfo, squeue, sky and fogspec are this cluster's here; prices: --catalog {folder}/catalog.csv; "
        f"memory is confined: {daemons.confines_memory()}; everything ends with this shell"
    )


if __name__ == "__main__":
    sys.exit(apart.main("tests.tools.slurm", sys.argv[1:], missing() if os.getpid() != 1 else None, up, shell))
