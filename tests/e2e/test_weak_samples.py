"""Too few, failed, equal, absurd or contradictory samples: a clear error or a marked weak answer, never a sure wrong one."""

import json
import math
from collections.abc import Sequence
from typing import Any

import pytest

from fogspec.catalog.machine import Gpu, Machine
from fogspec.plan.schema import PlanMetadata
from fogspec.results.schema import LatencySummary, Measured, ResultsBody, with_checksum
from fogspec.spec import fingerprints
from fogspec.spec.loader import load
from tests.support.files import write_yaml
from tests.support.running import Shell, project, shell  # noqa: F401

SHAPES = {"a.small": (2, 4, 0.1), "a.large": (8, 16, 0.4), "a.huge": (32, 64, 1.6), "b.small": (2, 8, 0.12),
          "b.large": (8, 32, 0.48), "b.huge": (32, 128, 1.92), "g.small": (4, 16, 0.6)}  # fmt: skip
LONG = "{budget: $50, stop: {requests: 20, duration: 2h}}"
BOX = {"hardware": "{cpus: 2..32}"}


def sample(instance: str, latency: float | None, tag: str = "", **more: Any) -> Measured:
    cpus, memory, price = SHAPES.get(instance, (4, 4, 0.2))
    gpu = Gpu(name="T4") if instance.startswith("g.") else None
    machine = Machine(infra="aws/r1", instance=instance, cpus=cpus, memory=memory, gpu=gpu, price=price)
    summary = None if latency is None else LatencySummary(mean=latency, sd=latency / 20)
    base = {"state": "ok", "requests": 20, "duration": 60.0, "spent": 0.01, "measured_on": "test"}
    return Measured(id=f"aws-r1-{instance.replace('.', '-')}{tag}", machine=machine, latency=summary, **(base | more))


def write(shell: Shell, records: Sequence[Measured]) -> None:
    application = load([str(shell.folder / "specs/demo.yaml")])[0].application
    body = ResultsBody(
        application=fingerprints.measured_digest(application), runner="local", spent=0.0, samples=list(records)
    )
    results = with_checksum(PlanMetadata(name="demo"), body)
    write_yaml(shell.folder / "results/demo.yaml", results.model_dump(mode="json", exclude_none=True), "test")


def compiled(shell: Shell, records: Sequence[Measured], code: int = 0, **parts: str) -> dict[str, Any]:
    """What compile says of these samples, which are all that there will be."""
    project(shell, **(BOX | parts))
    write(shell, records)
    ended = shell("compile", "specs/demo.yaml", "--catalog", "offers.csv", "--partial", "-o", "json", code=code)
    assert "Traceback" not in ended.err
    [found] = json.loads(ended.out)
    return found


def explained(shell: Shell, code: int = 0) -> dict[str, Any]:
    shell("explain", "specs/demo.yaml", "--catalog", "offers.csv", code=code)
    ended = shell("explain", "specs/demo.yaml", "--catalog", "offers.csv", "-o", "json", code=code)
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
    chosen, warnings = found["menu"]["balanced"], found["menu"]["warnings"]
    assert chosen["measured"] or any("not verified" in text for text in warnings)
    assert chosen["measured"] or any("extrapolated" in text for text in warnings)


def test_fewer_samples_than_parameters_have_wide_intervals(shell: Shell) -> None:
    found = compiled(shell, [sample("a.small", 3.0), sample("a.large", 1.0)])
    unmeasured = [one for one in found["menu"]["front"] if not one["measured"]]
    spread = [one["interval_s"][1] / one["interval_s"][0] for one in unmeasured]
    assert all(ratio > 1.1 for ratio in spread)
    assert any("2 samples" in text for text in found["menu"]["warnings"])


@pytest.mark.parametrize("state", ["failed", "timeout"])
def test_all_failed_is_no_choice(shell: Shell, state: str) -> None:
    failed = [
        sample(name, None, state=state, reason="crash" if state == "failed" else None) for name in list(SHAPES)[:6]
    ]
    found = compiled(shell, failed, code=7)
    assert found["manifest"] is None
    assert found["menu"]["predicted"] == 0
    assert any("does not count" in text for text in found["menu"]["warnings"])
    assert explained(shell)["next_sample"] is None


