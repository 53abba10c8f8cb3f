"""`bench --confirm`: one measurement decides whether stale results count on, and none is lost whatever it says."""

import json
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from fogspec.base.units import parse_duration_s
from fogspec.bench.results_file import ResultsFile
from tests.e2e.test_ci import AT, MANIFEST, VERBS, codes, git
from tests.support.running import Shell, measure, project, shell  # noqa: F401
from tests.support.scenes import SPEC, Scene

SWEEP = "instance_type,latency_s\na.small,2.5\nb.small,2.5\na.large,{}\nb.large,{}\n"
REPLAY = ("--runner", "replay", "--from", "sweep.csv")


def results(shell: Shell) -> Any:
    return YAML(typ="safe", pure=True).load(shell.read("results/demo.yaml"))


def of_replay(shell: Shell) -> None:
    """Results as a replay leaves them: no other runner may be mixed with it."""
    from fogspec.results.schema import Results, with_checksum
    from fogspec.spec.loader import read_document
    from tests.support.files import write_yaml

    found = read_document(shell.folder / "results/demo.yaml", Results)
    found = with_checksum(found.metadata, found.spec.model_copy(update={"runner": "replay"}))
    write_yaml(shell.folder / "results/demo.yaml", found.model_dump(mode="json", exclude_none=True), "a test")


@pytest.fixture
def stale(shell: Shell) -> Shell:
    """A committed application whose node code has changed since it was measured."""
    project(shell)
    shell("lock", *AT)
    shell("compile", *AT)
    measure(shell)
    of_replay(shell)
    shell("compile", *AT)
    shell.write("specs/work.py", "print('other')\n")
    shell("lock", *AT)
    shell("compile", *AT)
    git(shell, "init", "-q")
    git(shell, "add", "-A")
    git(shell, "commit", "-qm", "all")
    assert all(codes(shell).values())
    return shell


def test_within_its_interval_the_older_samples_count_on(stale: Shell) -> None:
    before = results(stale)["spec"]
    stale.write("sweep.csv", SWEEP.format(1.01, 1.01))
    said = stale("bench", "demo", "--confirm", *REPLAY)
    assert "to measure once more with the replay runner: costs nothing" in said.err
    assert "the results count on if its mean latency is in [" in said.err
    assert "4 of 5 samples measured before changes: work.py is locked to something else; confirmed: " in said.out
    after = results(stale)["spec"]
    assert len(after["samples"]) == 5
    assert [one for one in after["samples"] if one in before["samples"]] == before["samples"]
    carried = after["carried"][0]
    assert (carried["application"], carried["pins"]) == (before["application"], before["pins"])
    assert carried["confirmed"]["changes"] == ["work.py is locked to something else"]
    low, high = map(parse_duration_s, carried["confirmed"]["interval"])
    assert low < 1.01 < high
    assert 0 < carried["confirmed"]["detectable"] < 10
    stale("compile", *AT)
    assert codes(stale) == dict.fromkeys(VERBS, 0)
    manifest = YAML(typ="safe", pure=True).load(stale.read(MANIFEST))
    assert manifest["provenance"]["carried"][0]["confirmed"]["sample"] == carried["confirmed"]["sample"]
    assert any("confirmed: " in text for text in manifest["warnings"])
    said = stale("bench", "demo", "--confirm", *REPLAY, code=2)
    assert "there is nothing to confirm: the results count" in said.err


def test_outside_of_it_they_stay_stale_and_the_measurement_is_kept(stale: Shell) -> None:
    before = stale.read("results/demo.yaml")
    stale.write("sweep.csv", SWEEP.format(9, 9))
    said = stale("bench", "demo", "--confirm", *REPLAY, code=3)
    assert "not confirmed: demo: the older results stay stale" in said.err
    assert stale.read("results/demo.old-1/demo.yaml") == before
    after = results(stale)["spec"]
    assert [one["latency"]["mean"] for one in after["samples"]] == ["9s"]
    assert "carried" not in after
    stale("compile", *AT, code=None)
    found = json.loads(stale("status", *AT, "-o", "json").out)[0]
    assert found["to_measure"] == 3, "the new sample is the plan's"


def test_a_machine_that_is_not_to_be_had_decides_nothing(stale: Shell) -> None:
    before = results(stale)["spec"]
    stale.write("sweep.csv", "instance_type,latency_s\nother,1\n")
    said = stale("bench", "demo", "--confirm", *REPLAY, code=3)
    assert "not confirmed: demo (not measured)" in said.err
    assert results(stale)["spec"] == before


def test_it_says_the_price_and_the_test_first_and_asks(stale: Shell) -> None:
    before = stale.read("results/demo.yaml")
    stale.write("sweep.csv", SWEEP.format(1, 1))
    said = stale("bench", "demo", "--confirm", *REPLAY, "--dry-run")
    assert "can pass, as can one on other machines only" in said.err
    assert stale.read("results/demo.yaml") == before


def test_what_defines_the_figures_cannot_be_confirmed(stale: Shell) -> None:
    stale.write("specs/demo.yaml", stale.read("specs/demo.yaml").replace("callback: plan", "callback: other"))
    stale("compile", *AT)
    said = stale("bench", "demo", "--confirm", *REPLAY, code=5)
    assert "older figures mean something else" in said.err


def test_without_results_and_with_only_it_is_wrong_usage(shell: Shell) -> None:
    project(shell)
    shell.write("sweep.csv", SWEEP.format(1, 1))
    assert "nothing is measured" in shell("bench", "demo", "--confirm", *REPLAY, code=2).err
    shell("bench", "demo", "--confirm", "--only", "aws-r1-a-small", *REPLAY, code=2)


def test_a_write_that_fails_loses_no_measurement(stale: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    stale.write("sweep.csv", SWEEP.format(1.01, 1.01))
    before = results(stale)["spec"]
    with monkeypatch.context() as broken:
        broken.setattr(ResultsFile, "write", full_disk)
        stale("bench", "demo", "--confirm", *REPLAY, code=1)
    assert results(stale)["spec"] == before
    stale.write("sweep.csv", SWEEP.format(9, 9))
    said = stale("bench", "demo", "--confirm", *REPLAY)
    assert "confirmed: aws-r1-a-large-repeat-2 took 1.01 s" in said.out, "by what the first one measured"
    assert len(results(stale)["spec"]["samples"]) == 5


def full_disk(_file: ResultsFile) -> None:
    raise OSError(28, "No space left on device")


@pytest.mark.slow
def test_shapes_of_this_host_are_confirmed_too(tmp_path: Path) -> None:
    scene = Scene.made(tmp_path / "project")
    assert scene.bench().returncode == 0
    before = scene.records()
    scene.spec.write_text(SPEC.replace("work.py]\n", "work.py]\n      env: {LOG: debug}\n"))
    assert scene.run("compile").returncode == 0
    ended = scene.bench("--confirm")
    assert "2cpu-1gib to measure once more with the local runner: costs nothing" in ended.stderr
    after = scene.records()
    if ended.returncode == 0:
        assert len(after) == 3
        assert before.items() <= after.items()
    else:
        assert "the older results stay stale" in ended.stderr
        assert list(after) == ["local-2cpu-1gib"]
        assert (scene.folder / "results" / "tiny.old-1" / "tiny.yaml").exists()
    for record in after.values():
        assert (scene.folder / "results" / record["timings"]["path"]).exists()
    measured = 7 if ended.returncode else 0  # of the two shapes, one or both
    assert scene.run("compile").returncode == measured
    assert scene.run("ci").returncode == (3 if measured else 0)
