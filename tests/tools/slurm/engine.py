"""A SkyPilot of its own: home, configuration, port. Nothing of it touches the user's ~/.sky."""

import json
import os
import subprocess
import sys
import time
import zlib
from pathlib import Path

from tests.tools.slurm import login
from tests.tools.slurm.shapes import CLUSTER, SHAPES

PORT = 46711


def environment(folder: Path) -> dict[str, str]:
    """The environment in which SkyPilot, and so fogspec, is this cluster's."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("SKY", "SLURM"))}
    home = folder / "sky"
    return kept | {
        # SkyPilot has pip build a wheel of itself: with what is installed, for there is no network. "0" says just that.
        "PIP_NO_INDEX": "1",
        "PIP_NO_BUILD_ISOLATION": "0",
        "HOME": str(home),
        "XDG_CACHE_HOME": str(home / ".cache"),
        "SKYPILOT_API_SERVER_LOCAL_PORT": str(PORT),
        "SKYPILOT_DISABLE_USAGE_COLLECTION": "1",
        "SLURM_CONF": str(folder / "slurm.conf"),
    }


def configure(folder: Path) -> None:
    """Say where the cluster is and what its partitions cost."""
    home = folder / "sky"
    (home / ".slurm").mkdir(parents=True, exist_ok=True)
    (home / ".sky").mkdir(exist_ok=True)
    # SkyPilot's ssh connections are in /tmp under this name, which is the same for everybody called root on one host:
    # two clusters would talk through each other's.
    (home / ".sky" / "user_hash").write_text(f"{zlib.crc32(str(folder).encode()):08x}")
    (home / ".slurm" / "config").write_text(
        f"Host {CLUSTER}\n    HostName 127.0.0.1\n    Port {login.PORT}\n    User {login.USER}\n"
        f"    IdentityFile {folder}/ssh/user\n"
    )
    # SkyPilot looks here for how accelerators are spelled before it asks the internet.
    common = home / ".sky" / "catalogs" / "v8" / "common"
    common.mkdir(parents=True, exist_ok=True)
    rows = "".join(f"{one.gpu},\"['Slurm']\"\n" for one in SHAPES if one.gpu)
    (common / "accelerators.csv").write_text(f"AcceleratorName,Clouds\n{rows}")
    lines = ["allowed_clouds: [slurm]", "slurm:", "  cluster_configs:", f"    {CLUSTER}:", f"      tmpdir: {folder}/tmp",
             "      partition_configs:"]  # fmt: skip
    for one in SHAPES:
        price = f"accelerators: {{{one.gpu}: {one.price_usd_per_hour}}}" if one.gpu else ""
        cpu = 0.0 if one.gpu else one.price_usd_per_hour / one.cpus
        lines.append(f"        {one.name}: {{pricing: {{cpu: {cpu}, memory: 0.0{', ' if price else ''}{price}}}}}")
    (home / ".sky" / "config.yaml").write_text("\n".join(lines) + "\n")


KNOWN = """
import json, sky
mode = sky.StatusRefreshMode.%s
print(json.dumps([one["name"] for one in sky.get(sky.status(refresh=mode, all_users=True))]))
"""


def clusters(folder: Path, refresh: bool = False) -> list[str]:
    """Names of the clusters that SkyPilot has, as it believes, or as their cloud says."""
    return known(environment(folder), refresh)


def known(environment: dict[str, str], refresh: bool = False) -> list[str]:
    """The same, for the engine of this environment."""
    code = KNOWN % ("FORCE" if refresh else "NONE")
    ended = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=600)
    names: list[str] = json.loads(ended.stdout.splitlines()[-1])
    return names


def start(environment: dict[str, str], patience_s: float = 1200.0) -> None:
    """Have the API server of this environment running: on a busy host it may take longer than SkyPilot itself waits."""
    end = time.monotonic() + patience_s
    while True:
        ended = subprocess.run([sys.executable, "-c", KNOWN % "NONE"], env=environment, capture_output=True, text=True)
        if not ended.returncode:
            return
        if time.monotonic() > end:
            raise RuntimeError(f"SkyPilot's API server does not start: {ended.stderr[-2000:]}")
        time.sleep(2.0)


def processes(folder: Path) -> list[int]:
    """Whatever still runs with this engine's home; an API server's executors write their title over their environment."""
    marks = {f"HOME={folder / 'sky'}".encode(), b"SKYPILOT_API_SERVER_LOCAL_PORT=%d" % PORT}
    found = []
    for entry in filter(str.isdigit, os.listdir("/proc")):
        process = Path("/proc", entry)
        try:
            said = set((process / "environ").read_bytes().split(b"\0"))
            titled = (process / "cmdline").read_bytes().startswith(b"SkyPilot:")
            here = titled and any(os.readlink(one).startswith(f"{folder}/sky/") for one in (process / "fd").iterdir())
        except OSError:
            continue
        if (here or marks <= said) and int(entry) != os.getpid():
            found.append(int(entry))
    return found
