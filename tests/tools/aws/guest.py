"""An instance from within, as the first process of its namespaces: its disk, its first boot, SSH, and an end.

Run by Python alone, as `python guest.py FILE`; the file tells who it is. Its disk is this machine's with what the image
adds, and changes of it stay in memory. Of cloud-init it does what SkyPilot asks: users, files, commands. Its metadata
service, at the address that EC2 gives it, is in the instance's own network and hands out the credentials of its role.
"""

import base64
import ctypes
import http.server
import json
import os
import pwd
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import yaml

METADATA = "169.254.169.254"
PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
SSHD = """\
Port 22
HostKey /etc/ssh/guest_key
PidFile /run/sshd.pid
UsePAM no
PasswordAuthentication no
StrictModes no
SetEnv PATH={path} AWS_ENDPOINT_URL={endpoint}
Subsystem sftp internal-sftp
"""
# There is no systemd. What is asked of it that matters here: to turn the machine off, now or later.
SYSTEMCTL = """\
#!/bin/sh
case "$1 $2" in
  poweroff*) kill -TERM 1 ;;
  "enable --now")
    seconds=$(sed -n 's/^OnBootSec=//p' "/etc/systemd/system/$3")
    setsid sh -c 'sleep "$0"; exec systemctl poweroff' "$seconds" </dev/null >/dev/null 2>&1 &
    ;;
esac
exit 0
"""
SYSTEMD_RUN = """\
#!/bin/bash
[[ $1 == --on-boot=* ]] || exit 1
seconds=${1#--on-boot=}; shift
setsid bash -c 'sleep "$0"; exec "$@"' "$seconds" "$@" </dev/null >/dev/null 2>&1 &
"""
# SkyPilot asks docker for its runtimes in docker's words, which are not podman's. Its limits are those
# that this root may set: SkyPilot wants more.
DOCKER = """\
#!/bin/bash
case $1 in
  info) echo 'map[crun:{}]' ;;
  run)
    shift
    files=$(ulimit -Hn) processes=$(ulimit -Hu)
    [ "$processes" -le 32768 ] 2>/dev/null || processes=32768
    words=()
    for word in "$@"; do [[ $word == nofile=* ]] && word=nofile=$files:$files; words+=("$word"); done
    exec podman run --ulimit "nproc=$processes:$processes" "${words[@]}"
    ;;
  *) exec podman "$@" ;;
esac
"""
# What SkyPilot would download into the container is the machine's, as it is outside of one. A container has no cgroups of its
# own: it is in the machine's.
CONTAINERS = """\
[containers]
cgroups = "disabled"
env = ["AWS_ENDPOINT_URL={endpoint}"]
volumes = [{volumes}]
[engine]
cgroup_manager = "cgroupfs"
events_logger = "none"
runtime = "crun"
"""
PATCHED = ("_private", "dashboard/modules/job", "autoscaler/_private")


def disk(told: dict[str, Any]) -> None:
    """A root of its own over this machine's, with the image's environments in the user's home."""
    scratch = Path(told["scratch"])
    scratch.mkdir(parents=True)
    run("mount", "-t", "tmpfs", "none", str(scratch))
    root = overlay(scratch, "root", "/")
    for name, kind in (("proc", "proc"), ("tmp", "tmpfs"), ("run", "tmpfs")):
        run("mount", "-t", kind, kind, str(root / name))
    os.chmod(root / "tmp", 0o1777)
    run("mount", "--rbind", "/dev", str(root / "dev"))
    run("mount", "-t", "tmpfs", "tmpfs", str(root / "dev" / "shm"))
    for name, lower in told["image"].items():
        place = root / name.lstrip("/")
        place.mkdir(parents=True, exist_ok=True)
        run("mount", "--rbind", str(overlay(scratch, name.strip("/").replace("/", "-"), lower)), str(place))
    if told["registry"]:
        cgroups(root)
    (root / "old").mkdir()
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.syscall(155, str(root).encode(), str(root / "old").encode()) != 0:  # pivot_root on x86-64
        raise OSError(ctypes.get_errno(), "pivot_root")
    os.chdir("/")
    run("umount", "--lazy", "/old")


