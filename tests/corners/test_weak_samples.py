"""Too few, failed, equal, absurd or contradictory samples: a clear error or a marked weak answer, never a sure wrong one."""

import functools
import json
import math
import re
from collections.abc import Callable, Sequence
from typing import Any

import pytest
import yaml

from fogspec.catalog.machine import Gpu, Machine
from fogspec.language import warned
from fogspec.language.fingerprints import measured_record
from fogspec.language.loader import load
from fogspec.language.lock_io import files_sent
from fogspec.model.fit import partition
from fogspec.results.schema import LatencySummary, Measured, ResourceUse, ResultsBody
from fogspec_lab import cli as lab
from tests.support.results import write as write_results
from tests.support.running import Shell, project, shell  # noqa: F401

SHAPES = {"a.small": (2, 4, 0.1), "a.large": (8, 16, 0.4), "a.huge": (32, 64, 1.6), "b.small": (2, 8, 0.12),
          "b.large": (8, 32, 0.48), "b.huge": (32, 128, 1.92), "g.small": (4, 16, 0.6)}  # fmt: skip
LONG = "{budget: $50, stop: {requests: 20, duration: 2h}}"
BOX = {"hardware": "{cpus: 2..32}"}


def sample(instance: str, latency: float | None, tag: str = "", **more: Any) -> Measured:
    cpus, memory, price = SHAPES.get(instance, (4, 4, 0.2))
    gpu = Gpu(name="T4", count=1) if instance.startswith("g.") else None
    machine = Machine(infra="aws/r1", instance=instance, cpus=cpus, memory=memory, gpu=gpu, price=price)
    summary = None if latency is None else LatencySummary(mean=latency, sd=latency / 20)
    base = {"state": "ok", "requests": 20, "duration": 60.0, "spent": 0.01, "measured_on": "test"}
    if latency is not None:
        base["errors"] = {"mean": 1 / 20 / math.sqrt(20)}
    return Measured(id=f"aws-r1-{instance.replace('.', '-')}{tag}", machine=machine, latency=summary, **(base | more))


def write(shell: Shell, records: Sequence[Measured]) -> None:
    (loaded,) = load([str(shell.folder / "specs/demo.yaml")])
    inputs = measured_record(loaded.application, None, files_sent(loaded.application, loaded.layout))
    body = ResultsBody(inputs=inputs, runner="local", samples=list(records))
    write_results(shell.folder / "results/demo", body)


def compiled(shell: Shell, records: Sequence[Measured], code: int = 0, **parts: str) -> dict[str, Any]:
    """What compile says of these samples, which are all that there will be."""
    project(shell, **(BOX | parts))
    write(shell, records)
    ended = shell("compile", "specs/demo.yaml", "--catalog", "offers.csv", "--partial", "-o", "json", code=code)
    assert "Traceback" not in ended.err
    [found] = json.loads(ended.out)
    return found


def explained(shell: Shell, code: int = 0) -> dict[str, Any]:
    shell("explain", "specs/demo.yaml", code=code)
    ended = shell("explain", "specs/demo.yaml", "-o", "json", code=code)
    return json.loads(ended.out)[0]


def test_one_sample_chooses_what_was_measured_or_says_that_it_did_not(shell: Shell) -> None:
    found = compiled(shell, [sample("a.small", 3.0)], benchmark="{budget: $5, sampler: adaptive}")
    chosen = found["menu"]["balanced"]
    assert chosen["instance"] == "a.small"
    assert chosen["measured"]
    others = [one for one in found["menu"]["front"] if not one["measured"]]
    assert all(one["extrapolated"] for one in others)
    assert explained(shell)["next_sample"]["cost_usd"] > 0


def test_one_sample_of_a_grid_is_marked_where_the_choice_was_not_measured(shell: Shell) -> None:
    found = compiled(shell, [sample("a.small", 3.0)])
    chosen = found["menu"]["balanced"]
    assert chosen["measured"] or coded(found, "not_verified")[0]["extrapolated"]


def test_fewer_samples_than_parameters_have_wide_intervals(shell: Shell) -> None:
    found = compiled(shell, [sample("a.small", 3.0), sample("a.large", 1.0)])
    unmeasured = [one for one in found["menu"]["front"] if not one["measured"]]
    spread = [one["interval_s"][1] / one["interval_s"][0] for one in unmeasured]
    assert all(ratio > 1.1 for ratio in spread)
    assert [one["samples"] for one in coded(found, "few_samples")] == [2]


