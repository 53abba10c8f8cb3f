"""Deployments that look after themselves: nodes started again, machines replaced, ends that come by themselves."""

import contextlib
import json
import os
import re
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families as textfile
from prometheus_client.samples import Sample

from fogspec.deploy import watch
from tests.faults import deployments as faulty
from tests.support.deployed import SPEC, Deployed, app, tiny  # noqa: F401
from tests.support.scenes import until

Make = Callable[..., Deployed]
RESPAWN = SPEC.replace(
    "- cmd: [python3, work.py]", "- cmd: [python3, work.py]\n      launch: {respawn: on_failure, respawn_delay: 50ms}"
)
WATCH = ("watch", "tiny", "--once", "--yes")
DOCS = Path(__file__).resolve().parents[2] / "docs/howto"


def events(one: Deployed) -> list[str]:
    path = one.state / "events.jsonl"
    return [json.loads(line)["event"] for line in path.read_text().splitlines()] if path.exists() else []


def nodes(one: Deployed) -> list[int]:
    """The living processes of the node itself."""
    return [pid for pid in one.alive() if b"python3\0work.py\0" in command_line(pid)]


def command_line(pid: int) -> bytes:
    with contextlib.suppress(OSError):
        return Path("/proc", str(pid), "cmdline").read_bytes()
    return b""


def serves(one: Deployed) -> bool:
    return bool(nodes(one)) and one.status()["health"] in ("NotJudged", "Healthy", "Drifted", "Degraded")


def test_a_node_that_fails_is_started_again_on_its_machine(app: Make) -> None:
    one = app(RESPAWN)
    one.apply()
    (name,), (node,) = one.names(), nodes(one)
    os.kill(node, signal.SIGKILL)
    until(lambda: nodes(one) not in ([], [node]) and one.status()["restarts"] == {"python3 work.py": 1})
    until(lambda: serves(one))
    assert one.names() == [name]
    assert "restarted: python3 work.py 1 time" in one("status").stdout
    one("down", "tiny")
    assert one.alive() == []


def test_a_node_that_fails_again_and_again_ends_the_deployment_with_its_reason(app: Make) -> None:
    one = app(RESPAWN + "  deployment: {ready: ['false']}\n")
    failed = one.apply(code=1, env={"ROS_TOOK_S": "no number"})
    assert "python3 work.py ended with exit code 1, after 5 restarts in a row" in failed.stderr
    assert one("logs", "tiny").stdout.count("Traceback") == 6
    assert (one.machines(), one.alive()) == ([], [])


def test_a_lost_machine_is_replaced_once_by_its_manifest(tiny: Deployed) -> None:
    tiny.apply()
    (name,) = tiny.names()
    tiny.judged()
    assert "Healthy" in tiny(*WATCH).stdout
    assert tiny.names() == [name]
    assert events(tiny) == ["Healthy"]
    tiny.kill()
    until(lambda: not tiny.alive())
    tiny("watch", "--once", code=5)
    assert tiny.alive() == [], "nobody approved it"
    tiny("watch", "--once", "--max-restarts", "0", code=6)
    assert tiny.alive() == []
    said = tiny(*WATCH).stdout
    assert "restart: its machine is gone" in said
    (other,) = tiny.names()
    assert other != name
    assert serves(tiny)
    assert events(tiny).count("restart") == 1
    assert metric(tiny, "fogspec_machine_restarts_total") == 1
    tiny("down", "tiny")
    assert tiny.alive() == []
    assert tiny.left() == [str(tiny.state / "events.jsonl")], "events are kept"
    tiny(*WATCH)
    assert tiny.alive() == [], "what was ended stays ended"


def test_a_dead_supervisor_is_a_lost_deployment(tiny: Deployed) -> None:
    tiny.apply()
    faulty.orphaned(tiny)
    until(lambda: not tiny.alive())
    tiny(*WATCH)
    assert serves(tiny)


