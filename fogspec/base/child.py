"""Starting programs that are fogspec's own: nothing of the working folder is run, imported or configured by it.

A checkout is written by others, and what runs in it by accident runs with the user's credentials. So each of our programs
starts in `ELSEWHERE`, is found by an absolute entry of PATH, and an interpreter of ours starts isolated.
"""

import errno
import os
import site
import sys
from pathlib import Path

import fogspec

ELSEWHERE = "/"  # Only root writes there, and it stays: what a child leaves running may outlive the checkout.
SEARCHED = ("PATH", "PYTHONPATH", "LD_LIBRARY_PATH")
NO_HOME = os.devnull  # A file: nothing is found or written below it, by root neither.
THREADS = "OPENBLAS_NUM_THREADS"
_own: set[str] = set()  # variables that are this process's alone
# Isolated (-I), an interpreter ignores the working folder, PYTHON* and the user's packages. Folders that come after all others
# can hide no module: that of this fogspec, which may be an editable install, and the user's packages where they are in use.
START = "import runpy, sys; _, name, count, *rest = sys.argv; sys.argv[1:] = rest[int(count) :]; "
START += "sys.path += rest[: int(count)]; "
START += "runpy.run_module(name, run_name='__main__', alter_sys=True)"


def python(module: str, *words: str) -> list[str]:
    """Return the command that runs a module with these arguments in an isolated interpreter."""
    folders = _own_folders()
    return [sys.executable, "-I", "-c", START, module, str(len(folders)), *folders, *words]


def program(name: str) -> str:
    """Return the path of a program, by the absolute entries of PATH; raise FileNotFoundError if there is none."""
    if os.path.isabs(name):
        return name
    for folder in _absolute(os.environ.get("PATH", os.defpath)):
        path = os.path.join(folder, name)
        if os.path.isfile(path) and os.access(path, os.X_OK):
            return path
    raise FileNotFoundError(errno.ENOENT, "it is in none of the absolute folders of PATH", name)


def environment(**more: str) -> dict[str, str]:
    """Return this process's environment without search paths that depend on the working folder, and with `more`.

    Variables that this process set for itself alone are left out.
    """
    absolute = {name: os.pathsep.join(_absolute(os.environ[name])) for name in SEARCHED if name in os.environ}
    # An empty path would be the working folder again.
    inherited = {name: value for name, value in os.environ.items() if name not in _own}
    return {**inherited, **{name: path or ELSEWHERE for name, path in absolute.items()}, **more}


def use_one_thread() -> None:
    """Let numpy, which reads this when it is imported, use one thread, unless the user has set another number.

    With a thread for each CPU, sums depend on the machine; and tables are so small that the threads wait, busily. Programs
    that are started do not get the variable: a measured one is to use the CPUs that it has.
    """
    if THREADS not in os.environ:
        os.environ[THREADS] = "1"
        _own.add(THREADS)


def leave_working_folder() -> None:
    """Import nothing from the working folder from now on: `python -m` and an empty entry of PYTHONPATH put it first."""
    try:
        here = os.path.realpath(os.getcwd())
    except OSError:
        here = ""
    own = _own_folders()[0]
    others = [one for one in sys.path if os.path.isabs(one) and os.path.realpath(one) != here]
    # Who develops fogspec stands in its own folder.
    sys.path[:] = [*others, own] if os.path.realpath(own) == here else others


def without_home() -> None:
    """Give a user who has neither HOME nor a name a home in which nothing is: `~` would be a folder of the checkout."""
    if not os.path.isabs(os.path.expanduser("~")):
        os.environ["HOME"] = NO_HOME


def _own_folders() -> list[str]:
    own = str(Path(fogspec.__file__).absolute().parents[1])
    return [own, site.getusersitepackages()] if site.ENABLE_USER_SITE else [own]


def _absolute(path: str) -> list[str]:
    return [entry for entry in path.split(os.pathsep) if os.path.isabs(entry)]
