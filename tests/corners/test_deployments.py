"""More of a deployment's life on this host: what fails, what changes, and what is said of it."""

import json
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.deployed import HOSTS, MANIFEST, SPEC, Deployed, app, tiny  # noqa: F401
from tests.support.scenes import until

Make = Callable[..., Deployed]


def test_another_expectation_needs_no_other_machine(tiny: Deployed) -> None:
    tiny.apply()
    (name,) = tiny.names()
    tiny.change("latency: 1s", "latency: 2s")
    tiny("compile", "specs/tiny.yaml")
    assert "the machine stays, under the new manifest" in tiny.apply().stdout
    assert tiny.names() == [name]
    assert tiny.status()["sync"] == "Synced"
    assert "no changes" in tiny.apply().stdout


def test_an_update_that_does_not_answer_leaves_the_old_machine(app: Make) -> None:
    tiny = app(SPEC + "  deployment: {ready: [test, -e, work.py]}\n")
    tiny.apply()
    before = tiny.names()
    tiny.change("[test, -e, work.py]", "[test, -e, absent], ready_timeout: 3s")
    tiny("compile", "specs/tiny.yaml")
    failed = tiny.apply(code=6)
    assert "the nodes did not answer within 3 s" in failed.stderr
    assert tiny.names() == before
    assert tiny.judged()["health"] == "Healthy"
    tiny("down", "tiny")
    assert tiny.alive() == []


def test_nodes_that_crash_are_said_and_nothing_is_left(app: Make) -> None:
    # Without a command that asks them, nodes that take long to crash would answer by staying alive.
    tiny = app(SPEC + "  deployment: {ready: ['false']}\n")
    crashed = tiny.apply(code=1, env={"ROS_TOOK_S": "no number"})
    assert "python3 work.py ended with exit code 1: ValueError" in crashed.stderr
    assert (tiny.machines(), tiny.alive()) == ([], [])


