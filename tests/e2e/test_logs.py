"""What runs of all applications, and what their nodes print, also those that never answered."""

import json
import shutil
from collections.abc import Callable

import pytest

from tests.support.deployed import SPEC, Deployed, app, tiny  # noqa: F401

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
    assert "nothing runs" in one("ps").stdout
    one.apply()
    said = one("logs", "tiny").stdout.splitlines()
    assert said[0] == "loading the map"
    assert "swordfish" not in "".join(said)
    assert "=== fogspec" not in "".join(said)
    (listed,) = json.loads(one("ps", "-o", "json").stdout)
    assert (listed["application"], listed["answers"], listed["has_spec"]) == ("tiny", "ready", True)
    assert one.names()[0] in one("ps").stdout
    shutil.rmtree(one.folder / "specs")
    assert "tiny (no spec)" in one("ps").stdout, "what was deleted still runs"
    one("down", "tiny")
    assert one.left() == []
    assert "nothing runs" in one("ps").stdout


def test_the_last_words_of_a_start_that_never_got_ready_are_kept(app: Callable[..., Deployed]) -> None:
    one = app(PRINTS + "  deployment: {ready: [test, -e, absent], ready_timeout: 3s}\n")
    failed = one.apply(code=6)
    assert "its last words: fogspec logs tiny" in failed.stderr
    found = one("logs", "tiny")
    assert found.stdout.splitlines()[0] == "loading the map"
    assert "swordfish" not in found.stdout
    assert "a start that never got ready" in found.stderr
    assert one("logs", "-f", "tiny").stdout == found.stdout
    one("down", "tiny")
    assert one.left() == []
    one("logs", "tiny", code=1)
