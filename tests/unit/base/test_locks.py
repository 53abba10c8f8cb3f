"""The application's lock, with real processes: who has it, who must wait, and what becomes of it when its holder dies."""

import fcntl
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from fogspec.base.errors import Busy, FogspecError, InvalidInput
from fogspec.base.layout import Layout
from fogspec.base.locks import application_lock, start_ticks

# Takes the lock by its own words, says so, and keeps it until its input ends.
HOLDER = """
import sys
from pathlib import Path
from fogspec.base.layout import Layout
from fogspec.base.locks import application_lock
with application_lock(Layout.of(Path(sys.argv[1]), "app"), "bench of app"):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def layout(tmp_path: Path) -> Layout:
    return Layout.of(tmp_path / "specs/app.yaml", "app")


@contextmanager
def holding(layout: Layout) -> Iterator["subprocess.Popen[str]"]:
    """Another process that holds the lock."""
    pipe = subprocess.PIPE
    words = [sys.executable, "-c", HOLDER, str(layout.spec)]
    with subprocess.Popen(words, stdin=pipe, stdout=pipe, text=True) as one:
        assert one.stdout is not None
        assert one.stdout.readline() == "held\n"
        yield one
        one.kill()


def free(path: Path) -> bool:
    """Whether the kernel would give the lock to this process, as `flock` sees it."""
    return subprocess.run(["flock", "--nonblock", str(path), "true"]).returncode == 0


def test_one_at_a_time_and_the_holder_is_named(layout: Layout) -> None:
    with holding(layout) as other:
        assert not free(layout.application_lock)
        with pytest.raises(Busy) as refused, application_lock(layout, "down of app"):
            raise AssertionError("it is held")
        here = os.uname().nodename
        assert refused.value.message == (
            f"down of app must wait: bench of app (process {other.pid} on {here}) has not ended"
        )
        assert "Ctrl-C" in refused.value.hints[0]


def test_a_killed_holder_leaves_a_lock_that_is_free(layout: Layout) -> None:
    with holding(layout) as other:
        other.send_signal(signal.SIGKILL)
        other.wait()
        assert layout.application_lock.read_bytes(), "it could not clean up"
        with application_lock(layout, "bench of app"):
            assert not free(layout.application_lock)
        assert free(layout.application_lock)


def test_the_file_says_who_has_it_and_nothing_after(layout: Layout) -> None:
    with application_lock(layout, "apply of app"):
        said = json.loads(layout.application_lock.read_text())
        started = subprocess.run(["ps", "-o", "lstart=", "-p", str(os.getpid())], capture_output=True, text=True).stdout
        assert (said["what"], said["pid"], said["host"]) == ("apply of app", os.getpid(), os.uname().nodename)
        assert said["start_ticks"] == start_ticks(os.getpid())
        assert started.strip(), "and that process is there"
    assert layout.application_lock.read_bytes() == b""
    with pytest.raises(ZeroDivisionError), application_lock(layout, "apply of app"):
        raise ZeroDivisionError
    assert layout.application_lock.read_bytes() == b"", "also after an error"
    assert free(layout.application_lock)


@pytest.mark.parametrize("kept", ["a long text of an earlier holder" * 9, "{}", "\x00", "[1]"])
def test_what_stands_in_the_file_decides_nothing(layout: Layout, kept: str) -> None:
    layout.application_lock.parent.mkdir(parents=True)
    layout.application_lock.write_text(kept)
    with application_lock(layout, "bench of app"):
        assert json.loads(layout.application_lock.read_text())["what"] == "bench of app"
    layout.application_lock.write_text(kept)
    with open(layout.application_lock) as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(Busy, match="another process has not ended"), application_lock(layout, "down of app"):
            pass


def test_with_remove_the_file_goes_and_otherwise_it_stays(layout: Layout) -> None:
    with application_lock(layout, "bench of app"):
        pass
    assert layout.application_lock.exists()
    with application_lock(layout, "down of app", remove=True):
        assert layout.application_lock.exists()
    assert not layout.application_lock.exists()
    with pytest.raises(ZeroDivisionError), application_lock(layout, "down of app", remove=True):
        raise ZeroDivisionError
    assert not layout.application_lock.exists()


def test_a_file_that_was_removed_meanwhile_is_no_lock(layout: Layout, monkeypatch: pytest.MonkeyPatch) -> None:
    # Between opening and locking, a `down` ends and removes the file: what is locked then must have the name.
    lock, calls = fcntl.flock, []

    def removed_once(file: object, how: int) -> None:
        if not calls:
            layout.application_lock.unlink()
        calls.append(how)
        lock(file, how)  # type: ignore[arg-type]

    monkeypatch.setattr(fcntl, "flock", removed_once)
    with application_lock(layout, "bench of app"):
        monkeypatch.undo()
        assert len(calls) == 2
        assert not free(layout.application_lock)


@pytest.mark.parametrize("make", [os.mkdir, os.mkfifo], ids=["folder", "pipe"])
def test_what_is_no_file_is_refused_and_not_waited_for(layout: Layout, make: object) -> None:
    layout.application_lock.parent.mkdir(parents=True)
    make(layout.application_lock)  # type: ignore[operator]
    wrong = pytest.raises(InvalidInput, match=r"lock: it is a (folder|pipe), not a file")
    with wrong, application_lock(layout, "bench of app"):
        pass


def test_a_link_is_no_lock_and_what_it_leads_to_stays_as_it_is(layout: Layout, tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("precious")
    layout.application_lock.parent.mkdir(parents=True)
    layout.application_lock.symlink_to(tmp_path / "mine")
    with pytest.raises(FogspecError), application_lock(layout, "bench of app"):
        pass
    assert (tmp_path / "mine").read_text() == "precious"


def test_a_full_disk_keeps_nobody_from_locking(layout: Layout, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    layout.application_lock.parent.mkdir(parents=True)
    with monkeypatch.context() as patched:
        patched.setattr(os, "write", full)
        with application_lock(layout, "bench of app"):
            assert not free(layout.application_lock)


def test_a_process_is_known_by_its_pid_and_its_start() -> None:
    with subprocess.Popen(["sleep", "60"]) as one:
        fields = Path(f"/proc/{one.pid}/stat").read_text().rsplit(")", 1)[1].split()
        assert start_ticks(one.pid) == int(fields[22 - 3]), "field 22 of proc(5)"
        one.kill()
        os.waitid(os.P_PID, one.pid, os.WEXITED | os.WNOWAIT)
        assert start_ticks(one.pid) is None, "a zombie runs no more"
    assert start_ticks(one.pid) is None
    assert start_ticks(2**22 + 1) is None
