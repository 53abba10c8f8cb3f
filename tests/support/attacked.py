"""A sandboxed module that attacks: each attack is a function's body, which returns if it broke out."""

import textwrap
from typing import Any

HEAD = """\
import array, ctypes, fcntl, io, mmap, os, posix, resource, signal, socket, struct, subprocess, threading, time
libc = ctypes.CDLL(None, use_errno=True)
def call(number, *args):
    done = libc.syscall(number, *args)
    if done < 0:
        raise OSError(ctypes.get_errno(), "refused")
    return done
"""


def answer(question: dict[str, Any]) -> dict[str, str]:
    """Return for each attack whether it broke out, or what stopped it."""
    return {
        name: _played(body, question["names"] | {"SCRATCH": question["scratch"]})
        for name, body in question["attacks"].items()
    }


def _played(body: str, given: dict[str, str]) -> str:
    names: dict[str, Any] = dict(given)
    try:
        exec(f"{HEAD}def attack():\n{textwrap.indent(body, '    ')}", names)
        return f"broke out: {names['attack']()!r}"
    except BaseException as problem:
        return f"stopped: {type(problem).__name__}: {problem}"
