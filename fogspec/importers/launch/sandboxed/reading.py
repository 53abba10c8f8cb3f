"""The sandboxed process's answer: what a launch file starts, and what of it is not taken over."""

# What launch files commonly import is loaded before the sandbox closes.
import collections  # noqa: F401
import copy  # noqa: F401
import functools  # noqa: F401
import getpass  # noqa: F401
import glob  # noqa: F401
import inspect  # noqa: F401
import itertools  # noqa: F401
import logging  # noqa: F401
import math  # noqa: F401
import multiprocessing  # noqa: F401
import os
import pathlib  # noqa: F401
import platform  # noqa: F401
import shlex  # noqa: F401
import shutil  # noqa: F401
import socket  # noqa: F401
import subprocess  # noqa: F401
import sys
import tempfile
import textwrap  # noqa: F401
import xml.dom.minidom
import xml.etree.ElementTree  # noqa: F401
from dataclasses import asdict
from typing import Any

import yaml  # noqa: F401

from fogspec.importers.launch.sandboxed import actions, context, fogros, frontend, made, modules, nodes, paths  # noqa: F401
from fogspec.importers.launch.sandboxed.values import CURRENT, NOTES, Fatal, Place, Stop, check, plain

PROCESSES = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "os.forkpty", "pty.spawn")
SIGNALS = ("os.kill", "os.killpg", "signal.pthread_kill")
DEEPEST_CALLS = 600


def answer(question: Any) -> dict[str, Any]:
    """Play a launch file, and return what it starts.

    The question has its `file` and `arguments`, the folders of `packages`, where others are `installed`, the `root` below which
    the file sees them, and the `distro`.
    """
    scratch = tempfile.tempdir = question["scratch"]
    setattr(tempfile, "_name_sequence", paths.Names())  # noqa: B010
    paths.lay_out(question["root"])
    paths.FOLDERS.update(question["packages"])
    paths.INSTALLED[:] = question["installed"]
    paths.FREE[:] = [os.path.dirname(question["file"]), scratch]
    context.DISTRO[0] = question["distro"]
    os.environ = context.Environ({**context.BASE, "ROS_DISTRO": question["distro"]})  # type: ignore[assignment]  # noqa: B003
    setattr(os, "getenv", os.environ.get)  # noqa: B010
    context.CONTEXT.launch_configurations.update(question["arguments"])
    modules.install()
    paths.install()
    sys.addaudithook(_say)
    sys.argv = ["launch"]
    sys.setrecursionlimit(DEEPEST_CALLS)
    CURRENT[0] = question["file"]
    failed: tuple[str, Place, str | None] | None = None
    try:
        actions.play(question["file"], (question["file"], 1, 1, 1))
        while actions.LATER:
            made.visit(actions.LATER.pop(0))
        nodes.load()
        nodes.activated()
        check()
    except Fatal as problem:
        failed = problem.why, problem.place, problem.fix
    notes = [[*place, plain(message)] for place, message in NOTES]
    return {**asdict(context.FOUND), "notes": notes, "failed": failed}


def _say(event: str, _: tuple[Any, ...]) -> None:
    """Stop a launch file with a reason where the kernel would refuse without one. This layer is for messages alone."""
    if event in PROCESSES:
        raise Stop("it starts a process, and a launch file is only read")
    if event in SIGNALS:
        raise Stop("it sends a signal, and a launch file is only read")
    if event in ("socket.connect", "socket.bind", "socket.__new__", "socket.getaddrinfo"):
        raise Stop("it uses the network, and a launch file is only read")
