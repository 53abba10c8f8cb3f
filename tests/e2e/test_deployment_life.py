"""A manifest's life on this host, as a user lives it: spec, bench, manifest, apply, status, change, diff, apply, down."""

import json
import os
import re
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.deployed import HOSTS, MANIFEST, SPEC, Deployed, app, tiny  # noqa: F401
from tests.support.results import remove
from tests.support.scenes import until

Make = Callable[..., Deployed]


def test_from_apply_to_down(tiny: Deployed) -> None:
    first = tiny.apply()
    assert "$0.02/h, $14.60/month" in first.stderr
    assert "answered after" in first.stdout
    (name,) = tiny.names()
    assert tiny.machines()[0]["state"] == "serving"
    assert tiny.alive()
    live = tiny.judged()
    assert (live["sync"], live["health"]) == ("Synced", "Healthy")

    again = tiny.apply()
    assert "no changes" in again.stdout
    assert tiny.names() == [name]

    live = tiny.judged()  # a later look may have no interval again
    seen = live["observed"]
    assert seen["p50_s"] == pytest.approx(0.01, rel=0.06)
    assert (live["health"], seen["drift"]) == ("Healthy", "none")
    assert seen["cost_usd_per_request"] == pytest.approx(0.02 / 3600 * seen["mean_s"])
    assert tiny.status()["spent_usd"] > 0

    tiny.change("alpha: 0.5", "alpha: 1")
    said = tiny("diff").stdout
    assert "expected.objective.alpha: 0.5 -> 1.0" in said
    assert "why: menu and manifest are stale: spec.objective.alpha: 0.5 -> 1.0" in said
    assert "no benchmark needed" in said
    assert "running: as the manifest says" in said
    refused = tiny.apply(code=3)
    assert "menu and manifest are stale: spec.objective.alpha: 0.5 -> 1.0" in refused.stderr
    assert tiny.names() == [name], "what runs is left alone"

    tiny("compile", "specs/tiny.yaml")
    assert tiny.status()["sync"] == "OutOfSync"
    tiny.apply()
    assert tiny.status()["sync"] == "Synced"
    assert "running: as the manifest says" in tiny("diff").stdout

    down = tiny("down", "tiny")
    assert "1 ended" in down.stdout
    assert tiny.alive() == []
    assert tiny.left() == []
    assert "nothing runs" in tiny("down", "specs/tiny.yaml").stdout
    assert json.loads(tiny("status", "-o", "json").stdout)[0]["deployment"] is None


def test_another_expectation_needs_no_other_machine(tiny: Deployed) -> None:
    tiny.apply()
    (name,) = tiny.names()
    tiny.change("latency: 1s", "latency: 2s")
    tiny("compile", "specs/tiny.yaml")
    assert "the machine stays, under the new manifest" in tiny.apply().stdout
    assert tiny.names() == [name]
    assert tiny.status()["sync"] == "Synced"
    assert "no changes" in tiny.apply().stdout


def test_an_update_replaces_the_old_machine_once_the_new_one_answers(tiny: Deployed) -> None:
    tiny.apply()
    (old,) = tiny.names()
    # Not a word of what is compiled for the machine changes: only a file that goes along.
    with (tiny.folder / "specs/work.py").open("a") as file:
        file.write("# another version\n")
    for words in (
        ["lock"],
        ["compile", "specs/tiny.yaml"],
        ["bench", "specs/tiny.yaml"],
        ["compile", "specs/tiny.yaml"],
    ):
        tiny(*words)
    live = tiny.judged()
    assert (live["sync"], live["health"]) == ("OutOfSync", "Healthy")
    assert "work.py changed since it was started" in live["reasons"]
    assert "work.py: as it was started -> changed since" in tiny("diff").stdout
    said = tiny.apply().stderr
    assert f"replaces  {old}: 1cpu-1gib in local" in said
    assert f"{old}: gone" in said
    assert tiny.status()["sync"] == "Synced"
    (new,) = tiny.names()
    assert new != old
    assert not (tiny.state / "deployed" / old).exists()


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


