"""`python -m tests.tools.slurm up|down|status [FOLDER]`, as root: the cluster, and how to use it."""

import os
import shutil
import sys
import tempfile
from pathlib import Path

from tests.tools.slurm import daemons, engine, login, nodes, shapes

PROGRAMS = ("slurmctld", "slurmd", "munged", "sshd", "ssh", "rsync", "useradd")
PACKAGES = "slurm-wlm munge openssh-server openssh-client rsync"


def default_folder() -> Path:
    """A short path that every user may enter: sockets have short names."""
    return Path(os.environ.get("FOGSPEC_SLURM", Path(tempfile.gettempdir()) / "fogspec-slurm"))


def missing() -> str | None:
    """What stands in the way here, and the one command that helps; None where nothing does."""
    path = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])
    if os.geteuid() != 0:
        return "needs root: sudo -s"
    if absent := [name for name in PROGRAMS if shutil.which(name, path=path) is None]:
        return f"needs {', '.join(absent)}: apt-get install --no-install-recommends {PACKAGES}"
    return None


def up(folder: Path) -> None:
    """Bring the cluster up; once more is no mistake. Raises SystemExit with what is missing."""
    if why := missing():
        raise SystemExit(why)
    folder.mkdir(mode=0o755, parents=True, exist_ok=True)
    os.environ["PATH"] += ":/usr/sbin:/sbin"
    if daemons.living(folder, "slurmctld") is None:
        daemons.configure(folder)
        nodes.prepare(folder)
        engine.configure(folder)
        (folder / "catalog.csv").write_text(shapes.catalog())
        daemons.start(folder)
        login.start(folder)
        daemons.idle(folder)


def down(folder: Path) -> None:
    """End everything and remove the folder, the user and the names."""
    os.environ["PATH"] += ":/usr/sbin:/sbin"
    engine.stop(folder)
    daemons.stop(folder)
    login.stop()
    shutil.rmtree(folder, ignore_errors=True)


def main(words: list[str]) -> None:
    """The command line."""
    folder = Path(words[1]).absolute() if len(words) > 1 else default_folder()
    if words[0] == "up":
        up(folder)
        given = {k: v for k, v in engine.environment(folder).items() if os.environ.get(k) != v}
        print("# a Slurm cluster and a SkyPilot engine; to use them in this shell:")
        print(f"export {' '.join(f'{key}={value}' for key, value in given.items())}")
        print(f"# prices: --catalog {folder / 'catalog.csv'}; memory is confined: {daemons.confines_memory()}")
    elif words[0] == "down":
        down(folder)
    else:
        print("\n".join(daemons.jobs(folder)))


if __name__ == "__main__":
    main(sys.argv[1:])
