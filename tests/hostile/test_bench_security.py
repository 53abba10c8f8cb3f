"""What a measured workload may do to whoever measures it: nothing. And secrets stay where they are."""

import contextlib
import gzip
import json
import os
import signal
from pathlib import Path

import pytest

from tests.support.scenes import HALTING, SPEC, Scene, environments, until

FIRST = "local-1cpu-1gib"
SECRET = "hunter2-correct-horse"
HEAD = "import json, os, sys, time\nimport fogspec_probe\n"
ANSWER = """
for _ in range(30):
    fogspec_probe.start("work")
    time.sleep(0.01)
    fogspec_probe.stop("work")
"""


def measured(folder: Path, work: str, spec: str = SPEC) -> Scene:
    scene = Scene.made(folder / "scene", HEAD + work, spec)
    scene.bench("--only", FIRST)
    return scene


def everything(folder: Path) -> dict[str, bytes]:
    """Every file that a bench left, unpacked where it is packed."""
    found = {}
    for path in folder.rglob("*"):
        if path.is_file() and not path.is_symlink():
            content = path.read_bytes()
            found[str(path.relative_to(folder))] = gzip.decompress(content) if path.suffix == ".gz" else content
    return found


def test_a_secret_is_in_no_file_log_or_result(tmp_path, monkeypatch):
    monkeypatch.setenv("MAP_PASSWORD", SECRET)
    spec = SPEC.replace("  benchmark:", "  secrets: [MAP_PASSWORD]\n  benchmark:")
    work = (
        'secret = os.environ["MAP_PASSWORD"]\nprint("the password is", secret, flush=True)\n'
        'fogspec_probe.start("work")\nfogspec_probe.stop("work", ok=False, reason=f"refused {secret}")\n'
        f'{ANSWER}print(secret, file=sys.stderr, flush=True)\nraise SystemExit(f"lost {{secret}}")\n'
    )
    scene = measured(tmp_path, work, spec.replace("requests: 10", "requests: 1000"))
    assert (scene.records()[FIRST]["state"], scene.records()[FIRST]["reason"]) == ("failed", "crash")
    assert "$MAP_PASSWORD" in scene.records()[FIRST]["detail"]
    files = everything(scene.folder)
    assert any("timings" in name for name in files)
    assert any(b"$MAP_PASSWORD" in content for name, content in files.items() if name.endswith(".log"))
    assert not [name for name, content in files.items() if SECRET.encode() in content]
    monkeypatch.delenv("MAP_PASSWORD")
    before = scene.events()
    refused = scene.bench("--only", FIRST)
    assert (refused.returncode, scene.events()) == (2, before), "known before anything is started"
    assert "the environment does not have MAP_PASSWORD" in refused.stderr


def test_a_secret_is_in_no_argv_and_in_nobody_elses_output(tmp_path, monkeypatch):
    monkeypatch.setenv("MAP_PASSWORD", SECRET)
    spec = SPEC.replace("  benchmark:", "  secrets: [MAP_PASSWORD]\n  benchmark:").replace(
        "duration: 1min", "duration: 10min"
    )
    scene = Scene.made(tmp_path / "scene", HALTING, spec)
    bench = scene.begin("-o", "json")
    try:
        until(lambda: scene.requests() >= 3)
        alive = scene.alive()
        commands = []
        for pid in [*alive, bench.pid]:
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):
                commands.append(Path(f"/proc/{pid}/cmdline").read_bytes())
        known = [words for pid, words in environments() if pid in alive]
        assert any(f"MAP_PASSWORD={SECRET}".encode() in words for words in known), "the workload has it"
        assert not [words for words in commands if SECRET.encode() in words]
    finally:
        bench.send_signal(signal.SIGINT)
        out, err = bench.communicate(timeout=1200)
    assert SECRET not in out + err


def test_timings_that_are_a_link_to_somebody_elses_file_are_not_read(tmp_path):
    other = tmp_path / "other.jsonl"
    other.write_text((json.dumps({"name": "work", "latency_s": 1.0, "ok": True}) + "\n") * 50)
    work = f'path = os.environ["FOGSPEC_TIMINGS"]\nos.unlink(path)\nos.symlink("{other}", path)\ntime.sleep(2)\n'
    scene = measured(tmp_path, work)
    record = scene.records()[FIRST]
    assert record["requests"] == 0
    assert record["state"] != "ok"
    assert "timings" not in record
    assert other.read_text().count("\n") == 50


