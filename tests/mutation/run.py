"""Mutation testing of what guards money, machines and files: `python -m tests.mutation.run [--count N] [--seed N] [MODULE …]`.

A mutant is one small change of one module (`mutants.py`). It is killed when a test of its module fails, and survives otherwise.
`modules.toml` lists the modules with their tests, `survivors.toml` the survivors that were looked at, with a reason each. The
command fails for a survivor without a reason, and for a reason that no mutant has any more.
"""

import argparse
import contextlib
import hashlib
import multiprocessing
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue

from tests.mutation.mutants import Mutant, mutants

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).parent
AT_ONCE = 2
# Imported once, for all mutants: nothing of fogspec, which each of them imports anew.
PRELOAD = [
    "pytest",
    "hypothesis",
    "numpy",
    "scipy.optimize",
    "scipy.linalg",
    "pydantic",
    "ruamel.yaml",
    "click",
    "jinja2",
    "rich",
]
CONTEXT = multiprocessing.get_context("forkserver")


def copy_of(root: Path) -> Path:
    """Copy the files that git knows to a new directory: nothing of a mutant can stay in the checkout."""
    copy = Path(tempfile.mkdtemp(prefix="fogspec-mutation-"))
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=root, check=True, capture_output=True).stdout
    for name in filter(None, listed.decode().split("\0")):
        if (root / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(root / name, copy / name)
    return copy


def _tests(folder: Path, tests: Sequence[str], limit_s: float) -> None:
    """Run tests on the copy in `folder`, in a process of their own; its exit code is pytest's."""
    os.setsid()
    # A mutant may turn in a circle, and must end also when nobody is left to kill it.
    resource.setrlimit(resource.RLIMIT_CPU, (int(limit_s) + 1, int(limit_s) + 1))
    os.chdir(folder)
    os.environ["PYTHONPATH"] = str(folder)
    for name in [name for name in sys.modules if name.partition(".")[0] in ("tests", "fogspec")]:
        del sys.modules[name]
    sys.path[:] = [str(folder), *(one for one in sys.path if Path(one or ".").resolve() != ROOT)]
    silent = os.open(os.devnull, os.O_RDWR)
    for number in range(3):
        os.dup2(silent, number)
    import pytest

    os._exit(int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", *tests])))


def outcome(folder: Path, tests: Sequence[str], limit_s: float) -> int | None:
    """Return the exit code of the tests; None if they took too long."""
    process = CONTEXT.Process(target=_tests, args=(folder, tests, limit_s))
    process.start()
    process.join(limit_s)
    code = process.exitcode
    for pid in filter(None, [process.pid]):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(pid, signal.SIGKILL)
    process.join()
    return code


def survives(mutant: Mutant, folder: Path, tests: Sequence[str], limit_s: float) -> bool:
    """Return whether no test notices the change."""
    path = folder / mutant.module
    before, times = path.read_bytes(), path.stat()
    path.write_bytes(mutant.source(before))
    try:
        return outcome(folder, tests, limit_s) == 0
    finally:
        path.write_bytes(before)
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


def sample(every: Mapping[str, Sequence[Mutant]], count: int, seed: int) -> list[Mutant]:
    """Return `count` of all mutants, from each module in proportion and at least five.

    Each mutant has its own lot, so that a change of the source draws no others.
    """
    total, found = sum(map(len, every.values())), list[Mutant]()
    for own in every.values():
        drawn = sorted(own, key=lambda one: hashlib.sha256(repr((seed, one.key)).encode()).digest())
        found += drawn[: max(5, round(count * len(own) / total))]
    return found


def main() -> int:
    """Print the figures and the survivors; 1 for one without a reason."""
    words = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    words.add_argument("modules", nargs="*", help="only modules whose path contains one of these")
    words.add_argument("--count", type=int, default=240, help="how many mutants, 0 for all")
    words.add_argument("--seed", type=int, default=16)
    chosen = words.parse_args()
    listed = tomllib.loads((HERE / "modules.toml").read_text("utf-8"))["modules"]
    known = {
        _key(one): one["reason"] for one in tomllib.loads((HERE / "survivors.toml").read_text("utf-8"))["survivors"]
    }
    every = {
        name: mutants(ROOT, name)
        for name in listed
        if not chosen.modules or any(word in name for word in chosen.modules)
    }
    CONTEXT.set_forkserver_preload(PRELOAD)
    copies: SimpleQueue[Path] = SimpleQueue()
    folders = [copy_of(ROOT) for _ in range(AT_ONCE)]
    for folder in folders:
        copies.put(folder)
    limits_s: dict[str, float] = {}

    def on_a_copy(do, *rest):  # type: ignore[no-untyped-def]
        folder = copies.get()
        try:
            return do(folder, *rest)
        finally:
            copies.put(folder)

    def sound(folder: Path, name: str) -> tuple[str, int | None]:
        start = time.monotonic()
        code = outcome(folder, listed[name], 600)
        limits_s[name] = 15 + 3 * (time.monotonic() - start)
        return name, code

    def tried(folder: Path, mutant: Mutant) -> tuple[Mutant, bool]:
        alive = survives(mutant, folder, listed[mutant.module], limits_s[mutant.module])
        if alive and mutant.key not in known:
            print(_entry(mutant), flush=True)
        return mutant, alive

    start = time.monotonic()
    try:
        with ThreadPoolExecutor(AT_ONCE) as pool:
            unsound = {n: code for n, code in pool.map(lambda name: on_a_copy(sound, name), every) if code != 0}
            if unsound:
                print(f"tests fail without any change: {unsound}")
                return 2
            picked = sample(every, chosen.count or 10**9, chosen.seed)
            results = list(pool.map(lambda mutant: on_a_copy(tried, mutant), picked))
    finally:
        for folder in folders:
            shutil.rmtree(folder, ignore_errors=True)
    alive = [mutant for mutant, survived in results if survived]
    unexplained = [mutant for mutant in alive if mutant.key not in known]
    for name, own in every.items():
        mine = [survived for mutant, survived in results if mutant.module == name]
        print(f"{name:<45}{len(own):>6}{len(mine):>6}{sum(mine):>6}")
    print(
        f"mutants {sum(map(len, every.values()))}, tried {len(results)}, alive {len(alive)}, unexplained {len(unexplained)}"
    )
    print(f"seed {chosen.seed}, {time.monotonic() - start:.0f} s")
    keys = {mutant.key for own in every.values() for mutant in own}
    stale = [key for key in known if key[0] in every and key not in keys]
    for key in stale:
        print(f"survivors.toml explains what no mutant is any more: {key}")
    return 1 if unexplained or stale else 0


def _key(entry: dict[str, object]) -> tuple[object, ...]:
    return (entry["module"], entry["in"], entry["was"], entry["now"], entry.get("nth", 1))


def _entry(mutant: Mutant) -> str:
    """The survivor as `survivors.toml` has it, without the reason."""
    import json

    text = "[[survivors]]\n" + "".join(
        f"{name} = {json.dumps(value, ensure_ascii=False)}\n"
        for name, value in (("module", mutant.module), ("in", mutant.where), ("was", mutant.was), ("now", mutant.now))
    )
    return text + (f"nth = {mutant.nth}\n" if mutant.nth > 1 else "") + 'reason = ""\n'


if __name__ == "__main__":
    sys.exit(main())
