"""A manifest's life on this host, as a user lives it: spec, bench, manifest, apply, status, change, diff, apply, down."""

import json
import os
import signal
import time
from collections.abc import Callable

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


def test_another_workload_is_measured_first(tiny: Deployed) -> None:
    with (tiny.folder / "specs/work.py").open("a") as file:
        file.write("# faster\n")
    assert "stale: work.py changed" in tiny.apply(code=3).stderr
    assert (tiny.machines(), tiny.alive()) == ([], [])


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
