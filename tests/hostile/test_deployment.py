"""A deployed node that writes what it likes where we read: it is seen and ended all the same, in bounded time and memory."""

import contextlib
import json
import os
import resource
import subprocess
from pathlib import Path

import pytest

from tests.support.deployed import MANIFEST, Deployed, app, tiny  # noqa: F401
from tests.support.scenes import until

TERABYTE = 2**40
FILES = (
    "out/state.json",
    "out/timings.jsonl",
    "out/timings.1.jsonl",
    "out/link.pub",
    "run.log",
    "manifest.yaml",
    "group",
)
GARBAGE = {
    "binary": bytes(range(256)) * 99,
    "deep": b"[" * 99_999,
    "overflow": b'{"name": "work", "latency_s": 1e200, "ok": true, "state": 1e999, "ready_s": NaN}\n' * 99,
    "a path": b"/sys/fs/cgroup",
}
KINDS = [*GARBAGE, "a pipe", "a device", "a folder", "a terabyte"]
PATIENCE_S = 1200.0  # bounds a hang; the commands take seconds


def place(kind: str, path: Path) -> None:
    """Put it where the file was, as a node of the same user can; the node may write the file again meanwhile."""
    for _ in range(1000):
        path.unlink(missing_ok=True)
        with contextlib.suppress(FileExistsError):
            return make(kind, path)
    raise TimeoutError(path)


def make(kind: str, path: Path) -> None:
    if kind in GARBAGE:
        path.write_bytes(GARBAGE[kind])
    elif kind == "a pipe":
        os.mkfifo(path)
    elif kind == "a device":
        path.symlink_to("/dev/zero")
    elif kind == "a folder":
        path.mkdir()
    else:
        with open(path, "wb") as file:
            file.truncate(TERABYTE)


def bounded(tiny: Deployed, *words: str) -> "subprocess.CompletedProcess[str]":
    """Run a command with a gigabyte of memory, and not forever."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_DATA, (2**30, 2**30))

    ended = subprocess.run(
        tiny.command(*words), cwd=tiny.folder, capture_output=True, text=True, timeout=PATIENCE_S, preexec_fn=limit,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    assert "Traceback" not in ended.stderr, ended.stderr
    return ended


def spoil(tiny: Deployed, shift: int) -> str:
    """Put another kind of garbage in the place of each file of the one machine; return its name."""
    (name,) = tiny.names()
    for number, file in enumerate(FILES):
        place(KINDS[(3 * number + shift) % len(KINDS)], tiny.state / "deployed" / name / file)
    return name


@pytest.mark.slow
@pytest.mark.parametrize("shift", range(0, len(KINDS), 2))
def test_what_a_node_writes_hides_nothing_and_keeps_nothing_running(tiny: Deployed, shift: int) -> None:
    tiny.apply()
    name = spoil(tiny, shift)
    shown = bounded(tiny, "status", "-o", "json")
    assert shown.returncode in (0, 3), shown
    assert json.loads(shown.stdout)[0]["deployment"]["machines"][0]["name"] == name
    if shift == 0:
        updated = bounded(tiny, "apply", MANIFEST, "--yes")
        assert updated.returncode == 0, updated
    ended = bounded(tiny, "down", "tiny")
    assert ended.returncode == 0, ended
    assert "1 ended" in ended.stdout
    until(lambda: tiny.alive() == [])
    assert tiny.left() == []


@pytest.mark.slow
def test_the_supervisor_waits_for_no_pipe(tiny: Deployed) -> None:
    """It goes on reporting, and ends when it is asked to."""
    tiny.apply()
    (name,) = tiny.names()
    out = tiny.state / "deployed" / name / "out"
    for file in ("link.pub", "state.part", "timings.jsonl", "timings.1.jsonl"):
        place("a pipe", out / file)
    (out / "state.json").unlink()
    until(lambda: (out / "state.json").is_file())
    assert json.loads((out / "state.json").read_text())["state"] in ("starting", "ready")
    assert "1 ended" in tiny("down", "tiny").stdout
