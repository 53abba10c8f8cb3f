"""Starts an unmodified node with the timing library in its process: any language, any middleware, nothing in the graph.

    python3 -m fogspec_machine.preload --service /plan -- ros2 run planner planner_node

It compiles preload.c beside the timings, once, and becomes the command, with the library in its LD_PRELOAD. Names
are those of the graph, after remapping. Standard library only; needs a C compiler.
"""

import argparse
import fcntl
import os
import shutil
import subprocess
import sys
from pathlib import Path

COMPILE_S = 120.0
NEEDED = "install gcc and libc6-dev there, or measure with spec.probe.via: rclpy"


def main(arguments: list[str] | None = None) -> None:
    """Become the command."""
    parser = argparse.ArgumentParser(prog="preload", allow_abbrev=False)
    for name in ("service", "action", "request", "response"):
        parser.add_argument(f"--{name}")
    parser.add_argument("--match", choices=("stamp", "order"), default="stamp")
    parser.add_argument("--optional", action="store_true", help="start the command in any case, timed or not")
    words = sys.argv[1:] if arguments is None else arguments
    if "--" not in words[:-1]:
        parser.error("the command must follow after --")
    options, command = parser.parse_args(words[: words.index("--")]), words[words.index("--") + 1 :]
    environment = dict(os.environ)
    for name in ("service", "action", "request", "response"):
        if getattr(options, name):
            environment[f"FOGSPEC_PRELOAD_{name.upper()}"] = getattr(options, name)
    if options.request and options.match == "stamp":
        environment["FOGSPEC_STAMPED"] = "1"
    if "FOGSPEC_TIMINGS" in environment:
        try:
            library = compiled(Path(environment["FOGSPEC_TIMINGS"]).parent)
            environment["LD_PRELOAD"] = ":".join(filter(None, [environment.get("LD_PRELOAD"), str(library)]))
        except (SystemExit, OSError) as problem:
            if not options.optional:
                sys.exit(str(problem))
            print(f"fogspec: requests are not timed: {problem}", file=sys.stderr, flush=True)
    try:
        os.execvpe(command[0], command, environment)  # noqa: S606
    except OSError as problem:
        sys.exit(f"{command[0]} cannot be started: {problem.strerror}")


def compiled(folder: Path) -> Path:
    """The library, compiled for this machine; ends the process with a reason when that cannot be done."""
    library, source = folder / "libfogspec_preload.so", Path(__file__).with_suffix(".c")
    with open(folder / "preload.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # several nodes may start at the same time
        if library.exists():
            return library
        compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
        if compiler is None:
            sys.exit(f"the measured machine has no C compiler: {NEEDED}")
        new = folder / "libfogspec_preload.new"
        words = [compiler, "-O2", "-shared", "-fPIC", "-o", str(new), str(source), "-ldl", "-lpthread"]
        try:
            subprocess.run(words, check=True, capture_output=True, text=True, timeout=COMPILE_S)
        except subprocess.SubprocessError as problem:
            said = str(getattr(problem, "stderr", None) or problem).strip().splitlines()
            sys.exit(f"{compiler} cannot compile the timing library ({said[0] if said else 'no reason'}): {NEEDED}")
        os.replace(new, library)
    return library


if __name__ == "__main__":
    main()
