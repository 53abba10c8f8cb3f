"""The program `fogspec` for the scripts of a test: a folder for their PATH, whose program begins with everything loaded.

A page or a step of the Action starts it again and again, and six sevenths of each start are imports. A process that has them
waits for words, directory, environment and files, and forks. What starting does is told by the tests of the wheel, of a
stranger and of a folder full of traps.
"""

import array
import atexit
import contextlib
import functools
import json
import os
import select
import socket
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NoReturn

from fogspec.cli import main
from tests.support.forking import become, load

# It passes on what asks it to end, and ends as what it stands for.
PROGRAM = """\
#!/usr/bin/env -S "{python}" -IS
import array, json, os, signal, socket, sys
one = socket.socket(socket.AF_UNIX)
one.connect({place!r})
said = json.dumps([sys.argv[1:], os.getcwd(), dict(os.environ)]).encode()
one.sendmsg([len(said).to_bytes(8, "big")], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", [0, 1, 2]))])
one.sendall(said)
child = int.from_bytes(one.recv(8), "big")
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, lambda number, _: os.kill(child, number))
code = int.from_bytes(one.recv(8), "big", signed=True)
if code < 0:
    signal.signal(-code, signal.SIG_DFL)
    os.kill(os.getpid(), -code)
os._exit(code)
"""


@functools.cache
def programs() -> Path:
    """Start the process that waits, and ends with this one; return the folder of its program."""
    folder = Path(tempfile.mkdtemp(prefix="loaded-"))
    program, place = folder / "fogspec", str(folder / "socket")
    program.write_text(PROGRAM.format(python=sys.executable, place=place))
    program.chmod(0o755)
    ours, theirs = socket.socketpair()
    waiting = subprocess.Popen(
        [sys.executable, "-m", "tests.support.loaded", place], cwd=Path(__file__).parents[2], stdin=theirs,
        stdout=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    theirs.close()
    atexit.register(waiting.wait)
    atexit.register(ours.close)  # before it
    assert ours.recv(1) == b"."
    return folder


def wait_for(place: str) -> None:
    """Fork for each program that connects, until standard input ends."""
    load()
    with socket.socket(fileno=0) as parent, socket.socket(socket.AF_UNIX) as listening:
        listening.bind(place)
        listening.listen(100)
        parent.send(b".")
        while parent not in select.select([parent, listening], [], [])[0]:
            one, _ = listening.accept()
            if os.fork() == 0:
                stand_for(one)
            one.close()
            with contextlib.suppress(ChildProcessError):
                while os.waitpid(-1, os.WNOHANG)[0]:
                    pass


def stand_for(program: socket.socket) -> NoReturn:
    """Run what a program was asked for, and tell it how that ended."""
    length, ((_, _, passed),), *_ = program.recvmsg(8, socket.CMSG_SPACE(12))
    files, said = array.array("i", passed), b""
    while len(said) < int.from_bytes(length, "big"):
        said += program.recv(1 << 20)
    words, folder, environment = json.loads(said)
    child = os.fork()
    if child == 0:
        os.environ.clear()
        os.environ.update(environment)
        become(Path(folder), lambda: main(words), files)
    for file in files:
        os.close(file)
    program.sendall(child.to_bytes(8, "big"))
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    program.sendall(code.to_bytes(8, "big", signed=True))
    os._exit(0)


if __name__ == "__main__":
    wait_for(sys.argv[1])