def test_restarts_are_bounded_in_an_hour_and_wait_longer_each_time(
    tiny: Deployed, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("FIRST_WAIT_S", "LONGEST_WAIT_S"):
        monkeypatch.setattr(watch, name, 3000.0)  # longer than the commands below on any host
    tiny.apply()
    for _ in range(2):
        tiny.kill()
        until(lambda: not tiny.alive())
        tiny(*WATCH, code=None)
    assert events(tiny).count("restart") == 1, "the second waits"
    assert "the next restart waits" in (tiny.state / "events.jsonl").read_text()
    path = tiny.state / "events.jsonl"
    path.write_text(re.sub(r"\b20\d\d(?=-)", "2999", path.read_text().replace('"boot": "', '"boot": "another ')))
    refused = tiny("watch", "--once", "--yes", "--max-restarts", "1", code=6)
    assert "was restarted 1 time in the last hour" in refused.stderr
    assert tiny.alive() == []


def test_nothing_is_started_without_contact(tiny: Deployed) -> None:
    tiny.apply()
    (name,) = tiny.names()
    tiny.kill()
    until(lambda: not tiny.alive())
    assert faulty.run(tiny, *WATCH, fault=faulty.cut(polls=99, stops=0)) == 6
    assert tiny.names() == [name]
    assert "Unknown" in events(tiny)
    tiny(*WATCH)
    assert serves(tiny)


def test_state_that_cannot_be_read_starts_nothing(tiny: Deployed) -> None:
    tiny.apply()
    before = tiny.alive()
    live = tiny.state / "deployment.yaml"
    kept = live.read_text()
    live.write_text("machines: [")
    assert "deployment.yaml" in tiny(*WATCH, code=6).stdout
    assert tiny.alive() == before
    live.write_text(kept)
    tiny(*WATCH)


def test_another_manifest_is_reported_and_not_deployed(tiny: Deployed) -> None:
    tiny.apply()
    tiny.change("alpha: 0.5", "alpha: 1")
    tiny("compile", "specs/tiny.yaml")
    assert "OutOfSync" in tiny(*WATCH).stdout
    tiny.judged()
    assert "Healthy: OutOfSync" in tiny(*WATCH).stdout
    tiny.kill()
    until(lambda: not tiny.alive())
    assert "another manifest is committed than the one that ran" in tiny(*WATCH, code=6).stderr
    assert tiny.alive() == []


def test_a_watcher_that_is_killed_in_a_restart_leaves_one_machine(tiny: Deployed) -> None:
    tiny.apply()
    for at in (2, 4, 6, 8):
        tiny.kill()
        until(lambda: not tiny.alive())
        (tiny.state / "events.jsonl").unlink(missing_ok=True)
        faulty.run(tiny, *WATCH, fault=faulty.killed(at, before=True))
        (tiny.state / "events.jsonl").unlink(missing_ok=True)
        tiny(*WATCH)
        assert serves(tiny)
        assert len(tiny.machines()) == len(nodes(tiny)) == 1, at
    tiny("down", "tiny")
    assert tiny.alive() == []


def test_each_environment_is_watched(tiny: Deployed) -> None:
    overlay = tiny.folder / "environments/prod.yaml"
    overlay.parent.mkdir()
    overlay.write_text("metadata: {name: tiny}\nspec: {objective: {alpha: 0.9}}\n")
    tiny("compile", "specs/tiny.yaml")
    tiny("apply", "tiny@prod", "--yes")
    state = tiny.folder / ".fogspec/tiny@prod"
    until(lambda: "NotJudged" not in tiny("status", "tiny@prod").stdout)
    assert "tiny@prod: Healthy" in tiny("watch", "--once", "--yes").stdout
    assert (state / "events.jsonl").exists()
    assert not tiny.state.exists(), "the other environment runs nothing"
    tiny("down", "tiny@prod")


def test_a_disk_that_is_full_keeps_no_count_so_nothing_is_started(
    tiny: Deployed, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny.apply()
    tiny.kill()
    until(lambda: not tiny.alive())
    (tiny.state / "events.jsonl").mkdir()
    assert "events.jsonl" in tiny(*WATCH, code=6).stderr
    assert tiny.alive() == []


def test_an_update_that_was_killed_is_cleared_away(tiny: Deployed) -> None:
    tiny.apply()
    (name,) = tiny.names()
    tiny.change("[python3, work.py]", "[env, A=1, python3, work.py]")
    for words in (
        ["lock"],
        ["compile", "specs/tiny.yaml"],
        ["bench", "specs/tiny.yaml", "--runner", "local"],
        ["compile", "tiny"],
    ):
        tiny(*words)
    assert faulty.run(tiny, "apply", "tiny", "--yes", fault=faulty.killed(7, before=True)) == -9
    assert len(tiny.machines()) == 2
    tiny(*WATCH)
    assert tiny.names() == [name]
    assert len(nodes(tiny)) == 1


def test_a_watch_writes_metrics_until_it_is_interrupted(tiny: Deployed) -> None:
    tiny.apply()
    watch = tiny.begin("watch", "--yes", "--interval", "200ms", "-o", "json")
    until(lambda: metric(tiny, "fogspec_serving") == 1)
    (name,) = tiny.names()
    tiny.kill()
    until(lambda: tiny.names() != [name] and metric(tiny, "fogspec_machine_restarts_total") == 1)
    until(lambda: metric(tiny, "fogspec_serving") == 1)
    watch.send_signal(signal.SIGINT)
    out, err = watch.communicate(timeout=1200)
    assert watch.returncode == 130, err
    assert "what runs is left as it is" in err
    assert {"restart", "serves"} <= {json.loads(line)["event"] for line in out.splitlines()}
    assert nodes(tiny), "the deployment is left"


def metrics(one: Deployed) -> dict[str, list[Sample]]:
    path, found = one.state.parent / "metrics.prom", dict[str, list[Sample]]()
    for family in textfile(path.read_text()) if path.exists() else ():
        found.setdefault(family.name, []).extend(family.samples)
    return found


def metric(one: Deployed, name: str) -> float | None:
    return next((sample.value for sample in metrics(one).get(name, [])), None)


def test_a_watch_writes_what_runs_as_metrics(tiny: Deployed) -> None:
    tiny("watch", "tiny", "--once", "--max-restarts", "0")
    assert metric(tiny, "fogspec_deployment") == 0
    tiny.apply()
    tiny.judged()
    tiny(*WATCH)
    found = metrics(tiny)
    quantiles = {one.labels["quantile"]: one.value for one in found["fogspec_request_latency_seconds"]}
    assert quantiles["0.5"] == pytest.approx(0.01, rel=0.06)
    assert metric(tiny, "fogspec_spent_usd_total") is not None
    states = [one.labels["state"] for one in found["fogspec_health"] if one.value]
    assert states == ["Healthy"]
    dashboard = json.loads((DOCS / "grafana-dashboard.json").read_text())
    shown = set(re.findall(r"fogspec_\w+", json.dumps(dashboard)))
    assert shown - set(found) == {"fogspec_node_restarts_total"}, "of nodes with respawn alone"


def test_metrics_that_cannot_be_written_end_no_watch(tiny: Deployed) -> None:
    tiny.apply()
    (tiny.state.parent / "metrics.prom").mkdir()
    assert "metrics.prom: cannot be written" in tiny(*WATCH).stderr


def test_an_end_is_kept_by_the_machine_itself(app: Make) -> None:
    one = app(SPEC + "  deployment: {until: 15min, budget: $5}\n")
    said = one.apply().stderr
    assert "ends      15min after apply, and before $5.00 are spent, by its supervisor" in said
    (machine,) = one.machines()
    assert machine["ends"] is not None
    (supervisor,) = [pid for pid in one.alive() if b"agent.pyz\0supervisor" in command_line(pid)]
    words = command_line(supervisor).split(b"\0")
    assert 0 < float(words[words.index(b"--lifetime") + 1]) <= 900
    assert "ends by itself at " in one("status").stdout
    assert "deploys what is committed" in one("check").stderr


def test_an_end_that_has_come_starts_nothing(app: Make) -> None:
    for end in ("2020-01-01T00:00:00Z", "20s"):
        past = app(SPEC + f"  deployment: {{until: '{end}'}}\n")
        said = past.apply(code=5).stderr
        assert "spec.deployment.until is reached" in said
        assert "fogspec down ends it" not in said
        assert f"spec.deployment.until: {end} is over" in past("check", code=3).stdout
    assert (past.alive(), past.machines()) == ([], [])
    poor = app(SPEC + "  deployment: {budget: $0.0001}\n")
    assert "spec.deployment.budget is reached" in poor.apply(code=5).stderr
    assert (poor.alive(), poor.machines()) == ([], [])


def test_what_ended_by_itself_is_cleared_away_and_not_restarted(app: Make) -> None:
    one = app(SPEC + "  deployment: {until: 1h}\n")
    one.apply()
    live = one.state / "deployment.yaml"
    (machine,) = one.machines()
    live.write_text(live.read_text().replace(str(machine["ends"]), "2020-01-01T00:00:00+00:00"))
    one.kill()
    until(lambda: not one.alive())
    assert "its time is over" in one(*WATCH).stdout
    assert (one.machines(), one.alive()) == ([], [])