def test_a_run_that_was_given_up_is_a_lower_bound(shell: Shell) -> None:
    good = [sample("a.large", 1.0), sample("b.large", 1.0)]
    waited = sample("a.small", None, state="timeout", latency_lower_bound=60.0)
    alone = compiled(shell, good)
    with_bound = compiled(shell, [*good, waited])
    small = [
        next((e for e in one["menu"]["hourly_front"] if e["instance"] == "b.small"), None)
        for one in (alone, with_bound)
    ]
    assert small[1] is None or small[0] is None or small[1]["latency_s"] > small[0]["latency_s"]
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
    assert "is not a latency" in said or "results/demo.yaml" in said


def test_an_infinite_latency_is_no_number(shell: Shell) -> None:
    project(shell, **BOX)
    write(shell, [sample("a.small", 3.0), sample("a.large", 1.0)])
    path = shell.folder / "results/demo.yaml"
    path.write_text(path.read_text().replace("mean: 3s", "mean: .inf"))
    ended = shell("compile", "specs/demo.yaml", "--catalog", "offers.csv", code=1)
    assert "results/demo.yaml:" in ended.err


def test_repeats_that_contradict_each_other_widen_the_interval(shell: Shell) -> None:
    base = [sample("a.large", 1.0), sample("b.large", 1.0), sample("b.small", 3.0)]
    agreed = compiled(shell, [*base, sample("a.small", 3.0), sample("a.small", 3.02, "-again")])
    doubtful = compiled(shell, [*base, sample("a.small", 2.0), sample("a.small", 4.5, "-again")])

    def width(found: dict[str, Any]) -> float:
        low, high = next(e for e in found["menu"]["hourly_front"] if e["instance"] == "a.small")["interval_s"]
        return math.log(high / low)

    assert width(doubtful) > 2 * width(agreed)


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
    assert all(one["instance"] != "gone.medium" for one in found["menu"]["hourly_front"])


def test_no_sample_of_a_gpu_type_is_never_sure_of_it(shell: Shell) -> None:
    found = compiled(shell, [sample(name, 3.0) for name in ("a.small", "a.large", "a.huge")], hardware="{gpus: [none, T4]}",
                     constraints="{latency: 2s}", code=4)  # fmt: skip
    assert found["menu"]["balanced"] is None
    told = explained(shell)
    assert told["likeliest"]["instance"].startswith("g.")
    assert 0.05 < told["likeliest"]["probability_met"] < 0.5
    assert told["next_sample"]["cost_usd"] > 0


def test_below_the_asked_confidence_it_is_said_aloud(shell: Shell) -> None:
    records = [sample("a.small", 3.0), sample("b.small", 3.0), sample("a.huge", 0.6)]
    found = compiled(
        shell, records, hardware="{cpus: 8..8}", constraints="{latency: 1.1s, confidence: 0.99}", code=None
    )
    assert 0.5 < found["menu"]["balanced"]["probability"] < 0.99
    assert any("confidence 0.99" in text for text in found["menu"]["warnings"])
    manifest = shell.read("compiled/demo/manifest.yaml")
    assert "meets_confidence: false" in manifest
    assert "verified: false" in manifest


def test_spot_pays_for_its_interruptions(shell: Shell) -> None:
    records = [sample(name, 600.0) for name in ("a.small", "a.large", "b.small", "b.large")]
    calm = compiled(shell, records, hardware="{cpus: 2..8, spot: true}", constraints="{latency: 1h}", benchmark=LONG,
                    objective="{alpha: 0, interruption: {rate: 0.01/h, recovery_time: 1min}}")  # fmt: skip
    wild = compiled(shell, records, hardware="{cpus: 2..8, spot: true}", constraints="{latency: 1h}", benchmark=LONG,
                    objective="{alpha: 0, interruption: {rate: 10/h, recovery_time: 30min}}")  # fmt: skip
    assert calm["menu"]["balanced"]["spot"]
    assert not wild["menu"]["balanced"]["spot"]


def test_data_transfer_is_part_of_the_cost(shell: Shell) -> None:
    records = [sample("a.small", 3.0), sample("a.large", 1.0)]
    without = compiled(shell, records)["menu"]["balanced"]["cost_usd_per_request"]
    moved = compiled(shell, records, objective="{transfer: {per_request: 1GiB, price: $0.09/GiB}}")["menu"]["balanced"][
        "cost_usd_per_request"
    ]
    assert moved - without == pytest.approx(0.09, abs=1e-3)


