"""A sandboxed program reads the directories it was given, and does nothing else: each attack fails, as root and as a user."""

import json
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fogspec.base import sandbox
from tests.support.attacked import HEAD

REPOSITORY = Path(__file__).resolve().parents[3]
PLAIN = 65534
ATTACKS = {
    # Reading.
    "open": "return open(SECRET).read()",
    "os.open": "return os.read(os.open(SECRET, os.O_RDONLY), 99)",
    "_io": "import _io\nreturn _io.FileIO(SECRET).readall()",
    "open of libc": "fd = libc.open(SECRET.encode(), 0)\nassert fd >= 0\nreturn fd",
    "openat2": "return call(437, -100, SECRET.encode(), struct.pack('QQQ', 0, 0, 0), 24)",
    "open_by_handle_at": "return call(304, -100, bytes(128), 0)",
    "environment of the parent": "return len(open(f'/proc/{os.getppid()}/environ', 'rb').read())",
    "own memory": "return os.open('/proc/self/mem', os.O_RDWR)",
    "symbolic link": "os.symlink(SECRET, SCRATCH + '/l')\nreturn open(SCRATCH + '/l').read()",
    "link in a directory that may be read": "return open(READABLE + '/link').read()",
    "way up": "return open(READABLE + '/../secret').read()",
    "listing": "return os.listdir(os.path.dirname(SECRET))",
    "sendfile": "return call(40, 1, 0, 0, 9)",
    "inotify": "return call(254, call(294, 0), SECRET.encode(), 1)",
    # Writing.
    "write": "open(VICTIM + '/new', 'w').write('x')\nreturn 1",
    "write below what may be read": "open(READABLE + '/file', 'a').write('x')\nreturn 1",
    "truncate without writing": "fd = libc.open((READABLE + '/file').encode(), 0o1000)\nassert fd >= 0\nreturn fd",
    "truncate": "os.truncate(VICTIM + '/file', 0)\nreturn 1",
    "unlink": "os.unlink(VICTIM + '/file')\nreturn 1",
    "rename out": "open(SCRATCH + '/a', 'w').close()\nos.rename(SCRATCH + '/a', VICTIM + '/a')\nreturn 1",
    "rename in": "os.rename(VICTIM + '/file', SCRATCH + '/b')\nreturn 1",
    "hard link": "os.link(SECRET, SCRATCH + '/c')\nreturn open(SCRATCH + '/c').read()",
    "mkdir": "os.mkdir(VICTIM + '/d')\nreturn 1",
    "mkfifo": "os.mkfifo(SCRATCH + '/f')\nreturn 1",
    "chmod": "os.chmod(VICTIM + '/file', 0o777)\nreturn 1",
    "chmod by number": "return call(90, (VICTIM + '/file').encode(), 0o777) + 1",
    "fchmodat2": "return call(452, -100, (VICTIM + '/file').encode(), 0o777, 0) + 1",
    "chown": "os.chown(VICTIM + '/file', 1, 1)\nreturn 1",
    "utime": "os.utime(VICTIM + '/file', (1, 1))\nreturn 1",
    "setxattr": "os.setxattr(READABLE + '/file', 'user.a', b'x')\nreturn 1",
    "flags of a file": "file = open(READABLE + '/file')\nreturn fcntl.ioctl(file, 0x40086602, struct.pack('l', 0x40)) or 1",
    "lock": "fcntl.flock(open(READABLE + '/file'), fcntl.LOCK_EX | fcntl.LOCK_NB)\nreturn 1",
    "input of a terminal": "return fcntl.ioctl(0, 0x5412, b'x') or 1",
    "record lock": "fcntl.lockf(open(READABLE + '/file'), fcntl.LOCK_SH | fcntl.LOCK_NB)\nreturn 1",
    # Processes and signals.
    "subprocess": "return subprocess.run(['/bin/true']).returncode",
    "posix_spawn": "return os.posix_spawn('/bin/true', ['true'], {})",
    "system": "done = os.system('exit 7')\nassert done == 7 << 8\nreturn done",
    "exec": "os.execv('/bin/true', ['true'])\nreturn 1",
    "execveat": "return call(322, -100, b'/bin/true', 0, 0, 0)",
    "fork": "return os.fork()",
    "fork of libc": "done = libc.fork()\nassert done >= 0\nreturn done",
    "vfork of the other numbers": "return call(0x40000000 + 57)",
    "clone3": "return call(435, bytes(64), 64)",
    "thread": "one = threading.Thread(target=lambda: 0)\none.start()\nreturn 1",
    "kill": "os.kill(os.getppid(), 0)\nreturn 1",
    "kill by number": "return call(62, os.getppid(), 0) + 1",
    "tgkill": "return call(234, os.getppid(), os.getppid(), 0) + 1",
    "pidfd": "return call(434, os.getppid(), 0)",
    "signals to an owner": "fcntl.fcntl(0, fcntl.F_SETOWN, os.getppid())\nreturn 1",
    "priority of the parent": "os.setpriority(os.PRIO_PROCESS, os.getppid(), 5)\nreturn 1",
    "processors of the parent": "os.sched_setaffinity(os.getppid(), {0})\nreturn 1",
    "ptrace": "return call(101, 16, os.getppid(), 0, 0) + 1",
    "memory of the parent": "return call(310, os.getppid(), 0, 0, 0, 0, 0) + 1",
    # Network and the kernel's other doors.
    "connect": "one = socket.socket()\none.connect(('127.0.0.1', int(PORT)))\nreturn 1",
    "UDP": "socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(b'x', ('127.0.0.1', int(PORT)))\nreturn 1",
    "unix socket": "return socket.socket(socket.AF_UNIX).fileno()",
    "socket by number": "return call(41, 2, 1, 0)",
    "io_uring": "return call(425, 4, bytes(256))",
    "unshare": "return call(272, 0x10000000) + 1",
    "mount": "return call(165, b'none', b'/mnt', b'tmpfs', 0, 0) + 1",
    "bpf": "return call(321, 0, bytes(64), 64)",
    "keyring": "return call(250, 0, -3, 1)",
    "memfd": "return os.memfd_create('x')",
    "shared memory": "return call(29, 0, 4096, 0o1600)",
    "perf": "return call(298, bytes(112), 0, -1, -1, 0)",
    # Limits.
    "limits of the parent": "return resource.prlimit(os.getppid(), resource.RLIMIT_NOFILE)",
    "more CPU time": "resource.setrlimit(resource.RLIMIT_CPU, (999, 999))\nreturn 1",
    "4 GiB": "return len(bytearray(4 << 30))",
    "4 GiB by number": "libc.mmap.restype = ctypes.c_long\nat = libc.mmap(None, ctypes.c_size_t(4 << 30), 3, 34, -1, 0)\n"
    "assert at != -1\nreturn at",
    "2 MiB in a file": "file = os.open(SCRATCH + '/big', os.O_CREAT | os.O_WRONLY)\n"
    "done = os.write(file, bytes(2 << 20))\nassert done == 2 << 20\nreturn done",
    "100 files": "some = [open(READABLE + '/file') for _ in range(100)]\nreturn len(some)",
    "other filters": "return call(157, 22, 2, 0) + 1",
}  # fmt: skip
# Reasons for which a program without end is ended; on a busy machine the clock comes before the limit.
SPENT, MUCH, WRITES = (f"{one}|longer than" for one in ("processor time", "larger", "writes more than|ended its"))
# Attacks that are played outside the sandbox as well, in a scratch directory of their own: each works there.
CONTROL = (
    "open", "os.open", "_io", "open of libc", "symbolic link", "link in a directory that may be read", "way up", "listing",
    "environment of the parent", "write", "write below what may be read", "truncate without writing", "truncate", "unlink",
    "rename out", "rename in", "hard link", "mkdir", "mkfifo", "chmod", "chmod by number", "utime", "lock", "record lock",
    "subprocess", "posix_spawn", "system", "thread", "kill", "kill by number", "connect", "UDP", "unix socket",
    "socket by number", "memfd", "limits of the parent", "2 MiB in a file", "100 files",
)  # fmt: skip
USERS = ["root", "user"] if os.geteuid() == 0 else ["user"]
pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or os.uname().machine != "x86_64", reason="there is a sandbox for Linux on x86-64 alone"
)