def test_a_folder_that_is_a_link_leads_nowhere(tmp_path):
    there = tmp_path / "there"
    there.mkdir()
    (there / "timings.jsonl").write_text((json.dumps({"name": "work", "latency_s": 1.0, "ok": True}) + "\n") * 50)
    work = (
        'out = os.path.dirname(os.environ["FOGSPEC_TIMINGS"])\nos.rename(out, out + "-old")\n'
        f'os.symlink("{there}", out)\ntime.sleep(2)\n'
    )
    scene = measured(tmp_path, work)
    assert scene.records()[FIRST]["requests"] == 0
    assert "timings" not in scene.records()[FIRST]


def test_timings_that_are_a_pipe_do_not_hang_the_bench(tmp_path):
    work = 'path = os.environ["FOGSPEC_TIMINGS"]\nos.unlink(path)\nos.mkfifo(path)\ntime.sleep(2)\n'
    scene = measured(tmp_path, work)
    assert scene.records()[FIRST]["state"] == "failed"


def test_what_a_workload_says_cannot_speak_to_a_terminal(tmp_path):
    scene = measured(tmp_path, f'{ANSWER[:0]}sys.exit("\\x1b[2J\\x1b]0;gotcha\\x07 bad " + "x" * 5000)\n')
    detail = scene.records()[FIRST]["detail"]
    assert "\x1b" not in detail
    assert "\x07" not in detail
    assert len(detail) <= 1000


@pytest.mark.parametrize(
    "outcome", ["[]", '{"reason": "hacked", "stopped_by": "\\u001b[2J", "setup_s": "x"}', "{" * 9999]
)
def test_an_outcome_that_is_made_up_counts_for_nothing(tmp_path, outcome):
    """The workload ends the agent and writes what it likes in its place."""
    work = (
        f'{ANSWER}out = os.path.dirname(os.environ["FOGSPEC_TIMINGS"])\n'
        f"open(out + '/outcome.json', 'w').write({outcome!r})\nos.kill(os.getppid(), 9)\ntime.sleep(1)\n"
    )
    scene = measured(tmp_path, work, SPEC.replace("requests: 10", "requests: 1000"))
    record = scene.records()[FIRST]
    assert record.get("reason") in (None, "crash", "setup")
    assert record.get("stopped_by") in (None, "steps", "time", "exit")
    assert scene.alive() == []


def test_agent_and_bench_open_no_port(tmp_path):
    scene = Scene.made(tmp_path / "scene", HALTING, SPEC.replace("duration: 1min", "duration: 10min"))
    bench = scene.begin()
    try:
        until(lambda: scene.requests() >= 3)
        sockets = {pid: sockets_of(pid) for pid in [*scene.alive(), bench.pid]}
        assert len(sockets) >= 3
        assert not {pid: found for pid, found in sockets.items() if found}
    finally:
        bench.send_signal(signal.SIGINT)
        bench.communicate(timeout=1200)


def sockets_of(pid: int) -> list[str]:
    folder, found = f"/proc/{pid}/fd", []
    for name in os.listdir(folder):
        try:
            target = os.readlink(f"{folder}/{name}")
        except OSError:
            continue
        if target.startswith("socket:"):
            found.append(target)
    return found


def test_an_edited_or_missing_agent_is_refused(tmp_path):
    scene = Scene.made(tmp_path / "scene")
    agent = scene.folder / "compiled" / "agent.pyz"
    agent.write_bytes(agent.read_bytes() + b"\0")
    edited = scene.bench()
    assert (edited.returncode, scene.records()) == (3, {})
    assert "compiled/agent.pyz is not the agent of this version of fogspec" in edited.stderr
    assert "fogspec compile specs/tiny.yaml" in edited.stderr
    agent.unlink()
    missing = scene.bench()
    assert (missing.returncode, scene.records()) == (3, {})
    assert "compiled/agent.pyz: is missing, or cannot be read" in missing.stderr
