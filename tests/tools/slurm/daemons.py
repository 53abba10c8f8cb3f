"""Slurm's daemons: their configuration and start. All state is under one folder."""

import contextlib
import os
import secrets
import socket
import subprocess
import time
from pathlib import Path

from tests.tools import network
from tests.tools.slurm.shapes import CLUSTER, SHAPES

CTLD_PORT = 16917
NODE_PORT = 17101
MEMORY_CGROUPS = Path("/sys/fs/cgroup/memory")
FREEZER_CGROUPS = Path("/sys/fs/cgroup/freezer")

SLURM_CONF = """\
ClusterName={cluster}
SlurmctldHost={host}({controller})
SlurmctldPort={port}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/run/munge.sock
CredType=cred/munge
StateSaveLocation={folder}/ctld
SlurmdSpoolDir={folder}/spool.%n
SlurmctldPidFile={folder}/run/slurmctld.pid
SlurmdPidFile={folder}/run/slurmd.%n.pid
SlurmctldLogFile={folder}/log/slurmctld.log
SlurmdLogFile={folder}/log/slurmd.%n.log
ProctrackType={proctrack}
TaskPlugin={task}
JobAcctGatherType=jobacct_gather/linux
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
SlurmdParameters=config_overrides
SchedulerParameters=sched_interval=2,bf_interval=2,batch_sched_delay=0,defer
EnforcePartLimits=ALL
MpiDefault=none
SwitchType=switch/none
ReturnToService=2
KillWait=5
MinJobAge=60
SlurmctldTimeout=30
SlurmdTimeout=120
PrologFlags=Alloc
Prolog={folder}/prolog.sh
GresTypes=gpu
"""


def confines_memory() -> bool:
    """Whether Slurm of this age can bound a job's memory here: it knows cgroup v1, and v2 only below systemd."""
    return all(os.access(one / "cgroup.procs", os.W_OK) for one in (MEMORY_CGROUPS, FREEZER_CGROUPS))


def configure(folder: Path) -> None:
    """Write slurm.conf, cgroup.conf and gres.conf."""
    for name in ("ctld", "log", "run", "munge", "gpu"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    confined, host = confines_memory(), socket.gethostname().partition(".")[0]
    conf = SLURM_CONF.format(
        cluster=CLUSTER, host=host, controller=network.CONTROLLER, port=CTLD_PORT, folder=folder,
        proctrack="proctrack/cgroup" if confined else "proctrack/linuxproc",
        task="task/cgroup" if confined else "task/none",
    )  # fmt: skip
    gres = ""
    for number, one in enumerate(SHAPES):
        generic = f"Gres=gpu:{one.gpu.lower()}:1 " if one.gpu else ""
        if one.gpu:
            gres += f"NodeName={one.name} Name=gpu Type={one.gpu.lower()} File={_device(folder, one.name)}\n"
        memory_mib = one.memory_gib * 1024
        conf += (
            f"NodeName={one.name} NodeAddr={network.address(number)} Port={NODE_PORT} CPUs={one.cpus} "
            f"RealMemory={memory_mib} {generic}State=UNKNOWN\n"
            f"PartitionName={one.name} Nodes={one.name} Default={'NO' if number else 'YES'} MaxTime=01:00:00 "
            "DefaultTime=00:30:00 State=UP OverSubscribe=NO\n"
        )
    (folder / "slurm.conf").write_text(conf)
    (folder / "gres.conf").write_text(gres)
    ram = "yes" if confined else "no"
    (folder / "cgroup.conf").write_text(
        f"CgroupPlugin=cgroup/v1\nCgroupMountpoint=/sys/fs/cgroup\nConstrainCores=no\nConstrainRAMSpace={ram}\n"
        "ConstrainSwapSpace=no\nAllowedSwapSpace=0\n"
    )


def _device(folder: Path, name: str) -> Path:
    """A stand-in for an accelerator's device file: Slurm counts files."""
    path = folder / "gpu" / name
    if not path.exists():
        os.mknod(path, 0o666 | 0o020000, os.makedev(1, 3))
    return path


def start(folder: Path) -> None:
    """Start munge, the controller and a daemon a node."""
    key = folder / "munge" / "munge.key"
    if not key.exists():
        key.write_bytes(secrets.token_bytes(1024))
        key.chmod(0o400)
    (folder / "munge").chmod(0o700)
    run(folder, "munged", "--force", f"--key-file={key}", f"--socket={folder}/run/munge.sock",
        f"--pid-file={folder}/run/munged.pid", f"--log-file={folder}/munge/munged.log",
        f"--seed-file={folder}/munge/seed")  # fmt: skip
    run(folder, "slurmctld", "-c", "-f", str(folder / "slurm.conf"))
    for number, one in enumerate(SHAPES):
        network.on_node(one.name, number, ["slurmd", "-c", "-f", str(folder / "slurm.conf"), "-N", one.name])


def run(folder: Path, *words: str) -> str:
    """What a command prints; raises CalledProcessError with what it said."""
    environment = os.environ | {"SLURM_CONF": str(folder / "slurm.conf")}
    ended = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=600)
    if ended.returncode:
        raise SystemExit(f"{' '.join(words)}: {ended.stderr.strip() or ended.stdout.strip()}")
    return ended.stdout


def idle(folder: Path, patience_s: float = 1200.0) -> None:
    """Wait until every node is idle."""
    end = time.monotonic() + patience_s
    while (states := run(folder, "sinfo", "-h", "-N", "-o", "%T").split()) != ["idle"] * len(SHAPES):
        if time.monotonic() > end:
            raise SystemExit(f"the nodes do not get idle: {' '.join(states)}; see {folder}/log")
        time.sleep(0.3)


def living(folder: Path, name: str) -> int | None:
    """The process id of a daemon, if it runs."""
    try:
        pid = int((folder / "run" / f"{name}.pid").read_text())
        command = Path("/proc", str(pid), "cmdline").read_bytes()
    except (OSError, ValueError):
        return None
    return pid if name.partition(".")[0].encode() in command else None


def below(pid: int) -> list[int]:
    """All processes below this one, deepest first."""
    found = []
    for entry in filter(str.isdigit, os.listdir("/proc")):
        with contextlib.suppress(OSError):
            if int(Path("/proc", entry, "stat").read_bytes().rsplit(b")", 1)[1].split()[1]) == pid:
                found += [*below(int(entry)), int(entry)]
    return found