# The sandboxed process and its parent belong to the same user, who owns what is attacked.
AS_USER = f"""\
import ctypes, os, sys
import tests.support.attacked
from fogspec.base import sandbox
# Where only root may read this interpreter, what it needs is loaded before.
exec(tests.support.attacked.HEAD)
folders = sandbox.system_folders()
sandbox.system_folders = lambda: folders
if os.geteuid() == 0 and sys.argv[1] == "user":
    os.setgroups([])
    os.setgid({PLAIN})
    os.setuid({PLAIN})
    ctypes.CDLL(None).prctl(4, 1, 0, 0, 0)
if os.fork() == 0:
    sandbox.run("tests.support.attacked")
os.wait()
"""


def _attacked(at: Path, port: int) -> dict[str, str]:
    """Fill a directory with what is attacked, and return the names by which attacks find it."""
    for one in ("readable", "victim", "scratch"):
        (at / one).mkdir(parents=True)
        (at / one / "file").write_text("as it was")
        (at / one / "file").chmod(0o644)
    (at / "secret").write_text("only the user's")
    (at / "readable" / "link").symlink_to(at / "secret")
    return {"SECRET": f"{at}/secret", "VICTIM": f"{at}/victim", "READABLE": f"{at}/readable", "PORT": str(port)}


