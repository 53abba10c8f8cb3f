"""A limit is hard: no manifest below the required probability, and what one more sample or another limit would change."""

import json
import re

import pytest

from fogspec.results.io import read_results_folder
from fogspec_lab import cli as lab
from tests.corners.test_weak_samples import BOX, sample, write
from tests.support.running import Ended, Shell, project, shell, spec  # noqa: F401

COMPILE = ("compile", "specs/demo.yaml", "--catalog", "offers.csv")
LIST = "{budget: $5, machines: [a.small, a.large], stop: {requests: 20, duration: 1min}}"


def measured(shell: Shell, *seconds: tuple[str, float], code: int, **parts: str) -> Ended:
    """What compile says of these latencies, of a list of two machines."""
    project(shell, **(BOX | {"benchmark": LIST} | parts))
    write(shell, [sample(name, latency) for name, latency in seconds])
    return shell(*COMPILE, code=code)


def replay(shell: Shell, *words: str, code: int = 0) -> Ended:
    return shell("replay", "specs/demo.yaml", "--from", "sweep.csv", *words, code=code, run=lab.main)


def opened(shell: Shell) -> dict:
    [found] = json.loads(shell(*COMPILE, "-o", "json", code=None).out)
    return found["menu"]["open"]


CLOSE = [("a.small", 3.0), ("a.large", 0.965)]


def test_one_more_sample_settles_it_in_the_next_bench(shell: Shell) -> None:
    """Just within the limit: the error of one sample and another server need more room than there is."""
    ended = measured(shell, *CLOSE, code=7, constraints="{latency: 1s}", objective="{alpha: 0}")
    found = opened(shell)
    assert found["cause"] == "one sample"
    assert found["instance"] == "a.large"
    assert 0.5 < found["probability"] < 0.9
    assert "error: demo: not settled: one more sample may decide" in ended.err
    assert re.search(r"  a.large in aws/r1: P\(all limits\) 0.\d+, required 0.9\n", ended.out)
    assert "  a sample of it costs at most $" in ended.out
    assert max(map(len, (ended.out + ended.err).split("\n"))) <= 80
    assert "next: fogspec bench specs/demo.yaml" in ended.out
    assert not (shell.folder / "compiled/demo/manifest.yaml").exists()
    for verb in ("menu", "explain"):
        assert "not settled: one more sample may decide" in shell(verb, "specs/demo.yaml", code=None).out
    assert "next: fogspec bench specs/demo.yaml" in shell("status").out
    quoted = shell("bench", "specs/demo.yaml", "--dry-run", code=None)
    assert "demo: a sample of a.large besides the plan: at most $0." in quoted.out + quoted.err


def test_where_no_sample_tells_its_error_more_of_them_decide_nothing(shell: Shell) -> None:
    """Samples with too few requests: more requests help, not more samples, and there is no range of nothing."""
    project(shell, **(BOX | {"benchmark": LIST, "constraints": "{latency: 0.9s}"}))
    write(shell, [sample(name, latency, errors={}) for name, latency in CLOSE])
    ended = shell(*COMPILE, code=7)
    assert opened(shell)["cause"] == "unknown"
    assert "not settled: too few requests to say how sure their mean is" in ended.err
    assert "raise spec.benchmark.stop" in ended.out
    assert "how far the mean of aws-r1-a-small, aws-r1-a-large is" in ended.err + ended.out
    assert "[" not in ended.out
    assert "next: fogspec bench" not in ended.out
    assert "a sample of" not in shell("bench", "specs/demo.yaml", "--dry-run").out
    project(shell, **(BOX | {"benchmark": LIST, "constraints": "{latency: 1s, confidence: none}"}))
    shell(*COMPILE)
    assert "too few requests to say how sure" in shell.read("compiled/demo/menu.svg")


