"""`fogspec-lab conformance` on this host, interrupted, without access, and what it refuses before it starts anything."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from fogspec_lab import conformance

WORDS = [sys.executable, "-m", "fogspec_lab", "conformance"]


@dataclass
class Place:
    """A working folder, and a folder for temporary files that only these commands use."""

    folder: Path

    @property
    def environment(self) -> dict[str, str]:
        return {
            **os.environ,
            "TMPDIR": str(self.folder / "tmp"),
            "SKYPILOT_API_SERVER_ENDPOINT": "http://127.0.0.1:9",  # nothing listens there
            "SKYPILOT_DISABLE_USAGE_COLLECTION": "1",
        }

    def __call__(self, *words: str, code: int = 0) -> "subprocess.CompletedProcess[str]":
        ended = subprocess.run([*WORDS, *words], cwd=self.folder / "here", env=self.environment, capture_output=True,
                               text=True, timeout=1200, stdin=subprocess.DEVNULL)  # fmt: skip
        assert ended.returncode == code, ended
        assert "Traceback" not in ended.stderr
        return ended

    def report(self, name: str = "conformance.json") -> dict[str, object]:
        return dict(json.loads((self.folder / "here" / name).read_text()))

    def states(self) -> dict[str, str]:
        return {one["name"]: one["state"] for one in self.report()["steps"]}  # type: ignore[attr-defined]

    def projects(self) -> list[Path]:
        return [*(self.folder / "tmp").glob("fogspec-conformance-*")]


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Place]:
    for name in ("here", "tmp"):
        (tmp_path / name).mkdir()
    found = Place(tmp_path)
    yield found
    for project in found.projects():
        subprocess.run(
            [sys.executable, "-m", "fogspec", "down", "conformance"],
            cwd=project,
            env=found.environment,
            timeout=600,
            check=False,
        )


@pytest.mark.slow
def test_every_step_passes_on_this_host(place: Place) -> None:
    said = place("-o", "json")
    report = json.loads(said.stdout)
    assert {one["name"]: one["state"] for one in report["steps"]} == dict.fromkeys(conformance.STEPS, "ok")
    assert (report["passed"], report["left"], report["spent_usd"]) == (True, False, 0)
    assert "costs nothing" in said.stderr
    assert place.projects() == [], "a temporary project that left nothing is removed"
    text = (place.folder / "here" / "conformance.md").read_text()
    assert text.startswith("# Conformance of local: passed\n")
    assert [word for word in (str(place.folder), str(Path.home())) if word in text] == []
    assert len(text.splitlines()) == 6 + 1 + len(conformance.STEPS)


@pytest.mark.slow
def test_an_interrupt_tears_down_what_was_deployed(place: Place) -> None:
    running = subprocess.Popen([*WORDS, "--out", "conformance.json"], cwd=place.folder / "here", env=place.environment,
                               stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)  # fmt: skip
    assert running.stderr is not None
    for line in running.stderr:
        if line.startswith("apply: ok"):
            running.send_signal(signal.SIGINT)
            break
    rest = running.stderr.read()
    assert running.wait(1200) == 130, rest
    states = place.states()
    assert (states["apply"], states["down"], states["nothing left"], states["update"]) == ("ok", "ok", "ok", "not run")
    assert place.report()["left"] is False
    assert place.projects() == []


@pytest.mark.slow
def test_an_engine_that_cannot_be_reached_costs_nothing(place: Place) -> None:
    pytest.importorskip("sky")
    said = place("--infra", "aws/us-east-1", "--catalog", "snapshot", "--yes", "--out", "conformance.json", code=6)
    assert "at most $" in said.stderr
    assert "conformance on aws/us-east-1 failed at access" in said.stderr
    states = place.states()
    assert (states["plan"], states["access"]) == ("ok", "failed")
    assert set(states.values()) == {"ok", "failed", "not run"}
    assert (place.report()["spent_usd"], place.report()["left"]) == (0, False)
    assert place.projects() == []


def test_a_step_that_fails_is_named_and_what_ran_is_torn_down(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = conformance.offer("local", [], None, 2.0)
    exercise = conformance.Exercise(chosen, tmp_path, lambda _text: None)
    ran = []

    def command(*words: str) -> str:
        ran.append(words[0])
        if "--dry-run" in words:
            raise conformance.Failed("fogspec bench ended with 1: no access")
        return json.dumps({"ended": 0, "spent_usd": 0.0, "left": []})

    monkeypatch.setattr(exercise, "_command", command)
    outcome = exercise.run()
    assert ran == ["compile", "bench"], "nothing was started, so nothing is torn down"
    assert not outcome.passed
    assert "failed: access" in outcome.as_markdown()


def test_machines_that_cannot_be_torn_down_are_told_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    exercise = conformance.Exercise(conformance.offer("local", [], None, 2.0), tmp_path, lambda _text: None)

    def command(*words: str) -> str:
        if words[0] == "down":
            raise conformance.Failed("fogspec down ended with 6: could not be verified gone")
        return ""

    monkeypatch.setattr(exercise, "_command", command)
    monkeypatch.setattr(exercise, "_killed_bench", lambda: "")
    outcome = exercise.run()
    states = {one.name: one.state for one in outcome.steps}
    assert outcome.left
    assert (states["kill"], states["resume"], states["down"], states["nothing left"]) == (
        "ok",
        "failed",
        "failed",
        "not run",
    )
    assert "Something may still run." in outcome.as_markdown()


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["--infra", "aws/us-east-1", "--catalog", "snapshot"], 5, "pass --yes to approve this price"),
        (["--infra", "aws/us-east-1", "--catalog", "snapshot", "--max", "$0.10"], 5, "more than --max $0.10"),
        (["--infra", "aws/us-eest-1", "--catalog", "snapshot"], 2, "did you mean"),
        (["--infra", "aws/us-east-1\x1b[31m"], 2, "is not a place"),
        (
            ["--infra", "aws/us-east-1", "--catalog", "snapshot", "--machines", "c6i.large"],
            2,
            "two instance types are needed",
        ),
        (["--infra", "aws/us-east-1", "--catalog", "snapshot", "--machines", "c6i.large,nope"], 2, "has no nope"),
        (["--infra", "kubernetes/lab", "--catalog", "nowhere.csv"], 1, "nowhere.csv"),
        (["--machines", "a,b"], 2, "leave them out"),
        (["--max", "free"], 2, "--max"),
        (["--out", "report.html"], 2, "neither .md nor .json"),
    ],
)
def test_what_cannot_be_exercised_is_refused_before_anything_starts(
    place: Place, words: list[str], code: int, says: str
) -> None:
    said = place(*words, code=code)
    assert says in said.stderr
    assert "\x1b" not in said.stderr
    assert place.projects() == []
    assert [*(place.folder / "here").iterdir()] == []


def test_the_price_is_known_before_anything_starts() -> None:
    chosen = conformance.offer("aws/us-east-1", ["c6i.large", "c6i.xlarge"], "snapshot", 2.0)
    prices = [one.price for one in chosen.machines]
    assert prices == [0.085, 0.17]
    beside = 16.46 / 730 + 0.005  # disk and address
    assert chosen.deployed_usd == pytest.approx(2 * (0.17 + beside) * conformance.DEPLOYED_S / 3600)
    assert chosen.worst_usd == chosen.bench_usd + chosen.deployed_usd
    assert "$0.17/h, and $0.028/h for disk and address" in " ".join(chosen.lines())
    cheapest = conformance.offer("aws/us-east-1", [], "snapshot", 2.0).machines
    assert cheapest[0].price <= cheapest[1].price
    assert (cheapest[0].cpus, cheapest[0].memory) != (cheapest[1].cpus, cheapest[1].memory)


def test_a_report_has_no_account_address_or_credential(tmp_path: Path) -> None:
    exercise = conformance.Exercise(conformance.offer("local", [], None, 2.0), tmp_path, lambda _text: None)
    told = (
        f"{tmp_path}/x {Path.home()}/.aws on {os.uname().nodename}: arn:aws:iam::123456789012:user/me 10.1.2.3 "
        "me@example.org AKIAABCDEFGHIJKLMNOP account 123456789012"
    )
    said = exercise.public(told)
    assert "PROJECT" in said
    assert [
        word for word in ("123456789012", "10.1.2.3", "example.org", "AKIA", str(Path.home()), f"on {os.uname().nodename}:")
        if word in said
    ] == []  # fmt: skip


def test_a_command_that_hangs_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    exercise = conformance.Exercise(conformance.offer("local", [], None, 2.0), tmp_path, lambda _text: None)
    hangs = [sys.executable, "-c", "import signal, time; signal.signal(2, signal.SIG_IGN); time.sleep(600)"]
    monkeypatch.setattr(conformance.child, "python", lambda *_words: hangs)
    monkeypatch.setattr(conformance, "ENDED_S", 0.1)
    exercise.until_s = time.monotonic()
    with pytest.raises(conformance.Failed, match="took longer than"):
        exercise._command("apply")