@pytest.fixture(scope="module")
def unconfined(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What each attack of the control came to outside the sandbox: in one process, each in a directory of its own."""
    folder, questions = tmp_path_factory.mktemp("unconfined"), []
    with socket.create_server(("127.0.0.1", 0)) as server:
        for i, name in enumerate(CONTROL):
            names = _attacked(folder / str(i), server.getsockname()[1])
            asked = {"attacks": {name: ATTACKS[name]}, "names": names, "scratch": f"{folder}/{i}/scratch"}
            questions.append(asked)
        play = "import json, sys; from tests.support.attacked import answer; "
        play += "print(json.dumps([answer(one) for one in json.load(sys.stdin)]))"
        done = subprocess.run(
            [sys.executable, "-c", play], input=json.dumps(questions), capture_output=True, text=True, cwd=REPOSITORY,
            check=True,
        )  # fmt: skip
    return {name: said for one in json.loads(done.stdout) for name, said in one.items()}


@pytest.mark.parametrize("name", CONTROL)
def test_an_attack_works_outside_the_sandbox(unconfined: dict[str, str], name: str) -> None:
    assert unconfined[name].startswith("broke out: "), unconfined[name]


@pytest.fixture(scope="module", params=USERS)
def outcomes(request: pytest.FixtureRequest) -> Iterator[tuple[dict[str, str], Path]]:
    """What each attack came to, in one sandboxed process, and the directory that it attacked."""
    with tempfile.TemporaryDirectory() as folder, socket.create_server(("127.0.0.1", 0)) as server:
        at = Path(folder)
        names = _attacked(at, server.getsockname()[1])
        if request.param == "user" and os.geteuid() == 0:
            for one in (at, *at.rglob("*")):
                os.chown(one, PLAIN, PLAIN, follow_symlinks=False)
        question = {"attacks": ATTACKS, "names": names}
        asked = {"questions": [question], "readable": [names["READABLE"]], "scratch": f"{at}/scratch", "trusted": False}
        done = subprocess.run(
            [sys.executable, "-c", AS_USER, request.param], input=json.dumps(asked), capture_output=True, text=True,
            cwd=REPOSITORY, check=False,
        )  # fmt: skip
        assert done.stdout.startswith("A"), done.stderr + done.stdout
        server.setblocking(False)
        with pytest.raises(BlockingIOError):
            server.accept()
        yield json.loads(done.stdout[1:]), at


@pytest.mark.parametrize("name", sorted(ATTACKS))
def test_an_attack_is_stopped(outcomes: tuple[dict[str, str], Path], name: str) -> None:
    said = outcomes[0][name]
    assert said.startswith("stopped: "), said
    assert "only the user's" not in said
    assert not any(
        word in said for word in ("SyntaxError", "NameError", "TypeError", "AttributeError", "IndentationError")
    ), said


def test_nothing_was_changed(outcomes: tuple[dict[str, str], Path]) -> None:
    at = outcomes[1]
    some = sorted(one.relative_to(at).as_posix() for one in at.rglob("*") if "scratch" not in one.parts)
    assert some == ["readable", "readable/file", "readable/link", "secret", "victim", "victim/file"]
    assert all((at / one / "file").read_text() == "as it was" for one in ("readable", "victim"))
    assert (at / "victim" / "file").stat().st_mode & 0o777 == 0o644


def _asked(body: str, readable: Path) -> Any:
    attacks = {"attacks": {"it": body}, "names": {"READABLE": str(readable)}}
    return json.loads(sandbox.ask("tests.support.attacked", [attacks], [str(readable)])[0])["it"]


def test_it_reads_what_it_may_read_and_writes_its_scratch(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("for it")
    assert _asked("return open(READABLE + '/file').read()", tmp_path) == "broke out: 'for it'"
    assert _asked(
        "open('small', 'w').write('x')\nreturn open('small').read(), dict(os.environ).get('HOME')", tmp_path
    ) == ("broke out: ('x', None)")


@pytest.mark.parametrize(
    ("body", "why"),
    [
        ("os._exit(0)", "ended its process"),
        ("ctypes.string_at(0)", "ended its process"),
        ("libc.abort()", "ended its process"),
        ("while True: pass", SPENT),
        ("for n in range(3, 64):\n try:\n  for _ in range(4000): os.write(n, bytes(1 << 20))\n except OSError: pass", MUCH),
        ("n = 0\nwhile True:\n n += 1\n open(str(n), 'w').write('x' * (1 << 20))", WRITES),
        ("some = []\nwhile True: some.append(bytes(1 << 24))", ""),
    ],
)  # fmt: skip
def test_a_program_without_end_or_measure_is_ended(tmp_path: Path, body: str, why: str) -> None:
    if not why:
        assert _asked(body, tmp_path).startswith("stopped: MemoryError")
        return
    with pytest.raises(sandbox.SandboxError, match=why):
        _asked(body, tmp_path)


def test_one_that_sleeps_is_ended_by_the_clock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sandbox, "WALL_SECONDS", 0.0)
    with pytest.raises(sandbox.SandboxError, match="longer than"):
        _asked("time.sleep(1000)", tmp_path)


@pytest.mark.parametrize("lacks", ["_landlock", "_seccomp"])
def test_without_a_layer_it_runs_only_if_it_is_trusted(
    tmp_path: Path, lacks: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sandboxed process itself is run here without a layer, by a program of its own."""
    start = (
        f"import sys; from fogspec.base import sandbox; sandbox.{lacks} = lambda *_: False; "
        "sandbox.run('tests.support.attacked')"
    )
    for trusted, said in ((False, b"Rthis machine lacks "), (True, b"A{")):
        scratch = tmp_path / said.decode()[0]
        scratch.mkdir()
        asked = {
            "questions": [{"attacks": {}, "names": {}}],
            "readable": [],
            "scratch": str(scratch),
            "trusted": trusted,
        }
        done = subprocess.run(
            [sys.executable, "-c", start],
            input=json.dumps(asked).encode(),
            capture_output=True,
            check=False,
            cwd=REPOSITORY,
        )
        assert done.stdout.startswith(said)


def test_the_attacks_are_programs() -> None:
    for body in ATTACKS.values():
        compile(f"{HEAD}def attack():\n    " + body.replace("\n", "\n    "), "attack", "exec")
