"""Start an unmodified node with the timing library in its process: any language, any middleware, nothing in the graph.

    python3 agent.pyz preload --service /plan -- ros2 run planner planner_node

It compiles preload.c next to the timings, once, and replaces itself by the command with the library in LD_PRELOAD. Names
are those of the graph, after remapping. It needs a C compiler.
"""

import argparse
import fcntl
import os
import pkgutil
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

COMPILE_S = 120.0
SOURCES = ("preload.c", "preload.h")
NEEDED = "install gcc and libc6-dev there, or measure with spec.probe.via: rclpy"


def main(arguments: Sequence[str] | None = None) -> None:
    """Replace this process by the command."""
    parser = argparse.ArgumentParser(prog="preload", allow_abbrev=False)
    for name in ("service", "action", "request", "response"):
        parser.add_argument(f"--{name}")
    parser.add_argument("--match", choices=("stamp", "order"), default="stamp")
    parser.add_argument("--optional", action="store_true", help="start the command in any case, timed or not")
    words = list(sys.argv[1:] if arguments is None else arguments)
    if "--" not in words[:-1]:
        parser.parse_args(words)
        parser.error("the command must follow after --")
    separator = words.index("--")
    options, command = parser.parse_args(words[:separator]), words[separator + 1 :]
    environment = dict(os.environ)
    for name in ("service", "action", "request", "response"):
        if getattr(options, name):
            environment[f"FOGSPEC_PRELOAD_{name.upper()}"] = getattr(options, name)
    if options.request and options.match == "stamp":
        environment["FOGSPEC_STAMPED"] = "1"
    if "FOGSPEC_TIMINGS" in environment:
        try:
            library = compiled_library(Path(environment["FOGSPEC_TIMINGS"]).parent)
            environment["LD_PRELOAD"] = ":".join(filter(None, [environment.get("LD_PRELOAD"), str(library)]))
        except (SystemExit, OSError) as problem:
            if not options.optional:
                sys.exit(str(problem))
            print(f"fogspec: requests are not timed: {problem}", file=sys.stderr, flush=True)
    try:
        os.execvpe(command[0], command, environment)  # noqa: S606
    except OSError as problem:
        sys.exit(f"{command[0]} cannot be started: {problem.strerror}")


def compiled_library(directory: Path) -> Path:
    """Return the library in `directory`, compiled for this machine; exit with the reason if it cannot be compiled."""
    library = directory / "libfogspec_preload.so"
    with open(directory / "preload.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # several nodes may start at the same time
        if library.exists():
            return library
        compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
        if compiler is None:
            sys.exit(f"the measured machine has no C compiler: {NEEDED}")
        with tempfile.TemporaryDirectory(dir=directory) as private:
            write_sources(Path(private))
            new = Path(private) / library.name
            source = Path(private) / SOURCES[0]
            words = [compiler, "-O2", "-shared", "-fPIC", "-o", str(new), str(source), "-ldl", "-lpthread"]
            try:
                subprocess.run(words, check=True, capture_output=True, text=True, timeout=COMPILE_S)
            except subprocess.SubprocessError as problem:
                reasons = str(getattr(problem, "stderr", None) or problem).strip().splitlines()
                reason = reasons[0] if reasons else "no reason"
                sys.exit(f"{compiler} cannot compile the timing library ({reason}): {NEEDED}")
            os.replace(new, library)
    return library


def write_sources(directory: Path) -> None:
    """Write the library's sources, which may be inside a zip application, to `directory`."""
    for name in SOURCES:
        content = pkgutil.get_data(__package__ or "", name)
        if content is None:
            raise FileNotFoundError(name)
        (directory / name).write_bytes(content)


if __name__ == "__main__":
    main()