def cgroups(root: Path) -> None:
    """The cgroups of this machine, which whatever starts containers looks at; those of one kind, as crun wants them."""
    run("mount", "-t", "sysfs", "sysfs", str(root / "sys"))
    here, there = Path("/sys/fs/cgroup"), root / "sys/fs/cgroup"
    if (here / "cgroup.controllers").exists():
        run("mount", "--rbind", str(here), str(there))
        return
    run("mount", "-t", "tmpfs", "none", str(there))
    for one in sorted(here.iterdir()):
        if one.name != "unified":
            (there / one.name).mkdir()
            run("mount", "--rbind", str(one), str(there / one.name))


def overlay(scratch: Path, name: str, lower: str) -> Path:
    """`lower` with changes in memory."""
    upper, work, place = (scratch / f"{name}-{part}" for part in ("upper", "work", "all"))
    for one in (upper, work, place):
        one.mkdir()
    run("mount", "-t", "overlay", "overlay", "-o", f"lowerdir={lower},upperdir={upper},workdir={work}", str(place))
    return place


def run(*words: str) -> None:
    """A command that must succeed."""
    subprocess.run(words, check=True)


def script(path: str, text: str) -> None:
    """A program."""
    Path(path).write_text(text)
    os.chmod(path, 0o755)


def network(told: dict[str, Any]) -> None:
    """Its own addresses: the public one too, which EC2 would translate."""
    run("ip", "addr", "add", f"{told['private_ip']}/32", "dev", "eth0")
    run("ip", "addr", "add", f"{METADATA}/32", "dev", "lo")
    run("ip", "route", "add", "default", "dev", "eth0", "src", told["private_ip"])
    names = f"127.0.0.1 localhost\n{told['private_ip']} {told['hostname']}\n"
    Path("/etc/hosts").write_text(names)
    Path("/etc/hostname").write_text(told["hostname"] + "\n")
    Path("/etc/resolv.conf").unlink(missing_ok=True)
    Path("/etc/resolv.conf").write_text("")


def first_boot(told: dict[str, Any]) -> None:
    """What cloud-init does of the user data."""
    script("/usr/local/bin/systemctl", SYSTEMCTL)
    script("/usr/local/bin/systemd-run", SYSTEMD_RUN)
    Path("/etc/systemd/system").mkdir(parents=True, exist_ok=True)
    data = yaml.safe_load(base64.b64decode(told["user_data"] or b"")) or {}
    commands(data.get("bootcmd", ()))
    for one in data.get("users", ()):
        user(one, told)
    for one in data.get("write_files", ()):
        path = Path(one["path"])
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(one.get("content", ""))
    commands(data.get("runcmd", ()))


def commands(those: Any) -> None:
    """Each by a shell, or as it stands; a command that fails does not keep the others from running."""
    for one in those:
        subprocess.run(
            one if isinstance(one, list) else ["sh", "-c", one], env={"PATH": PATH}, stdin=subprocess.DEVNULL
        )


def user(one: dict[str, Any], told: dict[str, Any]) -> None:
    """A user, with the keys that may log in, and the image's environments in the home."""
    name = one["name"]
    try:
        known = pwd.getpwnam(name)
    except KeyError:
        run("useradd", "--password", "*", "--no-create-home", "--shell", one.get("shell", "/bin/sh"), name)
        known = pwd.getpwnam(name)
    home = Path(known.pw_dir)
    for place in (
        home,
        home / ".ssh",
        home / ".local",
        home / ".local" / "bin",
        home / ".sky",
        home / ".sky" / "wheels",
    ):
        place.mkdir(parents=True, exist_ok=True)
        os.chown(place, known.pw_uid, known.pw_gid)
    (home / ".ssh" / "authorized_keys").write_text("\n".join(key.strip() for key in one["ssh_authorized_keys"]) + "\n")
    if "sudo" in one:
        rule = Path("/etc/sudoers.d") / f"90-{name}"
        rule.write_text(f"{name} {one['sudo']}\n")
        rule.chmod(0o440)
    script(str(home / ".local" / "bin" / "uv"), Path(told["uv"]).read_text())
    if told["wheel"]:
        (home / ".sky" / "wheels" / "current_sky_wheel_hash").write_text(told["wheel"] + "\n")
    owned(home, known.pw_uid, known.pw_gid)


def owned(home: Path, uid: int, gid: int) -> None:
    """What SkyPilot writes in the image's environment is the user's; the rest stays as it is on this machine's disk."""
    runtime = home / "skypilot-runtime"
    ray = next(runtime.glob("lib/python3.*/site-packages/ray"))
    places = [home, runtime, home / "sky-user-env", ray.parent, *(ray / one for one in PATCHED)]
    for place in places:
        os.chown(place, uid, gid)
    for place in places[4:]:
        for file in place.glob("*.py"):
            os.chown(file, uid, gid)
    for place in (home / ".ssh", home / ".sky", home / ".local"):
        subprocess.run(["chown", "-R", f"{uid}:{gid}", str(place)], check=True)