def test_an_older_commit_is_refused_on_this_host_too(tiny: Deployed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CI", "true")
    tiny.apply()
    (machine,) = tiny.status()["machines"]
    assert (machine["applied"]["commit"], machine["applied"]["generation"]) == (None, 1), "no git here"
    assert ", generation 1" in tiny("status").stdout
    (tiny.folder / ".gitignore").write_text(".fogspec/\n")
    for words in (["init", "-q"], ["add", "."], ["commit", "-qm", "first"]):
        git(tiny.folder, *words)
    tiny.change("latency: 1s", "latency: 2s")
    tiny("compile", "specs/tiny.yaml")
    tiny.apply()  # not committed yet
    git(tiny.folder, "commit", "-qam", "second")
    tiny.apply()
    git(tiny.folder, "checkout", "-q", "HEAD~1")
    assert "by Ada Example, generation 3" in tiny.apply(code=5).stderr
    tiny("apply", "tiny", "--dry-run", code=5)
    tiny.apply("--older")
    git(tiny.folder, "checkout", "-q", "-")
    tiny.apply()
    (machine,) = tiny.machines()
    assert machine["applied"]["generation"] == 5
    live = tiny.state / "deployment.yaml"
    live.write_text(re.sub(r",\s+applied: \{[^}]*\}", "", live.read_text()))  # as an earlier version wrote it
    assert tiny.status()["machines"][0]["applied"] is None
    git(tiny.folder, "checkout", "-q", "HEAD~1")
    tiny.apply()
    assert "1 ended" in tiny("down", "tiny").stdout
    tiny.apply()
    assert tiny.status()["machines"][0]["applied"]["generation"] == 7, "they count on over a down"
    tiny("down", "tiny")


def git(folder: Path, *words: str) -> None:
    who = ("-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false")
    subprocess.run(["git", *who, *words], cwd=folder, check=True)
    subprocess.run(["git", "config", "user.name", "Ada Example"], cwd=folder, check=True)


def test_a_node_that_ends_is_degraded_and_apply_mends_it(tiny: Deployed) -> None:
    tiny.apply()
    (name,) = tiny.names()
    tiny.kill()
    until(lambda: not tiny.alive())
    assert tiny.status()["health"] == "Missing"
    tiny.apply()
    assert tiny.names() != [name]
    assert tiny.judged()["health"] == "Healthy"
    tiny("down", "tiny")


def test_fallbacks_only_if_the_spec_allows_them(app: Make) -> None:
    # No host has 4,096 CPUs: the chosen machine cannot be had.
    huge = HOSTS + "local,4096cpu-1gib,4096,1,0.0001,\n"
    spec = SPEC.replace("cpus: 1..2", "cpus: 1..4096").replace("alpha: 0.5", "alpha: 0")
    alone = app(spec, huge)
    failed = alone.apply(code=6)
    assert "needs 4096 CPUs" in failed.stderr
    assert "spec.deployment.fallbacks lets other machines take its place" in failed.stderr
    assert alone.machines() == []

    several = app(spec + "  deployment: {fallbacks: 2}\n", huge)
    said = several.apply()
    assert "4096cpu-1gib in local is unavailable: needs 4096 CPUs" in said.stderr
    (machine,) = several.machines()
    assert (machine["machine"]["instance"], machine["fallback"]) == ("1cpu-1gib", 1)
    assert "no changes" in several.apply().stdout
    several("down", "tiny")
    assert several.alive() == []


def test_requests_that_became_slow_are_drift(tiny: Deployed) -> None:
    tiny.apply(env={"ROS_TOOK_S": "0.2"})
    live = tiny.judged()
    assert (live["health"], live["observed"]["drift"]) == ("Drifted", "slower")
    assert live["observed"]["interval_s"][0] > live["predicted"]["interval_s"][1]
    tiny("down", "tiny")


def test_too_few_requests_are_not_judged(app: Make) -> None:
    tiny = app(SPEC.replace("latency: 1s", "latency: 100ms"))
    tiny.apply(env={"ROS_TOOK_S": "0.27", "ROS_REQUESTS": "0"})
    assert tiny.status()["health"] == "NotJudged", "it serves no request"
    assert "not judged yet (0 of 30 requests)" in tiny("status").stdout
    tiny("down", "tiny")
    tiny.apply(env={"ROS_TOOK_S": "0.27", "ROS_REQUESTS": "8"})
    until(lambda: tiny.status()["observed"]["requests"] == 7)  # after a warm-up of one
    live = tiny.status()
    assert (live["sync"], live["health"]) == ("Synced", "NotJudged")
    assert "not judged yet (7 of 30 requests)" in live["reasons"]
    said = tiny("status").stdout
    assert "not judged yet (7 of 30 requests)" in said
    assert "Healthy" not in said
    watch = tiny("watch", "tiny", "--once", "--yes")
    assert watch.stdout == "", "nothing to report or to restart"
    assert 'state="NotJudged"} 1' in (tiny.state.parent / "metrics.prom").read_text()
    (name,) = tiny.names()
    tiny.kill()
    until(lambda: not tiny.alive())
    assert tiny.status()["health"] == "Missing", "this needs no requests"
    tiny("watch", "tiny", "--once", "--yes")
    assert tiny.names() != [name]
    tiny("down", "tiny")


def test_what_was_done_is_shown_after_down_too(app: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GITHUB_ACTOR", "ada\x1b[31m")
    tiny = app()
    for words in (
        ["init", "-q"],
        ["-c", "user.name=a", "-c", "user.email=a@b", "commit", "-q", "--allow-empty", "-m", "x"],
    ):
        subprocess.run(["git", *words], cwd=tiny.folder, check=True)
    tiny.apply()
    (name,) = tiny.names()
    digest = tiny.machines()[0]["manifest"]
    assert "no changes" in tiny.apply().stdout
    tiny.change("alpha: 0.5", "alpha: 1")
    tiny("compile", "specs/tiny.yaml")
    tiny.apply()
    tiny("down", "tiny")
    tiny.apply()
    tiny("down", "tiny")
    assert (tiny.machines(), tiny.left()) == ([], [])
    assert "history" not in tiny("status").stdout
    lines = [line for line in tiny("status", "-v").stdout.splitlines() if "generation" in line]
    assert len(lines) == len(json.loads(tiny("status", "-o", "json").stdout)[0]["history"]) >= 5
    first, *_, last = lines
    assert re.fullmatch(
        rf"  history   \S+ apply by ada\\x1b\[31m started local/\dcpu-1gib at \$0\.\d\d/h, {name}, "
        rf"manifest {digest[7:19]}, commit \w{{12}}, generation 1", first
    ), first  # fmt: skip
    assert re.search(r" down by ada\S+ ended local/\dcpu-1gib at \$0\.\d\d/h, \$0\.\d+, .*, generation [34]$", last), (
        last
    )


def test_secrets_reach_the_nodes_and_no_file(app: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MY_SECRET", "hunter2-hunter2")
    prints = (
        "import os, sys, time; print('my secret is', os.environ['MY_SECRET'], flush=True); print(os.environ, file=sys.stderr)\n"
        "while not os.path.exists('end'): time.sleep(0.1)\n"
        "sys.exit(os.environ['MY_SECRET'])"
    )
    node = f"    - cmd: [python3, -c, {json.dumps(prints)}]\n"
    tiny = app(SPEC.replace("  probe:", f"{node}  probe:") + "  secrets: [MY_SECRET]\n")
    said = [tiny.apply()]
    environments = [Path(f"/proc/{pid}/environ").read_bytes() for pid in tiny.alive()]
    assert any(b"MY_SECRET=hunter2-hunter2" in one for one in environments)
    log = tiny.state / "deployed" / tiny.names()[0] / "run.log"
    until(lambda: b"my secret is $MY_SECRET\n" in log.read_bytes())
    said.append(tiny("status", "-o", "json"))
    here = tiny.state / "deployed" / tiny.names()[0] / "sent"
    (here / "end").touch()
    until(lambda: tiny.status()["health"] == "Degraded")
    said.append(tiny("status"))
    assert b"[python3] $MY_SECRET\n" in log.read_bytes().splitlines(keepends=True), "its last words are kept"
    assert [path for path in tiny.folder.rglob("*") if path.is_file() and b"hunter2" in path.read_bytes()] == []
    (here / "end").unlink()
    said.append(tiny("down", "tiny"))
    assert "hunter2" not in "".join(one.stdout + one.stderr for one in said)
    monkeypatch.delenv("MY_SECRET")
    refused = tiny.apply(code=2).stderr
    assert "the environment does not have MY_SECRET, so nothing was started\n  export MY_SECRET=…" in refused
    assert "starting" not in refused
    assert tiny.machines() == []
