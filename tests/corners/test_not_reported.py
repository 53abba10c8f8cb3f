"""What a spec expects of requests and no request reports ends the first sample, with what was reported instead."""

import gzip
import re
from pathlib import Path

import pytest

from tests.corners.test_at_once import AT, Together, bench, cloud, listed, results  # noqa: F401
from tests.e2e.test_bench import FIRST, SECOND
from tests.support.running import Shell, shell, spec  # noqa: F401
from tests.support.scenes import SPEC, WORK, Scene

SAYS = WORK.replace('stop("work")', 'stop("work", quality=0.5, speed=2)')
MISSPELT = SPEC.replace("  constraints:", "  metrics: {quality: {callback: qualty}}\n  constraints:").replace(
    "requests: 10", "requests: 100000"
)
NAMED = MISSPELT.replace("qualty", "quality").replace("requests: 100000", "requests: 10")


def scene_of(folder: Path, work: str = SAYS, text: str = MISSPELT) -> Scene:
    return Scene.made(folder / "scene", work, text)


def test_a_misspelt_metric_ends_the_first_sample_and_starts_no_other(tmp_path: Path) -> None:
    scene = scene_of(tmp_path)
    ended = scene.bench()
    assert ended.returncode == 1, ended.stderr
    [(name, record)] = scene.records().items()
    assert (name, record["state"], record["reason"], record["metrics"]) == (FIRST, "failed", "not_reported", {})
    said = "no value of metric quality as qualty: the node reported quality"
    assert (record["detail"], 20 <= record["requests"] < 100_000) == (said, True)
    kept = gzip.decompress((scene.results / "timings" / f"{record['id']}.jsonl.gz").read_bytes())
    assert kept.count(b'"quality": 0.5') >= 20, "what was paid is kept"
    assert scene.started() == [FIRST]
    assert said in ended.stdout
    assert "fix: specs/tiny.yaml:8:13: set spec.metrics.quality.callback: quality\n" in ended.stdout
    assert f"not measured: {SECOND}" in ended.stdout
    again = scene.bench()
    assert (again.returncode, scene.started()) == (1, [FIRST, FIRST]), "it cost nothing; no other is measured in vain"
    assert said in again.stdout


@pytest.mark.parametrize("where", ["spec", "node"])
def test_all_is_measured_once_the_name_is_corrected(tmp_path: Path, where: str) -> None:
    scene = scene_of(tmp_path)
    scene.bench()
    if where == "spec":
        scene.spec.write_text(NAMED)
        assert scene.run("compile").returncode == 0
    else:
        text = MISSPELT.replace("requests: 100000", "requests: 10")
        scene = scene_of(tmp_path / "other", text=text)
        ended = scene.bench()
        assert ended.returncode == 1, "a slip is certain in fewer requests, too, once the sample is over"
        only = f"fogspec bench specs/tiny.yaml --runner local --only {FIRST}"
        assert f"again: fogspec compile specs/tiny.yaml; {only}\n" in ended.stdout
        (scene.folder / "specs" / "work.py").write_text(SAYS.replace("quality=", "qualty="))
        assert scene.run("compile").returncode == 0
        assert scene.bench("--only", FIRST).returncode == 0
    assert scene.bench().returncode == 0
    records = scene.records()
    assert {one["state"] for one in records.values()} == {"ok"}
    assert {one["metrics"]["quality"] for one in records.values()} == {0.5}
    assert set(records) == {FIRST, SECOND}


def test_a_rare_metric_may_be_missing_in_a_short_sample_which_says_so(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, WORK.replace("while True", "for _ in range(12)"), NAMED)
    assert scene.bench().returncode == 0
    assert [(one["state"], one["detail"]) for one in scene.records().values()] == [
        ("ok", "no value of metric quality: the node reported no other")
    ] * 2


@pytest.mark.parametrize(("weight", "code"), [(1, 1), (0.05, 0)])
def test_a_scenario_is_missed_if_some_of_it_were_to_be_expected(tmp_path: Path, weight: float, code: int) -> None:
    scenarios = f"  benchmark:\n    scenarios: {{easy: 1, hard: {weight}}}\n"
    text = SPEC.replace("  benchmark:\n", scenarios).replace("requests: 10,", "requests: 80,")
    work = WORK.replace("import time\n", "import itertools, time\n").replace("while True", "for n in itertools.count()")
    says = f'stop("work", scenario="hard" if n == 70 and {not code} else "easy")'
    scene = scene_of(tmp_path, work.replace('stop("work")', says), text)
    ended = scene.bench()
    assert ended.returncode == code
    assert ("fix: specs/tiny.yaml:12:32: name what" in ended.stdout) == bool(code)
    assert scene.started() == ([FIRST] if code else [FIRST, SECOND])
    if code:
        detail = scene.records()[FIRST]["detail"]
        assert detail == "no request of scenario hard: the node reported no other"


def test_a_misspelt_probe_starts_no_other_sample(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, WORK.replace('"work"', '"wrok"'), SPEC)
    ended = scene.bench()
    assert (ended.returncode, scene.started()) == (1, [FIRST])
    assert "no request named 'work' was timed, only 'wrok'" in ended.stdout
    assert "fix: specs/tiny.yaml:7:3" in ended.stdout


@pytest.mark.slow
@pytest.mark.parametrize("sampler", ["grid", "adaptive"])
def test_samples_that_wait_for_others_are_not_started(shell: Shell, cloud: Together, sampler: str) -> None:
    listed(shell, 5)
    text = shell.read("specs/demo.yaml").replace(
        "  constraints:", "  metrics: {quality: {callback: q}}\n  constraints:"
    )
    text = text.replace("requests: 5", "requests: 30").replace("sampler: grid", f"sampler: {sampler}")
    shell.write("specs/demo.yaml", re.sub("machines: .*?], ", "" if sampler == "adaptive" else r"\g<0>", text))
    shell("compile", "specs/demo.yaml", *AT)
    cloud.wanted = 3
    said = bench(shell, "--at-once", "3", code=1)
    found = [one["reason"] for one in results(shell)["samples"]]
    assert found == ["not_reported"] * len(found)
    assert 1 <= len(found) <= cloud.most <= 3, "the first alone, and those that started while it measured"
    assert "no value of metric quality as q: the node reported no other" in said.out
    assert all(one["spent"] != "$0" for one in results(shell)["samples"])
    assert said.out.count("    kept, it cost $") == len(found)
    assert cloud.machines == {}