def containers(told: dict[str, Any]) -> None:
    """Podman under docker's name; images are kept in memory, as everything here."""
    script("/usr/local/sbin/docker", DOCKER)
    store = Path("/var/lib/containers")
    store.mkdir(exist_ok=True)
    run("mount", "-t", "tmpfs", "none", str(store))
    home = "/home/ubuntu"
    places = {
        f"{home}/skypilot-runtime": "/root/skypilot-runtime",
        f"{home}/sky-user-env": "/root/sky-user-env",
        f"{home}/sky-user-env/bin": f"{home}/sky-user-env/bin",
        f"{home}/.local/bin/uv": "/root/.local/bin/uv",
        f"{home}/.sky/wheels/current_sky_wheel_hash": "/root/.sky/wheels/current_sky_wheel_hash",
    }
    volumes = ", ".join(json.dumps(f"{here}:{there}") for here, there in places.items() if Path(here).exists())
    certificates = Path("/etc/containers/certs.d", told["registry"]["name"])
    certificates.mkdir(parents=True)
    (certificates / "ca.crt").write_text(told["registry"]["certificate"])
    text = CONTAINERS.format(endpoint=told["endpoint"], volumes=volumes)
    Path("/etc/containers/containers.conf").write_text(text)


def ssh(told: dict[str, Any]) -> None:
    """The server."""
    run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", "/etc/ssh/guest_key")
    Path("/etc/ssh/sshd_config").write_text(SSHD.format(path=PATH, endpoint=told["endpoint"]))
    Path("/run/sshd").mkdir()
    run("/usr/sbin/sshd")


class Metadata(http.server.BaseHTTPRequestHandler):
    """What an instance can ask of itself."""

    told: dict[str, Any]

    def do_PUT(self) -> None:
        self.answer("a-token")

    def do_GET(self) -> None:
        place = {"region": self.told["region"], "availabilityZone": self.told["zone"], "instanceId": self.told["id"],
                 "instanceType": self.told["type"]}  # fmt: skip
        role = "/latest/meta-data/iam/security-credentials/"
        keys = {"Code": "Success", "Type": "AWS-HMAC", "AccessKeyId": "ASIAOFTHEROLE", "SecretAccessKey": "none",
                "Token": "none", "LastUpdated": "2026-01-01T00:00:00Z", "Expiration": "2099-01-01T00:00:00Z"}  # fmt: skip
        notice = Path("/run/spot-notice")
        answers = {
            "/latest/dynamic/instance-identity/document": json.dumps(place),
            "/latest/meta-data/placement/region": self.told["region"],
            "/latest/meta-data/placement/availability-zone": self.told["zone"],
            "/latest/meta-data/instance-id": self.told["id"],
            role: "skypilot-v1",
            role + "skypilot-v1": json.dumps(keys),
        }
        if notice.exists():
            answers["/latest/meta-data/spot/instance-action"] = notice.read_text()
        self.answer(answers.get(self.path))

    def answer(self, text: str | None) -> None:
        self.send_response(404 if text is None else 200)
        self.send_header("X-aws-ec2-metadata-token-ttl-seconds", "21600")
        self.send_header("Content-Length", str(len(text or "")))
        self.end_headers()
        self.wfile.write((text or "").encode())

    def log_message(self, *_: object) -> None:
        """It says nothing."""


def main(path: str) -> None:
    """Boot, then take leave of processes whose parents are gone until somebody turns the machine off."""
    told = json.loads(Path(path).read_text())
    signal.signal(signal.SIGTERM, lambda *_: os._exit(0))
    uv = Path(told["uv"]).read_text()
    disk(told)
    told["uv"] = "/run/uv"
    Path(told["uv"]).write_text(uv)
    network(told)
    Path("/run/instance.json").write_text(json.dumps({name: told[name] for name in ("id", "type", "cpus")}))
    first_boot(told)
    if told["registry"]:
        containers(told)
    Metadata.told = told
    server = http.server.ThreadingHTTPServer((METADATA, 80), Metadata)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    if not told.get("silent"):
        ssh(told)
    while True:
        try:
            os.wait()
        except ChildProcessError:
            time.sleep(0.5)


if __name__ == "__main__":
    main(sys.argv[1])
