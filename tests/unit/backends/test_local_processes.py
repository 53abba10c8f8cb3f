"""Processes by their environment: one that is in exec, which has none for a moment, is not missed."""

import sys
from pathlib import Path

import pytest

from fogspec.agent import processes as agent
from fogspec.backends.local import processes


def process(folder: Path, pid: int, environ: bytes, cmdline: bytes = b"", state: str = "R", flags: int = 0) -> None:
    (folder / str(pid)).mkdir(parents=True)
    (folder / str(pid) / "environ").write_bytes(environ)
    (folder / str(pid) / "cmdline").write_bytes(cmdline)
    (folder / str(pid) / "stat").write_text(f"{pid} (a (b) c) {state} 1 1 1 0 -1 {flags} 0 0\n")


def test_a_process_in_exec_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the kernel shows it: no environment, no arguments, until the new program has both."""
    process(tmp_path, 10, b"A=1\0B=2", b"sleep")
    process(tmp_path, 11, b"")
    slept = list[float]()

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        if len(slept) == 2:
            (tmp_path / "11" / "environ").write_bytes(b"JOB=it")

    monkeypatch.setattr(processes, "PROC", str(tmp_path))
    monkeypatch.setattr(processes.time, "sleep", sleep)
    assert dict(processes.environments()) == {10: [b"A=1", b"B=2"], 11: [b"JOB=it"]}
    assert len(slept) == 2


def test_what_never_has_an_environment_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    process(tmp_path, 2, b"", flags=0x00200000 | 0x40)  # the kernel's
    process(tmp_path, 12, b"", state="Z")
    process(tmp_path, 13, b"", cmdline=b"env\0-i\0")
    (tmp_path / "14").mkdir()  # it has ended meanwhile
    monkeypatch.setattr(processes, "PROC", str(tmp_path))
    monkeypatch.setattr(processes.time, "sleep", lambda _: pytest.fail("it waits"))
    assert dict(processes.environments()) == {}


def test_nodes_get_the_python3_of_the_user_s_shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = str(Path(sys.executable).parent)
    monkeypatch.setenv("PATH", f"{tmp_path}::relative:/usr/bin")
    found = processes.equipped({"A": "1"}, tmp_path)
    assert found == {
        "A": "1", "PATH": f"{tmp_path}:/usr/bin:{own}", "FOGSPEC_OUT": str(tmp_path), "FOGSPEC_PYTHON": sys.executable,
    }  # fmt: skip
    monkeypatch.delenv("PATH")
    assert processes.equipped({}, tmp_path)["PATH"].split(":")[-1] == own
    assert agent.apart(["python3", "-m", "fogspec_agent.topics"])[0] == sys.executable
    assert agent.apart(["python3", "node.py"]) == ["python3", "node.py"]
