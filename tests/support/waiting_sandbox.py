"""The process behind `tests.support.sandboxed`: it has the reader of launch files loaded, and forks for each question.

It imports what the real one imports and no more, for a launch file would see it.
"""

import array
import importlib
import json
import os
import socket
import sys

from fogspec.base import sandbox


def wait(parent: socket.socket, module: str) -> None:
    """Fork for each message, be a sandbox there, and report its process and how it ended; until the parent is gone."""
    importlib.import_module(module)
    while True:
        said, passed, *_ = parent.recvmsg(1 << 16, socket.CMSG_SPACE(8))
        if not said:
            return
        files = array.array("i", passed[0][2])
        process = os.fork()
        if process == 0:
            os.setsid()
            parent.close()
            for number, file in enumerate(files):
                os.dup2(file, number)
                os.close(file)
            folder, limits = json.loads(said)
            os.chdir(folder)
            sandbox.LIMITS.update({int(kind): most for kind, most in limits.items()})
            sandbox.run(module)
        for file in files:
            os.close(file)
        parent.sendall(process.to_bytes(8, "big"))
        code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        parent.sendall(code.to_bytes(8, "big", signed=True))


if __name__ == "__main__":
    wait(socket.socket(fileno=int(sys.argv[1])), sys.argv[2])
