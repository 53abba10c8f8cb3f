"""The account's API, moto's, and what stands behind it: machines in namespaces, and faults where they really happen.

A process of its own, `python -m tests.tools.aws.cloud FOLDER`. Moto itself is unmodified, but for the public addresses that it
gives: those of the network that the namespaces are on. What a test wants to go wrong it posts to `/_fault`; what was
answered in its place stands in `/_served`.
"""

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
import traceback
import urllib.parse
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import moto.ec2.models.elastic_network_interfaces as interfaces
from moto.ec2.models import ec2_backends
from moto.moto_server.werkzeug_app import DomainDispatcherApplication, MotoRequestHandler, create_backend_app
from werkzeug.serving import run_simple

from tests.tools import network
from tests.tools.aws import shapes

PORT = 5000
ENDPOINT = f"http://{network.CONTROLLER}:{PORT}"
ACCOUNT = "123456789012"
FIRST, LAST = 20, 199  # of the addresses that machines have; a robot has 200
POLL_S = 0.2
GUEST = Path(__file__).with_name("guest.py")
IMAGE = Path(__file__).resolve().parents[3] / ".venv-aws"
CGROUPS = Path("/sys/fs/cgroup")
QUERY_ERROR = (
    "<ErrorResponse><Error><Type>Sender</Type><Code>{code}</Code><Message>{message}</Message></Error></ErrorResponse>"
)
EC2_ERROR = (
    "<Response><Errors><Error><Code>{code}</Code><Message>{message}</Message></Error></Errors>"
    "<RequestID>00000000-0000-0000-0000-000000000000</RequestID></Response>"
)


# docs.aws.amazon.com/AWSEC2/latest/APIReference/errors-overview.html
STATUS = {
    "RequestLimitExceeded": "503 Service Unavailable",
    "InternalError": "500 Internal Server Error",
    "Unavailable": "503 Service Unavailable",
    "InsufficientInstanceCapacity": "500 Internal Server Error",
    "UnauthorizedOperation": "403 Forbidden",
    "ExpiredToken": "403 Forbidden",
    "RequestExpired": "400 Bad Request",
}


@dataclass
class Fault:
    """What happens instead of, or besides, a call of the API, or to a machine.

    `action` is a call, "*" or one of "boot", "reclaim" and "vanish"; each word of `match` is in the call's words, or in
    the names and type of the instances that it is about. `skip` such calls are answered as ever, then `times` are not, or
    all for `for_s` from the first on. `hang_s`: the answer takes so long; with no `code` it is then the right one, and `how`
    "answer" says that the answer alone is late. `how`: a machine that boots "silent" never answers, "dying" ends `after_s`
    later; a reclaimed one ends `after_s` after its notice, which comes once the machine has the file `sign`, if one is named; a
    new instance is not visible for `after_s`. `met` counts what it hit; `name` and `whose` are for who posts it.
    """

    action: str
    match: str = ""
    code: str = ""
    message: str = ""
    times: int = 1
    skip: int = 0
    hang_s: float = 0.0
    how: str = ""
    after_s: float = 0.0
    sign: str = ""
    for_s: float = 0.0
    until_s: float = 0.0
    met: int = 0
    name: str = ""
    whose: str = ""

    def due(self, action: str, about: str) -> bool:
        """Whether it is for this one; counts it."""
        if self.action not in (action, "*") or not self.waiting:
            return False
        if not all(word in about for word in self.match.split()):
            return False
        if self.skip > 0:
            self.skip -= 1
            return False
        if self.for_s and not self.until_s:
            self.until_s = time.time() + self.for_s
        self.times -= not self.for_s
        self.met += 1
        return True

    @property
    def waiting(self) -> bool:
        """Whether it can still happen."""
        return not self.until_s or time.time() < self.until_s if self.for_s else self.times > 0