def test_another_workload_is_measured_first(tiny: Deployed) -> None:
    with (tiny.folder / "specs/work.py").open("a") as file:
        file.write("# faster\n")
    assert "stale: work.py changed" in tiny.apply(code=3).stderr
    assert (tiny.machines(), tiny.alive()) == ([], [])


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


def test_dry_run_and_no_answer_start_nothing(tiny: Deployed) -> None:
    assert "/month" in tiny("apply", MANIFEST, "--dry-run").stderr
    assert "confirmation required" in tiny("apply", MANIFEST, code=5).stderr
    assert tiny.machines() == []
    assert tiny.alive() == []


@pytest.mark.parametrize(
    ("name", "edit", "says"),
    [
        (MANIFEST, lambda text: text.replace("1cpu-1gib", "2cpu-1gib"), "manifest is stale: spec.instance"),
        ("compiled/tiny/deploy.sky.yaml", lambda text: text + "# mine\n", "deploy.sky.yaml is not what was compiled"),
        ("compiled/agent.pyz", lambda text: text + "# mine\n", "agent.pyz is not what"),
        (
            "results/tiny/local-1cpu-1gib.yaml",
            lambda text: text.replace("requests: ", "requests: 1"),
            "integrity check failed",
        ),
    ],
)
def test_what_was_edited_is_refused(tiny: Deployed, name: str, edit, says: str) -> None:
    path = tiny.folder / name
    path.write_text(edit(path.read_text("latin-1")), "latin-1")  # byte by byte: the agent is not text
    assert says in tiny.apply(code=3).stderr
    assert tiny.machines() == []


def test_a_higher_price_is_refused_and_may_be_allowed(tiny: Deployed) -> None:
    (tiny.folder / "now.csv").write_text(HOSTS.replace("0.02", "0.03"))
    refused = tiny.apply("--prices", "now.csv", code=5)
    assert "costs $0.03/h now" in refused.stderr
    tiny.apply("--prices", "now.csv", "--max", "0.03", code=2)
    tiny.apply("--prices", "now.csv", "--max", "$0.025/h", code=5)
    tiny.apply("--prices", "now.csv", "--max", "$0.03/h")
    assert tiny.machines()[0]["machine"]["price"] == "$0.03/h"
    tiny("down", "tiny")


def test_the_limit_of_the_spec_holds_whatever_is_allowed(app: Make) -> None:
    tiny = app(SPEC.replace("{latency: 1s,", "{latency: 1s, price: $0.025/h,"))
    (tiny.folder / "now.csv").write_text(HOSTS.replace("0.02", "0.03"))
    assert "spec.constraints.price is hard" in tiny.apply("--prices", "now.csv", "--max", "$1/h", code=5).stderr


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
    tiny.apply(env={"ROS_TOOK_S": "0.27", "ROS_REQUESTS": "7"})
    until(lambda: tiny.status()["observed"]["requests"] == 7)
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


def test_over_the_limit_is_degraded(app: Make) -> None:
    tiny = app(SPEC.replace("latency: 1s", "latency: 100ms"))
    tiny.apply(env={"ROS_TOOK_S": "0.2"})
    live = tiny.judged()
    assert live["health"] == "Degraded"
    assert any("over its limit of 100 ms" in reason for reason in live["reasons"])
    tiny("down", "tiny")


def test_ctrl_c_ends_what_was_being_started(app: Make) -> None:
    tiny = app(SPEC + "  deployment: {ready: ['false']}\n")
    applying = tiny.begin("apply", MANIFEST, "--yes")
    until(lambda: tiny.alive())
    applying.send_signal(signal.SIGINT)
    _, err = applying.communicate(timeout=1200)
    assert applying.returncode == 130, err
    assert tiny.alive() == []
    assert tiny.machines() == []


