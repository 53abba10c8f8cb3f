"""`bench` after a change: one measurement decides whether stale results count on, and none is lost whatever it says."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from fogspec.base import digest
from fogspec.base.units import parse_duration_s
from fogspec.bench.results_file import ResultsFile
from fogspec.results.io import read_results_folder
from fogspec.results.schema import Measured, ResultsBody
from fogspec_lab import cli as lab
from tests.e2e.test_check import AT, MANIFEST, VERBS, codes, git
from tests.support import results as measured_files
from tests.support.running import Shell, copied, measure, project, shell  # noqa: F401
from tests.support.scenes import SPEC, Scene

SWEEP = "instance_type,latency_s\na.small,2.5\nb.small,2.5\na.large,{}\nb.large,{}\n"
REPLAY = ("--from", "sweep.csv")


def results(shell: Shell) -> dict[str, Any]:
    return {"spec": measured_files.document(shell.folder / "results/demo")}


def edited(shell: Shell, changes: Callable[[ResultsBody], dict[str, Any]]) -> None:
    """Results as another bench would have left them."""
    found = read_results_folder(shell.folder / "results/demo")
    measured_files.write(shell.folder / "results/demo", found.spec.model_copy(update=changes(found.spec)))


@pytest.fixture
def stale(shell: Shell) -> Shell:
    """A committed application whose node code has changed since it was measured."""

    def fill(made: Shell) -> None:
        project(made)
        made("lock", *AT)
        made("compile", *AT)
        measure(made)
        edited(made, lambda _: {"runner": "replay"})  # no other runner is mixed with it
        made("compile", *AT)
        made.write("specs/work.py", "print('other')\n")
        made("lock", *AT)
        made("compile", *AT)
        git(made, "init", "-q")
        git(made, "add", "-A")
        git(made, "commit", "-qm", "all")

    copied(shell, "a repository whose node has changed", fill)
    assert {shell(*VERBS[name], code=None).code for name in ("check", "apply")} == {3}, "without a base it is red"
    return shell


def test_within_its_interval_the_older_samples_count_on(stale: Shell) -> None:
    before = results(stale)["spec"]
    stale.write("sweep.csv", SWEEP.format(1.01, 1.01))
    said = stale("replay", "demo", *REPLAY, run=lab.main)
    assert "to measure once more with the replay runner: costs nothing" in said.err
    assert "the results count on if its mean latency is in [" in said.err
    assert "--all measures all samples, without this comparison" in said.err
    assert "next: fogspec compile specs/demo.yaml" in said.out
    assert "4 of 5 samples measured before changes: work.py changed; confirmed: " in said.out
    after = results(stale)["spec"]
    assert len(after["samples"]) == 5
    assert [one for one in after["samples"] if one in before["samples"]] == before["samples"]
    carried = after["carried"][0]
    assert carried["inputs"] == digest.of_value(before["inputs"])
    assert carried["confirmed"]["changes"] == ["work.py changed"]
    low, high = map(parse_duration_s, carried["confirmed"]["interval"])
    assert low < 1.01 < high
    assert 0 < carried["confirmed"]["detectable"] < 10
    stale("compile", *AT)
    assert codes(stale) == dict.fromkeys(VERBS, 0)
    manifest = YAML(typ="safe", pure=True).load(stale.read(MANIFEST))
    assert manifest["evidence"]["carried"][0]["confirmed"]["sample"] == carried["confirmed"]["sample"]
    assert "confirmed" in [one["code"] for one in manifest["warnings"]]
    said = stale("replay", "demo", *REPLAY, run=lab.main)
    assert "0 of 4 samples to measure" in said.err, "they count, so there is nothing to confirm"


def test_outside_of_it_they_stay_stale_and_the_measurement_is_kept(stale: Shell) -> None:
    before = measured_files.text(stale.folder / "results/demo")
    stale.write("sweep.csv", SWEEP.format(9, 9))
    said = stale("replay", "demo", *REPLAY, code=3, run=lab.main)
    assert "not confirmed: demo: the older results stay stale" in said.err
    assert "next: fogspec-lab replay demo --from sweep.csv\n" in said.out, "the command that measures the others"
    assert measured_files.text(stale.folder / "results/demo.old-1") == before
    after = results(stale)["spec"]
    assert [one["latency"]["mean"] for one in after["samples"]] == ["9s"]
    assert "carried" not in after
    stale("compile", *AT, code=None)
    found = json.loads(stale("status", "-o", "json").out)[0]
    assert found["to_measure"] == 3, "the new sample is the plan's"
    said = stale("replay", "demo", *REPLAY, run=lab.main)
    assert "3 of 4 samples to measure" in said.err
    assert [one["latency"]["mean"] for one in results(stale)["spec"]["samples"]] == ["2.5s", "2.5s", "9s", "9s"]
    stale("compile", *AT)
    stale("check")


def test_a_machine_that_is_not_to_be_had_decides_nothing(stale: Shell) -> None:
    before = results(stale)["spec"]
    stale.write("sweep.csv", "instance_type,latency_s\nother,1\n")
    said = stale("replay", "demo", *REPLAY, code=1, run=lab.main)
    assert "demo: no sample could be measured" in said.err
    assert "aws-r1-a-large: failed" in said.out
    assert "next: " not in said.out
    assert results(stale)["spec"] == before


def test_it_says_the_price_and_the_test_first_and_asks(stale: Shell) -> None:
    before = measured_files.text(stale.folder / "results/demo")
    stale.write("sweep.csv", SWEEP.format(1, 1))
    said = stale("replay", "demo", *REPLAY, "--dry-run", run=lab.main)
    assert "can pass, as can one on other machines only" in said.err
    assert measured_files.text(stale.folder / "results/demo") == before


def test_after_what_defines_the_figures_all_samples_are_measured(stale: Shell) -> None:
    stale.write("specs/demo.yaml", stale.read("specs/demo.yaml").replace("callback: plan", "callback: other"))
    stale("compile", *AT)
    measured_again(stale)


def test_with_all_and_after_another_runner_all_samples_are_measured(stale: Shell) -> None:
    before = read_results_folder(stale.folder / "results/demo").spec
    measured_again(stale, "--all")
    measured_files.write(stale.folder / "results/demo", before)
    edited(stale, lambda _: {"runner": "local"})
    measured_again(stale)


def measured_again(stale: Shell, *words: str) -> None:
    """All samples of the plan are measured, and none of before counts."""
    stale.write("sweep.csv", SWEEP.format(1.01, 1.01))
    said = stale("replay", "demo", *words, *REPLAY, run=lab.main)
    assert "4 of 4 samples to measure" in said.err
    assert "a folder demo.old-… beside it" in said.err
    found = results(stale)["spec"]
    assert len(found["samples"]) == 4
    assert "carried" not in found


def test_a_failure_of_the_older_results_leaves_nothing_to_compare(stale: Shell) -> None:
    def failed(one: Measured) -> Measured:
        return one.model_copy(update={"state": "failed", "reason": "crash", "latency": None})

    edited(stale, lambda body: {"samples": list(map(failed, body.samples))})
    measured_again(stale)


def test_a_change_that_is_waived_is_confirmed_with_the_others(stale: Shell) -> None:
    waiver = "waivers: [{change: 'spec.cloud[0].env.LOG', new: debug, reason: only a log}]"
    spec = stale.read("specs/demo.yaml").replace("work.py]}", "work.py], env: {LOG: debug}}")
    stale.write("specs/demo.yaml", spec.replace("sampler: grid", f"sampler: grid, {waiver}"))
    stale("compile", *AT)
    stale.write("sweep.csv", SWEEP.format(1.01, 1.01))
    stale("replay", "demo", *REPLAY, run=lab.main)
    (carried,) = results(stale)["spec"]["carried"]
    assert carried["confirmed"]["changes"] == ["spec.cloud[0].env.LOG: none -> debug", "work.py changed"]


def test_all_and_only_are_wrong_usage(shell: Shell) -> None:
    project(shell)
    shell.write("sweep.csv", SWEEP.format(1, 1))
    said = shell("replay", "demo", "--all", "--only", "aws-r1-a-small", *REPLAY, code=2, run=lab.main)
    assert "--all and --only exclude each other" in said.err
    assert "4 of 4 samples to measure" in shell("replay", "demo", "--dry-run", *REPLAY, run=lab.main).err


def test_a_write_that_fails_loses_no_measurement(stale: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    stale.write("sweep.csv", SWEEP.format(1.01, 1.01))
    before = results(stale)["spec"]
    with monkeypatch.context() as broken:
        broken.setattr(ResultsFile, "write", full_disk)
        stale("replay", "demo", *REPLAY, code=1, run=lab.main)
    assert results(stale)["spec"] == before
    stale.write("sweep.csv", SWEEP.format(9, 9))
    said = stale("replay", "demo", *REPLAY, run=lab.main)
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
    ended = scene.bench()
    assert "2cpu-1gib to measure once more with the local runner: costs nothing" in ended.stderr
    after = scene.records()
    if ended.returncode == 0:
        assert len(after) == 3
        assert before.items() <= after.items()
    else:
        assert "the older results stay stale" in ended.stderr
        assert list(after) == ["local-2cpu-1gib"]
        assert (scene.folder / "results" / "tiny.old-1").is_dir()
    for record in after.values():
        assert (scene.results / "timings" / f"{record['id']}.jsonl.gz").exists()
    measured = 7 if ended.returncode else 0  # of the two shapes, one or both
    assert scene.run("compile").returncode == measured
    assert scene.run("check").returncode == (3 if measured else 0)