@dataclass
class Cloud:
    """The machines, and the faults that are waiting."""

    folder: Path
    guests: dict[str, "subprocess.Popen[bytes]"] = field(default_factory=dict)
    faults: list[Fault] = field(default_factory=list)
    served: list[dict[str, Any]] = field(default_factory=list)
    calls: Counter[str] = field(default_factory=Counter)
    hidden: dict[str, float] = field(default_factory=dict)
    ends: dict[str, float] = field(default_factory=dict)
    addresses: int = FIRST - 1
    sees_all: int = 0  # the thread to which no instance is hidden
    lock: threading.RLock = field(default_factory=threading.RLock)
    launching: threading.Lock = field(default_factory=threading.Lock)  # held while a new instance has no tags yet

    def address(self) -> str:
        """The next public address: no two machines that live have the same."""
        with self.lock:
            taken = {one.public_ip for one in self.instances() if one.state != "terminated"}
            while True:
                self.addresses = FIRST + (self.addresses + 1 - FIRST) % (LAST - FIRST + 1)
                if (found := f"10.88.0.{self.addresses}") not in taken:
                    return found

    def instances(self) -> list[Any]:
        """All that moto knows, in all regions, also those that cannot be seen yet."""
        return [
            one
            for backend in list(ec2_backends[ACCOUNT].values())
            for reservation in list(backend.reservations.values())
            for one in list(reservation.instances)
        ]

    def fault(self, action: str, about: str) -> Fault | None:
        """The fault that this call meets, if any."""
        with self.lock:
            found = next((one for one in self.faults if one.due(action, about)), None)
            if found is not None:
                self.served.append({"action": action, "code": found.code or found.how or "hangs", "at_s": time.time()})
            return found

    def look(self) -> None:
        """Start what runs according to the API and does not, and the other way round."""
        with self.launching:
            instances = self.instances()
        for one in instances:
            try:
                self.follow(one)
            except Exception:  # whatever it is, the other machines go on
                traceback.print_exc()
        with self.lock:
            for reclaim in self.faults:
                if reclaim.action == "reclaim":
                    self.reclaim(reclaim)

    def follow(self, one: Any) -> None:
        """Do with a machine what the API says of it."""
        guest, now = self.guests.get(one.id), time.time()
        if one.state == "running" and one.id in self.ends and now >= self.ends[one.id]:
            self.end(one, "Server.SpotInstanceTermination: Instance terminated by the service")
        elif one.state == "running" and guest is None:
            address = one.public_ip
            if address is not None:  # else it has just been terminated
                self.boot(one, address)
        elif one.state == "running" and guest is not None and guest.poll() is not None:
            self.off(one)
        elif one.state != "running" and guest is not None:
            self.kill(one.id)

    def boot(self, one: Any, address: str) -> None:
        """A machine."""
        fault = self.fault("boot", about(one))
        shape = shapes.BY_NAME.get(one.instance_type)
        cpus, memory_gib = (shape.cpus, shape.memory_gib) if shape else (2, 4)
        wheels = sorted((self.folder / "sky" / ".sky" / "wheels").glob("?" * 32))
        registry = self.folder / "registry.json"
        told = {
            "id": one.id, "type": one.instance_type, "region": one.region_name, "zone": one.availability_zone,
            "hostname": "ip-" + one.private_ip.replace(".", "-"), "private_ip": one.private_ip, "endpoint": ENDPOINT,
            "cpus": cpus, "user_data": str(one.user_data or ""), "scratch": str(self.folder / "disks" / one.id),
            "image": {"/home/ubuntu/skypilot-runtime": str(IMAGE), "/home/ubuntu/sky-user-env": str(self.folder / "user")},
            "uv": str(self.folder / "uv"), "wheel": wheels[-1].name if wheels else "",
            "registry": json.loads(registry.read_text()) if registry.exists() else None,
            "silent": fault is not None and fault.how == "silent",
        }  # fmt: skip
        path = self.folder / "disks" / f"{one.id}.json"
        path.write_text(json.dumps(told))
        limits = {
            "memory": ("memory.limit_in_bytes", memory_gib * 2**30),
            "cpu": ("cpu.cfs_quota_us", cpus * 100_000),
        }
        groups = [group for name, limit in limits.items() if (group := confine(name, one.id, *limit))]

        def enter() -> None:
            for group in groups:
                (group / "cgroup.procs").write_text(str(os.getpid()))

        words = ["unshare", "--net", "--mount", "--uts", "--ipc", "--pid", "--fork", "--kill-child"]
        ready = 'hostname "$0" && ip link set lo up && read -r _ && exec "$@"'
        with open(self.folder / "log" / f"{one.id}.log", "wb") as log:
            guest = subprocess.Popen([*words, "sh", "-c", ready, told["hostname"], sys.executable, "-P", str(GUEST), str(path)],
                                     stdin=subprocess.PIPE, stdout=log, stderr=log, preexec_fn=enter)  # fmt: skip
        try:
            until(lambda: os.readlink(f"/proc/{guest.pid}/ns/net") != os.readlink("/proc/self/ns/net"))
            network.attach(str(guest.pid), "v" + one.id[-10:], address)
        except BaseException:
            guest.kill()
            guest.wait()
            raise
        self.guests[one.id] = guest
        assert guest.stdin is not None
        with contextlib.suppress(OSError):
            guest.stdin.write(b"\n")
            guest.stdin.flush()
        if fault is not None and fault.how == "dying":
            self.ends[one.id] = time.time() + fault.after_s

    def off(self, one: Any) -> None:
        """It turned itself off, which ends it or only its bill for more than the disk."""
        self.guests.pop(one.id)
        backend = ec2_backends[ACCOUNT][one.region_name]
        if one.instance_initiated_shutdown_behavior == "terminate":
            backend.terminate_instances([one.id])
        else:
            backend.stop_instances([one.id])

    def end(self, one: Any, reason: str) -> None:
        """EC2 ends it by itself."""
        ec2_backends[ACCOUNT][one.region_name].terminate_instances([one.id])
        one.state_reason.message, one.state_reason.code = reason, reason.partition(":")[0]
        self.kill(one.id)

    def reclaim(self, fault: Fault) -> None:
        """A notice to a machine that runs, which ends when the notice's time is over."""
        for one in self.instances():
            guest = self.guests.get(one.id)
            if one.state != "running" or guest is None or one.id in self.ends:
                continue
            inside = signed(guest.pid, fault.sign)
            if inside is None or not fault.due("reclaim", about(one)):
                continue
            self.ends[one.id] = time.time() + fault.after_s
            notice = json.dumps({"action": "terminate", "time": self.ends[one.id]})
            words = ["nsenter", f"--target={inside}", "--mount", "sh", "-c", 'echo "$0" > /run/spot-notice', notice]
            subprocess.run(words, check=False)
            self.served.append({"action": "reclaim", "code": one.id, "at_s": time.time()})

    def kill(self, number: str) -> None:
        """Everything of a machine; its disk was in its mounts."""
        guest = self.guests.pop(number)
        guest.kill()
        guest.wait()
        for name in ("memory", "cpu"):
            with contextlib.suppress(OSError):
                until(lambda name=name: not (CGROUPS / name / number / "cgroup.procs").read_text(), 5.0)
                (CGROUPS / name / number).rmdir()


