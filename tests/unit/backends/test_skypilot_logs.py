"""Files out of a job's log, whatever the machine wrote into it."""

import json
import random
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogspec.backends.protocol import Partial
from fogspec.backends.skypilot import logs
from fogspec.backends.skypilot.logs import LogTail
from fogspec.base.project_files import ProjectFiles

PREFIX = b"\x1b[36m(my-task, pid=123)\x1b[0m "
TIMING = b'{"name": "work", "start_s": 1.0, "latency_s": 0.2, "ok": true}\n'


def printed(name: str, content: bytes, prefix: bytes = PREFIX, whole: bool = True) -> bytes:
    lines = [f"=== fogspec begin {name} ===\n".encode(), *content.splitlines(keepends=True)]
    lines += [f"=== fogspec end {name} ===\n".encode()] if whole else []
    return b"".join(prefix + line for line in lines)


def unpacked(folder: Path, log: bytes) -> tuple[bool, dict[str, bytes]]:
    (folder / "run.log").write_bytes(log)
    whole = logs.unpack(ProjectFiles(folder), folder / "run.log", folder / "out")
    return whole, {path.name: path.read_bytes() for path in (folder / "out").glob("*")}


def test_files_come_back_as_they_were_printed(tmp_path: Path) -> None:
    sent = {"outcome.json": b'{"state": "ok"}\n', "packages.txt": b"dpkg libc6 2.35\n", "timings.jsonl": TIMING * 3}
    log = b"hello\n" + b"".join(printed(name, content) for name, content in sent.items()) + b"bye\n"
    assert unpacked(tmp_path, log) == (True, sent)


def test_without_prefix_too(tmp_path: Path) -> None:
    assert unpacked(tmp_path, printed("timings.jsonl", TIMING, b"")) == (True, {"timings.jsonl": TIMING})


def test_what_was_printed_last_counts(tmp_path: Path) -> None:
    forged = printed("timings.jsonl", TIMING.replace(b"0.2", b"0.0001"))
    assert unpacked(tmp_path, forged + printed("timings.jsonl", TIMING))[1] == {"timings.jsonl": TIMING}


def test_timings_that_break_off_are_kept_and_an_outcome_is_not(tmp_path: Path) -> None:
    log = printed("timings.jsonl", TIMING * 2, whole=False)
    assert unpacked(tmp_path, log) == (False, {"timings.jsonl": TIMING * 2})
    log = printed("outcome.json", b'{"state":', whole=False)
    (tmp_path / "out" / "timings.jsonl").unlink()
    assert unpacked(tmp_path, log) == (False, {})


def test_other_names_and_ways_out_of_the_folder_are_plain_lines(tmp_path: Path) -> None:
    log = printed("../../evil", b"x\n") + printed("run.sh", b"x\n") + printed("/etc/passwd", b"x\n")
    assert unpacked(tmp_path, log) == (False, {})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.log"]


def test_limits(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(logs, "LOG_LIMIT", 10_000)
    whole, files = unpacked(tmp_path, printed("timings.jsonl", TIMING * 10_000))
    assert not whole
    assert len(files["timings.jsonl"]) < 11_000


@given(st.integers(0, 2**32))
def test_any_damage_is_survived(tmp_path_factory, seed: int) -> None:
    chance = random.Random(seed)
    outcome = json.dumps({"state": "ok", "detail": "é\u2028"}).encode() + b"\n"
    log = bytearray(printed("outcome.json", outcome) + printed("timings.jsonl", TIMING * 5))
    for _ in range(chance.randrange(20)):
        at = chance.randrange(len(log))
        log[at : at + chance.randrange(40)] = chance.randbytes(chance.randrange(10))
    _, files = unpacked(tmp_path_factory.mktemp("log"), bytes(log))
    assert set(files) <= {"outcome.json", "timings.jsonl"}


def test_where_set_up_ends_is_found_once_though_it_is_written_in_pieces(tmp_path: Path) -> None:
    log = tmp_path / "run.log"
    assert logs.read_log(ProjectFiles(tmp_path), log, LogTail()) == LogTail()
    log.write_bytes(b"installing\n" * 50 + PREFIX + b"=== fogspec mea")
    heard = logs.read_log(ProjectFiles(tmp_path), log, LogTail())
    assert not heard.ready
    with open(log, "ab") as file:
        file.write(b"sures ===\n")
    assert logs.read_log(ProjectFiles(tmp_path), log, heard).ready


@pytest.mark.parametrize(
    ("line", "so_far"),
    [("40 requests, mean 0.22 s", Partial(40, 0.22)), ("2 requests", Partial(2, None)),
     ("2 requests, mean 9e999 s", None), ("2 requests, mean e+- s", None), ("many requests", None)],
)  # fmt: skip
def test_how_far_it_is_is_the_last_thing_it_said(tmp_path: Path, line: str, so_far: Partial | None) -> None:
    log = tmp_path / "run.log"
    log.write_bytes(b"=== fogspec measures ===\n" + PREFIX + f"=== fogspec so far: {line} ===\n".encode())
    heard = logs.read_log(ProjectFiles(tmp_path), log, LogTail())
    assert (heard.ready, heard.so_far) == (True, so_far)
    with open(log, "ab") as file:
        file.write(b"=== fogspec so far: 41 requ")
    assert logs.read_log(ProjectFiles(tmp_path), log, heard) == heard


def test_last_words_are_the_jobs_own_without_colours(tmp_path: Path) -> None:
    log = tmp_path / "run.log"
    log.write_bytes(PREFIX + b"\x1b[31mno such\x07 package\x1b[0m\n\n")
    assert logs.last_line(ProjectFiles(tmp_path), log) == "no such package"
    ended = b"srun: error: s-1x2: task 0: Exited with exit code 1\n\x1b[0mERROR: \x1b[31mJob 1's setup failed\n"
    cancelled = b"slurmstepd-s-1x2: error: *** STEP 3.15 ON s-1x2 CANCELLED AT 2026-11-22T16:54:00"
    log.write_bytes(PREFIX + b"no such package\n" + ended + cancelled + b" ***\n")
    assert logs.last_line(ProjectFiles(tmp_path), log) == "no such package"
    log.write_bytes(PREFIX + b"busy\n" + cancelled + b" DUE TO TIME LIMIT ***\n")
    assert "DUE TO TIME LIMIT" in logs.last_line(ProjectFiles(tmp_path), log), "it tells why"
    assert logs.last_line(ProjectFiles(tmp_path), tmp_path / "none") == ""


def test_a_job_ended_for_want_of_memory_is_told_from_others(tmp_path: Path) -> None:
    log = tmp_path / "run.log"
    log.write_bytes(b"slurmstepd: error: Detected 1 oom_kill event in StepId=7.3.\n")
    assert logs.out_of_memory(ProjectFiles(tmp_path), log)
    log.write_bytes(b"ray.exceptions.OutOfMemoryError: Task was killed due to the node running low on memory.\n")
    assert logs.out_of_memory(ProjectFiles(tmp_path), log)
    log.write_bytes(b"c++: fatal error: Killed signal terminated program cc1plus\ncompilation terminated.\n")
    assert logs.out_of_memory(ProjectFiles(tmp_path), log)
    log.write_bytes(b"\n".join([b"=== fogspec measures ===", b"Segmentation fault"]))
    assert not logs.out_of_memory(ProjectFiles(tmp_path), log)
