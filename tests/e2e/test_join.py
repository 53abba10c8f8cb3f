"""Two people measured: their results are joined by the command, and by git with the command as its merge driver."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from fogspec.base import digest
from fogspec.bench.record import compress
from fogspec.results.schema import LatencySummary, Results, Timings, with_checksum
from fogspec.spec.loader import read_document
from tests.e2e.test_ci import AT, VERBS, codes, git
from tests.support.files import write_yaml
from tests.support.running import Shell, measure, project, shell  # noqa: F401

RESULTS = "results/demo.yaml"


def only(shell: Shell, names: list[int], latency_s: float | None = None) -> None:
    """Leave these samples of the results, perhaps of another latency, each with raw timings."""
    path = shell.folder / RESULTS
    found = read_document(path, Results)
    samples = []
    for number in names:
        one = found.spec.samples[number]
        mean_s = latency_s or (one.latency.mean if one.latency else 1.0)
        latencies_s = [0.75 * mean_s, mean_s, 1.25 * mean_s]
        lines = [
            {"name": "plan", "start_s": n, "latency_s": s, "ok": True, "metrics": {}}
            for n, s in enumerate([9.0, *latencies_s])
        ]
        raw = shell.folder / "raw.jsonl"
        raw.write_text("".join(json.dumps(line) + "\n" for line in lines))
        content = compress(raw)
        raw.unlink()
        target = f"demo/timings/{one.id}.jsonl.gz"
        (shell.folder / "results" / target).parent.mkdir(parents=True, exist_ok=True)
        (shell.folder / "results" / target).write_bytes(content)
        timings = Timings(path=target, digest=digest.of_bytes(content))
        latency = LatencySummary(mean=mean_s, sd=0.25 * mean_s, p50=mean_s)
        update = {"requests": 3, "latency": latency, "timings": timings}
        samples.append(one.model_copy(update=update))
    spent = round(sum(one.spent for one in samples), 6)
    results = with_checksum(found.metadata, found.spec.model_copy(update={"samples": samples, "spent": spent}))
    write_yaml(path, results.model_dump(mode="json", exclude_none=True), "a test")


def ids(shell: Shell, path: str = RESULTS) -> list[str]:
    return [one["id"] for one in YAML(typ="safe", pure=True).load(shell.read(path))["spec"]["samples"]]


def copied(shell: Shell) -> None:
    subprocess.run(["cp", "-r", "results", "theirs"], cwd=shell.folder, check=True)


@pytest.fixture
def two(shell: Shell) -> Shell:
    """The first two samples in results/, the other two in theirs/."""
    project(shell)
    measure(shell)
    only(shell, [2, 3])
    copied(shell)
    (shell.folder / RESULTS).unlink()
    measure(shell)
    only(shell, [0, 1])
    for name in ids(shell, "theirs/demo.yaml"):
        (shell.folder / f"results/demo/timings/{name}.jsonl.gz").unlink()
    return shell


def test_samples_and_raw_timings_of_both_are_there_once(two: Shell) -> None:
    expected = [*ids(two), *ids(two, "theirs/demo.yaml")]
    said = two("join", RESULTS, "theirs/demo.yaml")
    assert "demo: 4 samples, 2 more than before" in said.err
    assert ids(two) == expected
    for name in expected:
        assert (two.folder / f"results/demo/timings/{name}.jsonl.gz").exists()
    content = two.read(RESULTS)
    two("join", RESULTS, "theirs/demo.yaml")
    assert two.read(RESULTS) == content, "again changes nothing"
    two("compile", *AT)
    assert two("status", *AT, "--exit-code")


def test_a_sample_of_both_is_kept_twice_with_its_timings(two: Shell) -> None:
    (two.folder / RESULTS).unlink()
    measure(two)
    only(two, [2], latency_s=2.0)
    said = two("join", RESULTS, "theirs/demo.yaml")
    first = ids(two)[0]
    assert f"{first} was measured by both sides: the other one is {first}-repeat-2 now" in said.err
    two("compile", *AT, code=None)
    said = two("verify", "compiled/demo/manifest.yaml", *AT, code=None) if "manifest" in said.out else said
    assert (two.folder / f"results/demo/timings/{first}-repeat-2.jsonl.gz").exists()


@pytest.mark.parametrize("wrong", ["timings", "seal", "missing", "text"])
def test_what_is_damaged_is_refused_and_nothing_is_written(two: Shell, wrong: str) -> None:
    if wrong == "timings":
        next((two.folder / "theirs/demo/timings").iterdir()).write_bytes(b"other")
    elif wrong == "seal":
        two.write("theirs/demo.yaml", two.read("theirs/demo.yaml").replace("requests: 3", "requests: 4"))
    elif wrong == "missing":
        (two.folder / "theirs/demo.yaml").unlink()
    else:
        two.write("theirs/demo.yaml", "<<<<<<< ours\n")
    before = {path: path.read_bytes() for path in (two.folder / "results").rglob("*") if path.is_file()}
    said = two("join", RESULTS, "theirs/demo.yaml", code=1)
    assert "theirs/demo" in said.err
    assert {path: path.read_bytes() for path in (two.folder / "results").rglob("*") if path.is_file()} == before


def driver(shell: Shell) -> None:
    """What the documentation says, with this interpreter in place of the installed command."""
    page = Path(__file__).resolve().parents[2] / "docs" / "howto" / "editor-and-ci.md"
    assert "merge.fogspec-results.driver 'fogspec join %A %B --base %O'" in page.read_text()
    git(shell, "config", "merge.fogspec-results.driver", f"{sys.executable} -m fogspec join %A %B --base %O")
    shell.write(".gitattributes", "results/*.yaml merge=fogspec-results\n")


def merged(shell: Shell) -> Any:
    who = ["-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false"]
    words = ["git", *who, "merge", "-q", "--no-edit", "theirs"]
    return subprocess.run(words, cwd=shell.folder, capture_output=True, text=True)


def branches(shell: Shell, first: list[int], second: list[int], latency_s: float | None = None) -> None:
    git(shell, "init", "-q", "-b", "main")
    project(shell)
    driver(shell)
    git(shell, "add", "-A")
    git(shell, "commit", "-qm", "planned")
    for branch, names, own_s in (("theirs", second, None), ("main", first, latency_s)):
        git(shell, "checkout", "-q", *(["-b"] if branch == "theirs" else []), branch)
        measure(shell)
        only(shell, names, own_s)
        git(shell, "add", "-A")
        git(shell, "commit", "-qm", f"measured on {branch}")


def test_git_joins_what_two_branches_measured(shell: Shell) -> None:
    branches(shell, [0, 1], [2, 3])
    ended = merged(shell)
    assert ended.returncode == 0, ended
    assert len(ids(shell)) == 4
    shell("compile", *AT)
    git(shell, "add", "-A")
    git(shell, "commit", "-qm", "compiled")
    assert codes(shell) == dict.fromkeys(VERBS, 0)


def test_git_is_told_which_sample_both_branches_measured(shell: Shell) -> None:
    branches(shell, [0, 1], [1, 2], latency_s=3.0)
    ended = merged(shell)
    assert ended.returncode != 0
    assert f"both sides measured {ids_of(shell)[1]}" in ended.stderr + ended.stdout
    git(shell, "merge", "--abort")
    git(shell, "worktree", "add", "-q", "../other", "theirs")
    said = shell("join", RESULTS, "../other/results/demo.yaml")
    assert "-repeat-2 now" in said.err
    assert len(ids(shell)) == 4


def ids_of(shell: Shell) -> list[str]:
    plan = YAML(typ="safe", pure=True).load(shell.read("compiled/demo/plan.yaml"))
    return [one["id"] for one in plan["spec"]["samples"]]