@pytest.mark.parametrize("state", ["failed", "timeout"])
def test_all_failed_is_no_choice(shell: Shell, state: str) -> None:
    failed = [
        sample(name, None, state=state, reason="crash" if state == "failed" else None) for name in list(SHAPES)[:6]
    ]
    found = compiled(shell, failed, code=7)
    assert found["manifest"] is None
    assert found["menu"]["predicted"] == 0
    assert len(coded(found, "sample_rejected")) == len(failed)
    assert explained(shell)["next_sample"] is None


def test_a_run_that_was_given_up_is_a_lower_bound(shell: Shell) -> None:
    good = [sample("a.large", 1.0), sample("b.large", 1.0)]
    waited = sample("a.small", None, state="timeout", latency_lower_bound=60.0)
    alone = compiled(shell, good)
    with_bound = compiled(shell, [*good, waited])
    small = [next((e for e in one["menu"]["front"] if e["instance"] == "a.small"), None) for one in (alone, with_bound)]
    assert small[0] is not None
    assert small[1] is None or small[1]["latency_s"] > small[0]["latency_s"]
    assert all(e["instance"] != "a.small" or not e["meets"] for e in with_bound["menu"]["front"])


def test_all_equal_is_the_cheapest(shell: Shell) -> None:
    found = compiled(shell, [sample(name, 2.0) for name in list(SHAPES)[:6]])
    assert found["menu"]["balanced"]["instance"] == "a.small"


@pytest.mark.parametrize("latency", [0.0, -1.0])
def test_a_latency_of_nothing_does_not_count(shell: Shell, latency: float) -> None:
    bad = sample("b.small", 1.0)
    bad = bad.model_copy(
        update={"latency": LatencySummary.model_construct(mean=latency, sd=None, p50=None, p95=None, p99=None)}
    )
    project(shell, **BOX)
    write(shell, [sample("a.small", 3.0), sample("a.large", 1.0), bad])
    ended = shell("compile", "specs/demo.yaml", "--catalog", "offers.csv", "--partial", code=None)
    assert ended.code in (0, 1)
    assert "Traceback" not in ended.err
    said = ended.out + ended.err
    assert "is not a latency" in said or "results/demo" in said


def test_an_infinite_latency_is_no_number(shell: Shell) -> None:
    project(shell, **BOX)
    write(shell, [sample("a.small", 3.0), sample("a.large", 1.0)])
    path = next(path for path in sorted((shell.folder / "results/demo").iterdir()) if "mean: 3s" in path.read_text())
    path.write_text(path.read_text().replace("mean: 3s", "mean: .inf"))
    ended = shell("compile", "specs/demo.yaml", "--catalog", "offers.csv", code=1)
    assert f"results/demo/{path.name}:" in ended.err


def test_repeats_that_contradict_each_other_widen_the_interval(shell: Shell) -> None:
    base = [sample("a.large", 1.0), sample("b.large", 1.0), sample("b.small", 3.0)]
    agreed = compiled(shell, [*base, sample("a.small", 2.0), sample("a.small", 2.02, "-again")])
    doubtful = compiled(shell, [*base, sample("a.small", 1.3), sample("a.small", 3.0, "-again")])

    def width(found: dict[str, Any]) -> float:
        low, high = next(e for e in found["menu"]["front"] if e["instance"] == "a.small")["interval_s"]
        return math.log(high / low)

    assert width(doubtful) > 1.5 * width(agreed)


def test_a_machine_far_off_from_all_others_is_as_it_was_measured(shell: Shell) -> None:
    """It swaps: sixty times as slow as its kin, and must not be chosen for what its kin do."""
    swaps = sample("a.huge", 60.0)
    others = [sample("a.small", 3.0), sample("b.small", 3.0), sample("b.large", 1.0), sample("b.huge", 0.5)]
    found = compiled(shell, [*others, swaps], objective="{alpha: 1}")
    assert found["menu"]["balanced"]["instance"] == "b.huge"
    assert found["menu"]["balanced"]["latency_s"] == pytest.approx(0.5, rel=0.1)


