"""The login node: a user, names for the nodes, and an ssh server that only this user's key opens."""

import contextlib
import os
import pwd
import shutil
import socket
from pathlib import Path

from tests.tools import network
from tests.tools.slurm.daemons import run
from tests.tools.slurm.shapes import SHAPES

USER = "lab"
PORT = 2322
HOSTS = Path("/etc/hosts")

SSHD = """\
ListenAddress 127.0.0.1
Port {port}
HostKey {folder}/ssh/host
PidFile {folder}/run/sshd.pid
UsePAM no
PasswordAuthentication no
PubkeyAuthentication yes
StrictModes no
AllowUsers {user}
SetEnv SLURM_CONF={folder}/slurm.conf PATH=/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin
AcceptEnv SKY_CLUSTER_NAME
Subsystem sftp internal-sftp
MaxStartups 100:30:200
MaxSessions 200
"""


def start(folder: Path) -> None:
    """Make the user and the names, start the server."""
    home = folder / "home"
    home.mkdir(exist_ok=True)
    # A password of "*" is one that nobody has; "!" would lock the account, which sshd without PAM refuses.
    run(folder, "useradd", "--no-create-home", "--password", "*", "--home-dir", str(home), "--shell", "/bin/bash", USER)
    # SkyPilot asks for every node's address by its name.
    names = [(network.address(number), one.name) for number, one in enumerate(SHAPES)]
    names.append((network.CONTROLLER, socket.gethostname()))
    HOSTS.write_text("".join(f"{address} {name}\n" for address, name in names) + HOSTS.read_text())
    keys = folder / "ssh"
    keys.mkdir(mode=0o700, exist_ok=True)
    for name in ("host", "user"):
        if not (keys / name).exists():
            run(folder, "ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(keys / name))
    (home / ".ssh").mkdir(mode=0o700, exist_ok=True)
    shutil.copy(keys / "user.pub", home / ".ssh" / "authorized_keys")
    for path in (home, home / ".ssh", home / ".ssh" / "authorized_keys"):
        shutil.chown(path, USER)
    (keys / "sshd_config").write_text(SSHD.format(port=PORT, folder=folder, user=USER))
    Path("/run/sshd").mkdir(exist_ok=True)
    run(folder, "/usr/sbin/sshd", "-f", str(keys / "sshd_config"))


def processes() -> list[str]:
    """What the user runs now, on whichever node, but for connections."""
    uid = next((one.pw_uid for one in pwd.getpwall() if one.pw_name == USER), None)
    found = []
    for entry in filter(str.isdigit, os.listdir("/proc")):
        with contextlib.suppress(OSError):
            if os.stat(f"/proc/{entry}").st_uid != uid:
                continue
            command = Path("/proc", entry, "cmdline").read_bytes().replace(b"\0", b" ").decode("utf-8", "replace")
            if command and not command.startswith("sshd"):
                found.append(f"{entry} {command[:200]}")
    return found