def test_a_machine_library_is_named_in_models_and_manifest(shell: Shell, tmp_path: Any) -> None:
    machines = ["Cloud,InstanceType,vCPUs,MemoryGiB,Price"]
    machines += [f"aws,{name},{c},{m},{p}" for name, (c, m, p) in SHAPES.items() if not name.startswith("g.")]
    rows = ["workload,suite,cloud,instance_type,latency_s"]
    for number in range(6):
        rows += [f"w{number},s{number},aws,{name},{1 + (number + 1) / c}" for name, (c, _, _) in SHAPES.items()
                 if not name.startswith("g.")]  # fmt: skip
    shell.write("priors/machines.csv", "\n".join([*machines, ""]))
    shell.write("priors/latencies.csv", "\n".join([*rows, ""]))
    records = [sample("a.small", 3.0), sample("a.large", 1.5)]
    compiled(shell, records)
    assert "priors: null" in shell.read("compiled/demo/models.yaml")
    shell("compile", "specs/demo.yaml", "--catalog", "offers.csv", "--priors", "priors")
    digest = next(line for line in shell.read("compiled/demo/models.yaml").splitlines() if "priors:" in line).split()[
        -1
    ]
    assert digest.strip("}").startswith("sha256:")
    assert digest.strip("}") in shell.read("compiled/demo/manifest.yaml")
    shell("lock", "specs/demo.yaml", "--catalog", "offers.csv", "--priors", "priors")
    shell("compile", "specs/demo.yaml", "--partial")
    assert digest.strip("}") in shell.read("compiled/demo/manifest.yaml")
    shell("compile", "specs/demo.yaml", "--check")
    shell.write("priors/latencies.csv", "\n".join([*rows, "w0,s0,aws,b.huge,9", ""]))
    assert "machine library" in shell("compile", "specs/demo.yaml", code=3).err
    shell.write("priors/latencies.csv", "nonsense\n")
    assert "latencies.csv" in shell("compile", "specs/demo.yaml", "--priors", "priors", code=1).err


def test_explain_says_what_the_confidence_costs(shell: Shell) -> None:
    """The cheapest machine lies just within the limit: a lower confidence would take it, a higher one nothing at all."""
    measured = [sample("a.small", 0.975), sample("b.large", 0.6), sample("a.large", 0.61), sample("b.small", 1.1)]
    compiled(shell, measured, constraints="{latency: 1s}", objective="{alpha: 0}")
    said = shell("explain", "specs/demo.yaml", "--catalog", "offers.csv").out
    assert "at confidence 0.8 the choice would be a.small, 60% cheaper, " in said
    [lower] = explained(shell)["confidences"]
    assert (lower["confidence"], lower["instance"]) == (0.8, "a.small")
    assert lower["cost_ratio"] == pytest.approx(0.975 * 0.1 / 0.61 / 0.4, rel=0.05)


def test_samples_against_the_ranges_widen_them_and_what_was_assumed_is_said(shell: Shell) -> None:
    odd = (3.0, 1.1, 0.24, 5.2, 0.5, 0.41)
    names = ("a.small", "a.large", "a.huge", "b.small", "b.large", "b.huge")
    means = [replaced(sample(name, seconds)) for name, seconds in zip(names, odd, strict=True)]
    found = compiled(shell, means)
    [widened] = [text for text in found["menu"]["warnings"] if "widened" in text]
    [assumed] = [text for text in found["menu"]["warnings"] if "is assumed to err by 2.5%" in text]
    assert "of 6 measured machines lie in the 90% range that the others give them" in widened
    assert assumed.startswith("the spread of requests is unknown for 6 of 6 samples")
    manifest = (shell.folder / "compiled/demo/manifest.yaml").read_text()
    text = shell("explain", "specs/demo.yaml", "--catalog", "offers.csv").out
    assert widened in text
    assert "which is widened by a factor of" in text
    assert widened in manifest
    assert assumed in manifest
    shell("report", "specs/demo.yaml", "--catalog", "offers.csv", "--out", "page.html")
    assert "ranges of predictions are widened" in (shell.folder / "page.html").read_text()
    spread = compiled(shell, [sample(name, 4 / SHAPES[name][0]) for name in names])["menu"]["warnings"]
    assert not [text for text in spread if "widened" in text or "is assumed to err" in text]


def replaced(one: Measured) -> Measured:
    """The sample with its mean alone."""
    assert one.latency is not None
    return one.model_copy(update={"latency": LatencySummary(mean=one.latency.mean)})