def test_a_measured_machine_that_the_catalog_does_not_have(shell: Shell) -> None:
    found = compiled(shell, [sample("a.small", 3.0), sample("gone.medium", 2.0), sample("b.large", 1.0)])
    assert found["menu"]["balanced"] is not None
    assert all(one["instance"] != "gone.medium" for one in found["menu"]["front"])


def test_no_sample_of_a_gpu_type_is_never_sure_of_it(shell: Shell) -> None:
    found = compiled(shell, [sample(name, 3.0) for name in ("a.small", "a.large", "a.huge")], hardware="{gpus: [none, T4]}",
                     constraints="{latency: 2s}", code=7)  # fmt: skip
    assert found["menu"]["balanced"] is None
    told = explained(shell)
    assert told["likeliest"]["instance"].startswith("g.")
    assert 0.05 < told["likeliest"]["probability_met"] < 0.5
    assert told["next_sample"]["cost_usd"] > 0
    assert found["menu"]["open"]["instance"] == told["next_sample"]["instance"]


def test_below_the_asked_confidence_there_is_no_choice(shell: Shell) -> None:
    records = [sample("a.small", 3.0), sample("b.small", 3.0), sample("a.huge", 0.6)]
    limits = "{latency: 1.1s, confidence: 0.99}"
    found = compiled(shell, records, 7, hardware="{cpus: 8..8}", constraints=limits)
    assert found["menu"]["balanced"] is found["manifest"] is None
    assert found["menu"]["open"]["probability"] < 0.99


def test_spot_pays_for_its_interruptions(shell: Shell) -> None:
    records = [sample(name, 600.0) for name in ("a.small", "a.large", "b.small", "b.large")]
    calm = compiled(shell, records, hardware="{cpus: 2..8, spot: 0.01/h, startup: 1min}", constraints="{latency: 1h}",
                    benchmark=LONG, objective="{alpha: 0}")  # fmt: skip
    wild = compiled(shell, records, hardware="{cpus: 2..8, spot: 10/h, startup: 30min}", constraints="{latency: 1h}",
                    benchmark=LONG, objective="{alpha: 0}")  # fmt: skip
    assert calm["menu"]["balanced"]["spot"]
    assert not wild["menu"]["balanced"]["spot"]


def test_data_transfer_is_part_of_the_cost(shell: Shell) -> None:
    records = [sample("a.small", 3.0), sample("a.large", 1.0)]
    without = compiled(shell, records)["menu"]["balanced"]["cost_usd_per_request"]
    moved = compiled(shell, records, objective="{transfer: $0.09/request}")["menu"]["balanced"]["cost_usd_per_request"]
    assert moved - without == pytest.approx(0.09, abs=1e-3)


def suite(shell: Shell) -> list[str]:
    """Write a suite of six programs on the usual machines; return the lines of its latencies."""
    machines = ["Cloud,InstanceType,vCPUs,MemoryGiB,Price"]
    machines += [f"aws,{name},{c},{m},{p}" for name, (c, m, p) in SHAPES.items() if not name.startswith("g.")]
    rows = ["workload,suite,cloud,instance_type,latency_s"]
    for number in range(6):
        rows += [f"w{number},s{number},aws,{name},{1 + (number + 1) / c}" for name, (c, _, _) in SHAPES.items()
                 if not name.startswith("g.")]  # fmt: skip
    shell.write("suite/machines.csv", "\n".join([*machines, ""]))
    shell.write("suite/latencies.csv", "\n".join([*rows, ""]))
    return rows