def test_ctrl_c_twice_names_what_may_still_run_and_what_ends_it(app: Make) -> None:
    tiny = app(SPEC + "  deployment: {ready: ['false']}\n")
    applying = tiny.begin("apply", MANIFEST, "--yes")
    until(lambda: tiny.alive())
    for _ in range(2):
        applying.send_signal(signal.SIGINT)
        time.sleep(0.05)
    _, err = applying.communicate(timeout=1200)
    assert applying.returncode == 130, err
    assert [f"may still run: {one['name']}" in err for one in tiny.machines()] == [True] * len(tiny.machines())
    assert "fogspec down tiny tears" in err or tiny.alive() == []
    tiny("down", "tiny")
    assert (tiny.alive(), tiny.machines()) == ([], [])


def test_whoever_applies_is_alone(app: Make) -> None:
    tiny = app(SPEC + "  deployment: {ready: ['false']}\n")
    first = tiny.begin("apply", MANIFEST, "--yes")
    until(lambda: tiny.machines())
    holder = f"must wait: apply of tiny (process {first.pid} on {os.uname().nodename}) has not ended"
    for words in (["apply", "tiny", "--yes"], ["down", "tiny"], ["bench", "tiny", "--runner", "local"]):
        assert f"{words[0]} of tiny {holder}" in tiny(*words, code=8).stderr
    first.send_signal(signal.SIGTERM)
    first.communicate(timeout=1200)


def test_down_ends_a_bench_that_died(app: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny = app()
    monkeypatch.setenv("ROS_TOOK_S", "60")
    remove(tiny.folder / "results/tiny")
    bench = tiny.begin("bench", "specs/tiny.yaml", "--runner", "local")
    until(lambda: tiny.alive())
    bench.kill()
    bench.communicate()
    assert tiny.alive()
    assert "1 ended" in tiny("down", "tiny").stdout
    time.sleep(0.2)
    assert tiny.alive() == []


def test_a_place_without_a_price_list_is_an_answer(tiny: Deployed) -> None:
    tiny.change("infra: [local]", "infra: [slurm/lab]")
    (tiny.folder / "specs/tiny.lock").unlink()
    (tiny.folder / "compiled/tiny/plan.yaml").unlink()  # it names the price list
    for words in (["compile", "specs/tiny.yaml"], ["menu", "specs/tiny.yaml"]):
        ended = tiny(*words, code=4)
        assert "no machine of the catalog is admissible" in ended.stderr
    (tiny.folder / "specs/tiny.lock").mkdir()
    assert "specs/tiny.lock" in tiny("status", "specs/tiny.yaml", code=1).stderr


def test_down_needs_no_spec_that_is_right(tiny: Deployed) -> None:
    tiny.apply()
    tiny.change("probe:", "prob:")
    assert "1 ended" in tiny("down", "tiny").stdout
    assert (tiny.alive(), tiny.left()) == ([], [])


def test_down_of_nobody(tiny: Deployed) -> None:
    assert "no application named other" in tiny("down", "other", code=2).stderr
    for name in (".", "..", ""):
        assert "is not an application's name" in tiny("down", name, code=1).stderr


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


def test_the_end_of_a_machine_whose_record_is_lost_is_in_the_history(tiny: Deployed) -> None:
    tiny.apply()
    (name,) = tiny.names()
    (tiny.state / "deployment.yaml").unlink()
    assert f"{name}: gone" in tiny("down", "tiny").stderr
    (act,) = json.loads(tiny("status", "-o", "json").stdout)[0]["history"]
    assert (act["verb"], act["did"], act["name"]) == ("down", "ended", name)
    assert f"down ended {name}, found by its name" in tiny("status", "-v").stdout
    tiny.apply()
    assert [line[-12:] for line in tiny("status", "-v").stdout.splitlines() if " started " in line] == ["generation 1"]
    tiny("down", "tiny")


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
