"""What runs of all applications, and what their nodes print, also those that never answered."""

import json
import re
import shutil
from collections.abc import Callable

import pytest

from tests.support.deployed import SPEC, Deployed, app, tiny  # noqa: F401
from tests.support.scenes import until

PRINTS = SPEC.replace(
    "[python3, work.py]", "[sh, -c, 'echo loading the map; echo \"with $TOKEN\"; exec python3 work.py']"
)
PRINTS = PRINTS.replace("  probe:", "  secrets: [TOKEN]\n  probe:")


@pytest.fixture(autouse=True)
def token(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TOKEN", "swordfish-swordfish")


def test_what_nodes_print_is_shown_without_secrets_and_what_runs_is_listed(app: Callable[..., Deployed]) -> None:
    one = app(PRINTS)
    assert "nothing runs" in one("logs", "tiny", code=1).stderr
    assert "running" not in one("status").stdout
    one.apply()
    said = one("logs", "tiny").stdout.splitlines()
    assert said[0] == "[sh] loading the map"
    assert "swordfish" not in "".join(said)
    assert "=== fogspec" not in "".join(said)
    (listed,) = json.loads(one("status", "-o", "json").stdout)
    assert (listed["name"], listed["deployment"]["sync"], listed["has_spec"]) == ("tiny", "Synced", True)
    shown = one("status").stdout
    assert one.names()[0] in shown
    assert re.search(r" in local at 127\.0\.0\.1, up [^,]+, \$0\.02/h, \$0\.00 so far\n", shown)
    spec = one.folder / "specs/tiny.yaml"
    whole = spec.read_text()
    spec.write_text(whole.replace("latency:", "latencyy:"))
    said = one("status", code=1)
    assert "tiny (not all specs can be read: fogspec validate)\n  running   OutOfSync, " in said.stdout
    assert "latencyy" in said.stderr
    assert "fogspec down" not in said.stdout + said.stderr, "its spec has a mistake, and is there"
    assert json.loads(one("status", "-o", "json", code=1).stdout)[0]["has_spec"] is None
    spec.write_text(whole)
    shutil.rmtree(one.folder / "specs")
    assert "tiny (no spec)" in one("status").stdout, "what was deleted still runs"
    one("down", "tiny")
    assert one.left() == []
    assert "no machine in the live state" in one("status", code=1).stderr


def test_the_last_words_of_a_start_that_never_got_ready_are_kept(app: Callable[..., Deployed]) -> None:
    one = app(PRINTS + "  deployment: {ready: [test, -e, absent], ready_timeout: 10s}\n")
    failed = one.apply(code=6)
    assert "its last words: fogspec logs tiny" in failed.stderr
    found = one("logs", "tiny")
    assert found.stdout.splitlines()[0] == "[sh] loading the map"
    assert "swordfish" not in found.stdout
    assert "a start that never got ready" in found.stderr
    assert one("logs", "-f", "tiny").stdout == found.stdout
    one("down", "tiny")
    assert one.left() == []
    one("logs", "tiny", code=1)


def test_each_line_has_the_name_of_its_node_and_one_can_be_chosen(app: Callable[..., Deployed]) -> None:
    second = r"""    - cmd: [bash, -c, 'printf "one\ntwo\rthree\nno end"; exec sleep 1000']"""
    one = app(PRINTS.replace("  secrets:", f"{second}\n  secrets:"))
    one.apply()
    until(lambda: one("logs", "tiny").stdout.count("\n") == 5)
    said = one("logs", "tiny").stdout.splitlines()
    assert set(said) == {"[sh] loading the map", "[sh] with $TOKEN", "[bash] one", "[bash] two", "[bash] three"}
    assert one("logs", "tiny", "--node", "sh").stdout.splitlines() == ["[sh] loading the map", "[sh] with $TOKEN"]
    assert one("logs", "tiny", "--node", "bash").stdout.splitlines() == ["[bash] one", "[bash] two", "[bash] three"]
    wrong = one("logs", "tiny", "--node", "planner", code=2)
    assert "--node planner: no cloud node of tiny has this name" in wrong.stderr
    assert "nodes: sh, bash" in wrong.stderr
    log = one.state / "deployed" / one.names()[0] / "run.log"
    log.write_text("loading the map\n")  # as a version before this one wrote it
    unmarked = one("logs", "tiny", "--node", "sh")
    assert unmarked.stdout == ""
    assert "no line of this log names its node" in unmarked.stderr
    log.write_text("[bash] one\n")
    assert "tiny: sh printed none of the lines that are kept" in one("logs", "tiny", "--node", "sh").stderr
    one("down", "tiny")


def test_the_last_words_are_those_of_one_node(app: Callable[..., Deployed]) -> None:
    one = app(PRINTS + "  deployment: {ready: [test, -e, absent], ready_timeout: 10s}\n")
    one.apply(code=6)
    assert "[sh] loading the map" in one("logs", "-f", "tiny", "--node", "sh").stdout
    assert "no cloud node of tiny" in one("logs", "-f", "tiny", "--node", "x", code=2).stderr
    one("down", "tiny")