def test_a_machine_library_is_named_in_models_and_manifest(shell: Shell) -> None:
    rows = suite(shell)
    records = [sample("a.small", 3.0), sample("a.large", 1.5)]
    compiled(shell, records)
    assert "library:" not in shell.read("compiled/demo/models.yaml")
    shell("library", "--from", "suite", "--out", "specs/library.json", run=lab.main)
    compiled(shell, records, library="library.json")
    (row,) = [line.strip() for line in shell.read("compiled/demo/models.yaml").splitlines() if "library:" in line]
    assert row.startswith("library: sha256:")
    assert row in shell.read("compiled/demo/manifest.yaml")
    shell("compile", "specs/demo.yaml", "--partial")
    assert row in shell.read("compiled/demo/manifest.yaml")
    shell("check", "specs/demo.yaml")
    shell.write("suite/latencies.csv", "\n".join([*rows, "w0,s0,aws,b.huge,9", ""]))
    shell("library", "--from", "suite", "--out", "specs/library.json", run=lab.main)
    assert "library changed" in shell("check", code=3).out
    whole = json.loads(shell.read("specs/library.json"))
    empty = {**whole, "instance": []}
    many = {**whole, "programs": [{**whole["programs"][0], "name": str(i)} for i in range(501)]}
    cpus = json.dumps(whole).replace('"vcpus"', '"cpus"')
    for content in ("nonsense", "{}", cpus, json.dumps(empty), json.dumps(many)):
        shell.write("specs/library.json", content)
        assert "specs/library.json: not a machine library: " in shell("compile", "specs/demo.yaml", code=1).err
    (shell.folder / "specs/library.json").unlink()
    for verb in ("validate", "compile"):
        assert "spec.library names library.json, which is not there" in shell(verb, "specs/demo.yaml", code=1).err
    compiled(shell, records, library="none")
    assert "library:" not in shell.read("compiled/demo/models.yaml")


def test_explain_says_what_the_confidence_costs(shell: Shell) -> None:
    """The cheapest machine lies just within the limit: a lower confidence would take it, a higher one nothing at all."""
    measured = [sample("a.small", 0.965), sample("b.large", 0.6), sample("a.large", 0.61), sample("b.small", 1.1)]
    compiled(shell, measured, constraints="{latency: 1s}", objective="{alpha: 0}")
    said = " ".join(shell("explain", "specs/demo.yaml", "-v").out.split())
    assert "at confidence 0.8 the choice would be a.small, 46% cheaper, " in said
    [lower] = explained(shell)["confidences"]
    assert (lower["confidence"], lower["instance"]) == (0.8, "a.small")
    assert lower["cost_ratio"] == pytest.approx(0.965 * (0.1 + 0.055) / 0.61 / (0.4 + 0.055), rel=0.05)


def test_samples_against_the_ranges_widen_predictions_and_what_was_assumed_is_said(shell: Shell) -> None:
    odd = (3.0, 1.1, 0.24, 5.2, 0.5, 0.41)
    names = ("a.small", "a.large", "a.huge", "b.small", "b.large", "b.huge")
    means = [replaced(sample(name, seconds)) for name, seconds in zip(names, odd, strict=True)]
    found = compiled(shell, means)
    [assumed] = coded(found, "spread_unknown")
    predicted = yaml.safe_load(shell.read("compiled/demo/models.yaml"))["spec"]["predictions"]["latency"]
    assert predicted["widening"] > 1
    assert predicted["left_out"].keys() == predicted["machines"].keys()
    assert (assumed["samples"], assumed["of"], assumed["assumed_error"]) == (6, 6, 0.025)
    manifest = yaml.safe_load(shell.read("compiled/demo/manifest.yaml"))
    assert {name: value for name, value in assumed.items() if name != "text"} in manifest["warnings"]
    spread = compiled(shell, [sample(name, 4 / SHAPES[name][0]) for name in names])
    assert not coded(spread, "spread_unknown")
    models = yaml.safe_load(shell.read("compiled/demo/models.yaml"))["spec"]
    assert models["predictions"]["latency"]["widening"] == 1