def signed(pid: int, file: str) -> int | None:
    """The first process of a machine that has this file, or of any if none is named."""
    try:
        inside = int(Path(f"/proc/{pid}/task/{pid}/children").read_text().split()[0])
    except (OSError, IndexError):  # it has just begun, or ended
        return None
    return inside if not file or Path(f"/proc/{inside}/root{file}").exists() else None


def confine(name: str, group: str, file: str, value: int) -> Path | None:
    """A cgroup with a limit, where there are cgroups to be made."""
    path = CGROUPS / name / group
    try:
        path.mkdir(exist_ok=True)
        (path / file).write_text(str(value))
    except OSError:
        return None
    return path


def until(true: Callable[[], bool], patience_s: float = 1200.0) -> None:
    """Wait for something that takes a moment."""
    end = time.monotonic() + patience_s
    while not true():
        if time.monotonic() > end:
            raise TimeoutError
        time.sleep(0.01)


def about(one: Any) -> str:
    """What a fault can be for: the instance's type and names."""
    return " ".join([one.id, one.instance_type, *(tag["value"] for tag in one.get_tags())])


class Gate:
    """Before moto: the faults."""

    def __init__(self, cloud: Cloud, app: Any) -> None:
        self.cloud, self.app = cloud, app
        self.launches: dict[str, tuple[str, Any, bytes]] = {}

    def __call__(self, environ: dict[str, Any], start: Any) -> Iterable[bytes]:
        length = int(environ.get("CONTENT_LENGTH") or 0)
        body = environ["wsgi.input"].read(length)
        environ["wsgi.input"] = _Again(body)
        if environ["PATH_INFO"].startswith("/_"):
            return self.asked(environ["PATH_INFO"], body, start)
        said = urllib.parse.parse_qs(body.decode("utf-8", "replace"))
        action = said.get("Action", [""])[0]
        self.cloud.calls[action] += 1
        named = {
            value for key, values in said.items() if key.startswith(("InstanceId", "ResourceId")) for value in values
        }
        meant = [about(one) for one in self.cloud.instances() if one.id in named]
        words = " ".join([*(value for values in said.values() for value in values), *meant])
        fault = self.cloud.fault(action, f"{words} {environ.get('HTTP_AUTHORIZATION', '')}")
        if fault is not None and fault.how == "answer":
            answer = self.idempotent(said, environ, start)
            time.sleep(fault.hang_s)
            return answer
        if fault is not None and fault.hang_s:
            time.sleep(fault.hang_s)
        if fault is not None and fault.code:
            text = EC2_ERROR if "/ec2/" in environ.get("HTTP_AUTHORIZATION", "") else QUERY_ERROR
            start(STATUS.get(fault.code, "400 Bad Request"), [("Content-Type", "text/xml")])
            return [text.format(code=fault.code, message=fault.message).encode()]
        return self.idempotent(said, environ, start)

    def idempotent(self, said: dict[str, list[str]], environ: dict[str, Any], start: Any) -> Iterable[bytes]:
        """Moto's answer; a launch that was requested twice with one token is the same launch, as EC2 says and moto does not.

        docs.aws.amazon.com/ec2/latest/devguide/ec2-api-idempotency.html
        """
        token = said.get("ClientToken", [""])[0]
        if not token or said.get("Action") != ["RunInstances"]:
            return self.app(environ, start)
        with self.cloud.launching:
            if token not in self.launches:
                headers: list[Any] = []
                self.cloud.sees_all = threading.get_ident()  # the launch itself does
                try:
                    body = b"".join(self.app(environ, lambda *head, **_: headers.extend(head)))
                finally:
                    self.cloud.sees_all = 0
                if not headers[0].startswith("200"):
                    start(*headers[:2])
                    return [body]
                self.launches[token] = headers[0], headers[1], body
            status, head, body = self.launches[token]
        start(status, head)
        return [body]

    def asked(self, path: str, body: bytes, start: Any) -> Iterable[bytes]:
        """What a test wants, and wants to know."""
        cloud = self.cloud
        answer: object = None
        with cloud.lock:
            if path == "/_fault":
                cloud.faults.append(Fault(**json.loads(body)))
            elif path == "/_clear":
                cloud.faults.clear()
                cloud.served.clear()
            elif path == "/_lift":
                whose = json.loads(body)["whose"]
                answer = [vars(one) for one in cloud.faults if one.whose == whose]
                cloud.faults[:] = [one for one in cloud.faults if one.whose != whose]
            elif path == "/_served":
                answer = cloud.served
            elif path == "/_calls":
                answer = cloud.calls
            elif path == "/_waiting":
                answer = [vars(one) for one in cloud.faults if one.waiting]
            elif path == "/_machines":
                answer = sorted(cloud.guests)
        start("200 OK", [("Content-Type", "application/json")])
        return [json.dumps(answer).encode()]