@pytest.mark.parametrize(("again_s", "code"), [(0.93, 0), (0.98, 4)])
def test_the_sample_past_the_plan_decides(shell: Shell, again_s: float, code: int) -> None:
    shell.write("sweep.csv", f"instance_type,latency_s\na.small,3\na.large,{again_s}\n")
    project(shell, **(BOX | {"benchmark": LIST, "constraints": "{latency: 1s}"}))
    replay(shell)
    records = read_results_folder(shell.folder / "results/demo").spec.samples
    assert len(records) == 2
    for _ in range(6):
        ended = shell(*COMPILE, code=None)
        if ended.code != 7:
            break
        replay(shell)
    assert ended.code == code
    repeats = [one.id for one in read_results_folder(shell.folder / "results/demo").spec.samples[2:]]
    assert repeats == [f"aws-r1-a-large-repeat-{nth}" for nth in range(2, len(repeats) + 2)]
    assert (shell.folder / "compiled/demo/manifest.yaml").exists() == (code == 0)
    shell("check", "specs/demo.yaml")
    if code:
        assert "too little room: no machine meets the limits surely enough" in ended.err
        assert "  a.large in aws/r1: P(all limits) 0." in ended.out
        assert re.search(
            r"it would meet confidence: 0.\d+ or latency: .* s in spec.constraints", " ".join(ended.out.split())
        )


def test_what_a_way_out_names_is_one(shell: Shell) -> None:
    measured(shell, *CLOSE, code=7, constraints="{latency: 1s}")
    found = opened(shell)
    for limit in (f"latency: {found['needs_s'] * 1.001:.4f}s", f"latency: 1s, confidence: {found['probability']}"):
        measured(shell, *CLOSE, code=0, constraints=f"{{{limit}}}")


def test_a_limit_that_all_machines_miss_is_too_slow(shell: Shell) -> None:
    measured(shell, *CLOSE, code=7, constraints="{latency: 1s}")
    # What is paid already may stay in the list.
    narrower = {"benchmark": LIST, "constraints": "{latency: 100ms}", "hardware": "{cpus: 8..8}"}
    shell.write("specs/demo.yaml", spec(**(BOX | narrower)))
    ended = shell(*COMPILE, code=4)
    assert "too slow: no machine meets the limits, and no sample changes this" in ended.err
    assert opened(shell)["cause"] == "too slow"


def test_without_the_money_for_it_too_little_is_known(shell: Shell) -> None:
    measured(shell, *CLOSE, code=7, constraints="{latency: 1s}")
    for at in (shell.folder / "specs/demo.yaml",):
        at.write_text(at.read_text().replace("budget: $5", "budget: $0.02"))
    ended = shell(*COMPILE, code=4)
    assert "too little known: the budget does not pay for one more sample" in ended.err
    assert "raise spec.benchmark.budget" in ended.out


def test_a_manifest_from_before_a_tighter_limit_stays_and_is_refused(shell: Shell) -> None:
    measured(shell, *CLOSE, code=0, constraints="{latency: 1.5s}")
    manifest = shell.read("compiled/demo/manifest.yaml")
    spec = shell.folder / "specs/demo.yaml"
    spec.write_text(spec.read_text().replace("latency: 1.5s", "latency: 1s"))
    ended = shell(*COMPILE, code=7)
    assert "stale: it stays, and apply refuses it" in ended.out
    assert shell.read("compiled/demo/manifest.yaml") == manifest
    shell("check", "specs/demo.yaml", code=3)
    shell("apply", "demo", "--dry-run", code=3)
    assert "next: fogspec bench specs/demo.yaml" in shell("status", code=None).out


def test_confidence_none_is_decided_by_predicted_values_and_said(shell: Shell) -> None:
    ended = measured(shell, *CLOSE, code=0, constraints="{latency: 1s, confidence: none}", objective="{alpha: 0}")
    assert "! warning: constraints.confidence: none: the probability that a.large meets the limits is 0." in ended.out
    manifest = shell.read("compiled/demo/manifest.yaml")
    assert 'confidence: "none"' in manifest
    assert "code: no_confidence" in manifest


def test_shapes_of_this_host_settle_nothing_about_machines_to_rent(shell: Shell) -> None:
    parts = {
        "benchmark": "{machines: [local/1cpu-1gib], stop: {requests: 20, duration: 1min}}",
        "constraints": "{latency: 9s}",
    }
    project(shell, **parts)
    shell.write("sweep.csv", "instance_type,latency_s\n1cpu-1gib,0.5\n")
    replay(shell)
    ended = shell(*COMPILE, code=7)
    assert "not settled: nothing was measured on machines on offer" in ended.err
    assert "set spec.constraints.confidence: none" in ended.out.replace("\n            ", " ")
    spec = shell.folder / "specs/demo.yaml"
    spec.write_text(spec.read_text().replace("latency: 9s", "latency: 9s, confidence: none"))
    shell(*COMPILE)