def test_another_wording_changes_no_file(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled(shell, [sample("a.small", 3.0), sample("a.large", 1.0), sample("b.large", 1.1)])
    kept = {path: path.read_bytes() for path in (shell.folder / "compiled").rglob("*.yaml")}
    text = shell("explain", "specs/demo.yaml").out
    reworded = {name: _reworded(one) for name, one in warned.CODES.items()}
    monkeypatch.setattr(warned, "CODES", reworded)
    warned._checked.cache_clear()
    try:
        assert shell("explain", "specs/demo.yaml").out.count("in other words") == text.count("warning: ") > 0
        shell("compile", "specs/demo.yaml", "--catalog", "offers.csv", "--partial")
        assert {path: path.read_bytes() for path in (shell.folder / "compiled").rglob("*.yaml")} == kept
    finally:
        warned._checked.cache_clear()


def _reworded(code: Callable[..., str]) -> Callable[..., str]:
    @functools.wraps(code)
    def other(**values: Any) -> str:
        return f"in other words: {code(**values)}"

    return other


def coded(found: dict[str, Any], code: str) -> list[dict[str, Any]]:
    """The warnings of a menu with this code."""
    return [one for one in found["menu"]["warnings"] if one["code"] == code]


def replaced(one: Measured) -> Measured:
    """The sample with its mean alone."""
    assert one.latency is not None
    return one.model_copy(update={"latency": LatencySummary(mean=one.latency.mean), "errors": None})


def use(outside: float | None) -> ResourceUse:
    """What a sample used while others took this fraction of its CPUs."""
    return ResourceUse(
        window=10.0, vcpus=2.0, cpu_mean=1.0, cpu_max=2.0, outside=outside, memory_peak=1.0, minor_faults=0,
        major_faults=0, overhead=0.0,
    )  # fmt: skip


def test_a_contended_sample_is_named_wherever_it_counts_and_its_error_is_widened(shell: Shell) -> None:
    names = ("a.small", "a.large", "b.small", "b.large")
    samples = [sample(name, 8 / SHAPES[name][0], resources=use(0.05)) for name in names]
    assert not coded(compiled(shell, samples), "contended")
    errors = errors_of(samples)
    samples[0] = samples[0].model_copy(update={"resources": use(0.34)})
    found = compiled(shell, samples)
    taken = "contended: other processes took 34% of its CPU time, so its mean of 4 s counts for less"
    again = "measure it again while the machine is idle: fogspec bench APP --only aws-r1-a-small"
    warning = f"sample aws-r1-a-small: {taken}: {again}"
    assert [one["text"] for one in coded(found, "contended")] == [warning]
    values = {"code": "contended", "sample": "aws-r1-a-small", "cpu_time": 0.34, "mean_s": 4.0}
    assert values in yaml.safe_load(shell.read("compiled/demo/manifest.yaml"))["warnings"]
    text = shell("compile", "specs/demo.yaml", "--catalog", "offers.csv", "--partial").out
    assert f"warning: {warning}" in text
    for picture in ("menu", "latency"):
        drawn = " ".join(re.sub("<[^>]*>", " ", shell.read(f"compiled/demo/{picture}.svg")).split())
        assert f"⚠ {warning}" in drawn
    widened = errors_of(samples)
    assert widened["aws-r1-a-small"] == pytest.approx(math.hypot(errors["aws-r1-a-small"], 0.34), rel=1e-3)
    assert {name: widened[name] for name in widened if name != "aws-r1-a-small"} == {
        name: errors[name] for name in errors if name != "aws-r1-a-small"
    }
    (shell.folder / "results/demo").rename(shell.folder / "recorded.yaml")
    said = shell("replay", "specs/demo.yaml", "--from", "recorded.yaml", run=lab.main)
    assert "(aws/r1/a.small) ok, contended: 20 requests, mean 4 s" in said.err
    assert "(aws/r1/a.large) ok: 20 requests" in said.err
    assert "  aws-r1-a-small: ok, contended: 20 requests, mean 4 s\n" in said.out
    assert f"    warning: {warning}\n" in said.out


def errors_of(samples: Sequence[Measured]) -> dict[str, float]:
    """The errors of the samples that count."""
    return {one.id: one.errors["latency"] for one in partition(samples, "mean")[0]}


def test_a_hostile_name_in_a_library_is_text(shell: Shell) -> None:
    suite(shell)
    shell("library", "--from", "suite", "--out", "specs/library.json", run=lab.main)
    library = json.loads(shell.read("specs/library.json"))
    for one in library["programs"]:
        one["suite"] += "\x1b[31m\nINJECTED: <script>"
    shell.write("specs/library.json", json.dumps(library))
    compiled(shell, [sample("a.small", 3.0), sample("a.large", 1.5)], library="library.json")
    shell("compile", "specs/demo.yaml", "--partial")
    assert (
        "INJECTED" in yaml.safe_load(shell.read("compiled/demo/manifest.yaml"))["evidence"]["scales_like"].popitem()[0]
    )
    for words in (("explain", "demo", "-v"), ("check", "-v"), ("diff", "--markdown"), ("status", "-v")):
        said = shell(*words, code=None)
        assert "\x1b" not in said.out + said.err, words
        assert not [one for one in (said.out + said.err).splitlines() if one.lstrip().startswith("INJECTED")], words
    assert "scales like, by weight" in " ".join(shell("explain", "demo", "-v").out.split())
    shell("report", "demo")
    assert "<script>: " not in shell.read("compiled/demo/report.html")