class _Again:
    """A request's body, to be read once more."""

    def __init__(self, body: bytes) -> None:
        self.body, self.at = body, 0

    def read(self, size: int = -1) -> bytes:
        begun, self.at = self.at, len(self.body) if size < 0 else self.at + size
        return self.body[begun : self.at]

    def readline(self, size: int = -1) -> bytes:
        end = self.body.find(b"\n", self.at) + 1 or len(self.body)
        return self.read(min(end - self.at, size) if size >= 0 else end - self.at)


def invisible(cloud: Cloud) -> None:
    """Let new instances stay out of sight for as long as a fault says: EC2 is consistent in the end only."""
    backend = type(ec2_backends[ACCOUNT][shapes.REGION])
    shown = backend.all_reservations

    def all_reservations(self: Any, filters: Any = None) -> Any:
        for one in cloud.instances():
            if one.id not in cloud.hidden:
                fault = cloud.fault("vanish", about(one))
                cloud.hidden[one.id] = time.time() + fault.after_s if fault else 0.0
        found = shown(self, filters)
        if cloud.sees_all == threading.get_ident():
            return found
        for reservation in found:
            reservation.instances = [
                one for one in reservation.instances if time.time() >= cloud.hidden.get(one.id, 0.0)
            ]
        return [one for one in found if one.instances]

    backend.all_reservations = all_reservations


def serve(folder: Path) -> None:
    """The API, and the machines, until this ends."""
    cloud = Cloud(folder)
    interfaces.random_public_ip = cloud.address
    invisible(cloud)

    def watch() -> None:
        while True:
            cloud.look()
            time.sleep(POLL_S)

    threading.Thread(target=watch, daemon=True).start()
    gate = Gate(cloud, DomainDispatcherApplication(create_backend_app))
    run_simple(network.CONTROLLER, PORT, gate, threaded=True, request_handler=MotoRequestHandler)


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
