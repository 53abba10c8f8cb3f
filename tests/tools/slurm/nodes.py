"""What a node has before SkyPilot comes: Python environments that SkyPilot would otherwise download for each cluster.

On a machine of a cloud SkyPilot installs uv, a Python and itself, from the internet. Here a Prolog, which Slurm runs
on a node before a job, puts them in place: an environment that shares the packages of the one that runs this.
"""

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

from tests.tools.slurm.login import USER

PYTHON = Path(f"/usr/bin/python{sys.version_info.major}.{sys.version_info.minor}")

UV = """\
#!/bin/bash
# SkyPilot asks for a Python that this machine need not have, and for packages that are there already.
words=() before=
for word in "$@"; do [ "$before" = --python ] && [ "$word" = 3.10 ] && word={python}; words+=("$word"); before=$word; done
export UV_CACHE_DIR={folder}/uv-cache UV_NO_PROGRESS=1 UV_PYTHON_DOWNLOADS=never UV_OFFLINE=1
umask 000
exec {uv} "${{words[@]}}"
"""

# Slurm runs it as root on the node, before the job's first process. SkyPilot's job is called <cluster>-<user hash>.
PROLOG = """\
#!/bin/bash
export SLURM_CONF={folder}/slurm.conf
name=$(squeue -h -j "$SLURM_JOB_ID" -o %j)
[[ $name =~ ^[A-Za-z0-9][A-Za-z0-9._-]*$ ]] || exit 0
cluster={folder}/home/.sky_clusters/$name runtime={folder}/tmp/$name
mkdir -p "$cluster/.local/bin" "$cluster/.sky/wheels" "$runtime"
cp -f {folder}/bin/uv "$cluster/.local/bin/uv"
cp -a {folder}/env/runtime "$runtime/skypilot-runtime"
cp -a {folder}/env/user "$cluster/sky-user-env"
for wheel in {folder}/sky/.sky/wheels/*/; do
  wheel=$(basename "$wheel")
  [[ $wheel =~ ^[0-9a-f]{{32}}$ ]] && echo "$wheel" > "$cluster/.sky/wheels/current_sky_wheel_hash"
done
chown -R {user}: {folder}/home/.sky_clusters "$runtime"
exit 0
"""

PIP = '#!/bin/sh\nexec "$(dirname "$0")/python" -m pip "$@"\n'

# One machine plays several nodes, and all their agents look for a free port from the same number on.
PORTS = """

import os as _os, zlib as _zlib
SKYLET_GRPC_PORT = 46600 + _zlib.crc32(_os.environ.get("SKY_RUNTIME_DIR", "").encode()) % 3000
"""


def prepare(folder: Path) -> None:
    """Make the environments and the Prolog that hands them out."""
    if not PYTHON.exists():
        raise SystemExit(f"the nodes need {PYTHON}: the version of the Python that runs this, readable by every user")
    for name in ("bin", "tmp", "uv-cache", "env"):
        (folder / name).mkdir(exist_ok=True)
    for name in ("tmp", "uv-cache"):
        (folder / name).chmod(0o1777)
    uv = Path(sysconfig.get_path("scripts")) / "uv"
    shutil.copy(uv, folder / "bin" / "uv-real")
    words = {"folder": folder, "python": PYTHON, "user": USER, "uv": folder / "bin" / "uv-real"}
    script(folder / "bin" / "uv", UV.format(**words))
    script(folder / "prolog.sh", PROLOG.format(**words))
    packages = folder / "packages"
    _packages(packages)
    for name in ("runtime", "user"):
        environment(folder / "env" / name, packages if name == "runtime" else None, folder / "bin" / "uv-real")


def _packages(packages: Path) -> None:
    """This environment's packages where every user can read them: hard links where that is possible."""
    shutil.rmtree(packages, ignore_errors=True)
    here = sysconfig.get_path("purelib")
    if subprocess.run(["cp", "-al", here, packages], capture_output=True).returncode:
        shutil.rmtree(packages, ignore_errors=True)
        subprocess.run(["cp", "-a", here, packages], check=True)
    # Links are shared with the environment they come from: what is changed must be a new file.
    constants = packages / "sky" / "skylet" / "constants.py"
    text = constants.read_text()
    constants.unlink()
    constants.write_text(text + PORTS)


def environment(path: Path, packages: Path | None, uv: Path) -> None:
    if path.exists():
        return
    words = ["venv", "-q", "--relocatable", "--python", str(PYTHON), *([] if packages else ["--system-site-packages"])]
    subprocess.run([uv, *words, str(path)], check=True, env=os.environ | {"UV_PYTHON_DOWNLOADS": "never"})
    script(path / "bin" / "pip", PIP)
    if packages is not None:
        site = next(path.glob("lib/python3.*/site-packages"))
        shutil.rmtree(site)
        site.symlink_to(packages)


def script(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o755)
