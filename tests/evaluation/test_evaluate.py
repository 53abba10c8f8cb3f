"""`fogspec-lab evaluate` and `fogspec-lab library` as a user runs them."""

import json

import pytest

from fogspec.catalog.machine import Machine
from fogspec.catalog.sources import load_catalog
from fogspec.language.loader import load
from fogspec.results.io import read_results_folder
from fogspec.results.schema import results_of
from fogspec_lab.cli import main
from fogspec_lab.evaluation.sweeps import read_sweep
from tests.conftest import ROOT
from tests.evaluation.making import write_suite
from tests.support.forking import forked
from tests.support.results import write

FIELDS = {
    "kind", "problems", "ok1", "ok5", "ok10", "ok20", "bench", "usd", "hours", "samples", "violation5", "false_infeasible",
    "error", "regret", "mdape", "coverage90",
}  # fmt: skip


def run(*arguments, code=0):
    done = forked(ROOT, [str(one) for one in arguments], run=main)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    return write_suite(tmp_path_factory.mktemp("evaluate") / "suite")


def test_any_number_of_workers_says_the_same(suite):
    one = run("evaluate", "--suite", suite, "--workers", 1, "-o", "json").stdout
    two = run("evaluate", "--suite", suite, "--workers", 2, "-o", "json").stdout
    assert one == two
    (row,) = json.loads(one)["by_kind"]
    assert set(row) == FIELDS
    assert row["problems"] == 2
    assert row["ok5"] == 1.0
    assert row["bench"] < 0.5


def test_a_full_sweep_without_noise_is_perfect(suite):
    told = run(
        "evaluate", "--suite", suite, "--sampler", "full", "--noise", "none", "--workers", 1, "-o", "json"
    ).stdout
    (row,) = json.loads(told)["by_kind"]
    assert (row["ok1"], row["bench"], row["violation5"], row["false_infeasible"]) == (1.0, 1.0, 0.0, 0.0)
    assert row["regret"]["p99"] == 0.0
    assert row["coverage90"] is None


@pytest.mark.parametrize("options", [("grid", "paper"), ("grid", "ours"), ("random", "ours"), ("cherrypick", "ours")])
def test_every_baseline_runs_and_a_stranger_can_bill_its_samples(suite, tmp_path, options):
    sampler, method = options
    choices = tmp_path / "choices.jsonl"
    told = run(
        "evaluate", "--suite", suite, "--sampler", sampler, "--method", method, "--seed", 0, "--seed", 7,
        "--choices", choices, "--workers", 1, "-o", "json",
    ).stdout  # fmt: skip
    report = json.loads(told)
    (row,) = report["by_kind"]
    assert report["seed"] == [0, 7]
    assert row["problems"] == 2
    lines = [json.loads(line) for line in choices.read_text().splitlines()]
    assert len(lines) == 12
    assert {line["seed"] for line in lines} == {0, 7}
    price = _prices(suite)
    usd, hours = [], []
    for line in lines:
        assert (line["sampler"], line["library"]) == (sampler, None)
        assert line["chosen"] is None or line["chosen"] in price
        samples = list(zip(line["sampled"], line["seconds"], line["batch"], strict=True))
        assert all(159 < seconds <= 159 + 300 for _, seconds, _ in samples)
        usd.append(sum(price[name] * seconds / 3600 for name, seconds, _ in samples))
        batches = [[s for _, s, one in samples if one == number] for number in sorted({*line["batch"]})]
        hours.append(sum(_wall_s(batch) for batch in batches) / 3600)
        expected = {"grid": 1, "random": 1}.get(sampler)
        assert expected in (None, len(batches))
    assert row["usd"] == pytest.approx(sum(usd) / len(usd), rel=1e-3)
    assert row["hours"] == pytest.approx(sum(hours) / len(hours), rel=1e-3)


def _wall_s(seconds):
    """Eight machines at once, the next one as soon as one ends."""
    ends = [0.0] * 8
    for one in seconds:
        ends.sort()
        ends[0] += one
    return max(ends)


def test_a_full_sweep_costs_all_of_it_and_takes_machines_side_by_side(suite):
    words = ("evaluate", "--suite", suite, "--sampler", "full", "--noise", "none", "--workers", 1, "-o", "json")
    (row,) = json.loads(run(*words).stdout)["by_kind"]
    assert row["bench"] == pytest.approx(1)
    assert row["samples"] == 21
    assert 3 * 159 < row["hours"] * 3600 < 3 * 459


def test_wrong_commands_and_files_are_said(suite, tmp_path):
    assert "needs SPEC --sweep FILE, or --suite" in run("evaluate", code=2).stderr
    assert "--kind is one of" in run("evaluate", "--suite", suite, "--kind", "planet", code=2).stderr
    assert "no machines.csv" in run("evaluate", "--suite", tmp_path, code=1).stderr


def test_a_sweep_is_replayed(tmp_path):
    sweep = tmp_path / "sweep.csv"
    rows = [f"c6i.{size},{4.0 / n + 0.1}" for size, n in (("large", 2), ("xlarge", 4), ("2xlarge", 8), ("4xlarge", 16))]
    sweep.write_text("\n".join(["instance_type,latency_s", *rows, "c6i.large,2.2"]) + "\n")
    found = json.loads(run("evaluate", "grasp-planning-recorded", "--sweep", sweep, "-o", "json").stdout)
    assert found["machines"] == 4
    assert found["chosen"] == found["best"]
    assert 0 < found["usd"] <= found["full_sweep_usd"] * 1.5
    assert found["bench"] == pytest.approx(found["usd"] / found["full_sweep_usd"])


def test_a_sweep_is_judged_by_the_limits_and_the_confidence_of_its_spec(tmp_path):
    (tmp_path / "sweep.csv").write_text("instance_type,latency_s\nc6i.large,1\nc6i.xlarge,0.5\n")
    (tmp_path / "spec.yaml").write_text(
        "apiVersion: fogspec.dev/v1alpha1\nkind: Application\nmetadata: { name: arm }\nspec:\n  cloud: [{ cmd: [plan] }]\n"
        "  probe: { callback: plan }\n  constraints: { latency: 800ms, network_allowance: 50ms, confidence: 0.97 }\n"
        "  infra: [aws/us-east-1]\n  benchmark: { budget: $1 }\n"
    )
    (one,) = load([tmp_path / "spec.yaml"])
    read = read_sweep(tmp_path / "sweep.csv", one.application, load_catalog(None, ["aws"]))
    rule = read.problem.settings[0].rule
    assert rule.confidence == 0.97
    assert rule.latency_budget_s.tolist() == pytest.approx([0.75, 0.75])


def test_results_are_a_sweep_and_every_sampler_is_replayed():
    words = ("evaluate", "vslam-recorded", "--sweep", "results/vslam-recorded", "--all")
    told = run(*words).stdout
    assert "noise none: the sweep has one measurement of each machine" in told
    rows = told.partition("\n\n")[0].splitlines()[2:]  # of the first block of columns
    assert rows[0][:30].strip() == "paper: grid, best R², relaxed"
    assert any(row.startswith("adaptive ") for row in rows)
    found = json.loads(run(*words, "-o", "json").stdout)
    assert len(found) == len(rows)
    assert {one["best"] for one in found} == {"aws/c6i.4xlarge"}


def test_failed_samples_of_results_are_named_and_repeats_are_the_noise(tmp_path):
    found = json.loads(
        run(
            "evaluate",
            "motion-planning-cubicles-recorded",
            "--sweep",
            "results/motion-planning-cubicles-recorded",
            "-o",
            "json",
        ).stdout
    )
    [failed] = found["not_measured"]
    assert failed.startswith("r6i.large (")
    assert "insufficient: " in failed
    (tmp_path / "sweep.csv").write_text("instance_type,latency_s\nc6i.large,0.2\nc6i.large,0.22\nc6i.4xlarge,0.03\n")
    again = json.loads(run("evaluate", "vslam-recorded", "--sweep", tmp_path / "sweep.csv", "-o", "json").stdout)
    assert again["noise"] == "the sweep's own: up to 2 measurements, 1 of 2 machines repeated"


def test_metrics_are_replayed_as_they_are_weighed(tmp_path):
    text = (ROOT / "specs/vslam-recorded.yaml").read_text("utf-8")
    text = text.replace(
        "  constraints:\n", "  metrics: { path: { topic: /length, field: data, unit: m } }\n  constraints:\n"
    )
    text = text.replace("    latency: 40ms", "    metrics: { path: 36 }").replace(
        "alpha: 0.5", "alpha: 1\n    metric: path"
    )
    (tmp_path / "spec.yaml").write_text(text.replace("    cost: $0.01/1000 requests\n", ""))
    sizes = (("large", 2), ("xlarge", 4), ("2xlarge", 8), ("4xlarge", 16), ("8xlarge", 32))
    rows = [f"c6i.{size},{4.0 / n + 0.1},{30 + 40 / n}" for size, n in sizes]
    (tmp_path / "sweep.csv").write_text("\n".join(["instance_type,latency_s,path", *rows]) + "\n")
    words = ("evaluate", tmp_path / "spec.yaml", "--sweep", tmp_path / "sweep.csv")
    found = json.loads(run(*words, "--sampler", "full", "-o", "json").stdout)
    assert found["chosen"] == found["best"] == "aws/c6i.8xlarge"
    assert set(found["metrics"]) == {"path"}
    assert found["metrics"]["path"] == {"mdape": None}  # of a full sweep there is no other machine
    told = run(*words, "--all").stdout
    assert "CherryPick" not in told
    assert "adaptive" in told
    assert "weighs the latency only" in run(*words, "--sampler", "cherrypick", code=2).stderr
    (tmp_path / "sweep.csv").write_text("instance_type,latency_s\nc6i.large,0.2\n")
    assert "missing: path" in run(*words, code=1).stderr


def test_shapes_of_one_host_are_machines_that_count_by_their_vcpus(tmp_path):
    body = read_results_folder(ROOT / "results/vslam-recorded")
    samples = [
        one.model_copy(
            update={
                "machine": Machine(infra="local", instance=f"{n}cpu-{m}gib", cpus=n, memory=m, price=0),
                "id": f"{n}-{m}",
            }
        )
        for one, (n, m) in zip(body.spec.samples, ((1, 1), (1, 2), (2, 1), (2, 2)), strict=False)
    ]
    results = results_of(body.spec.model_copy(update={"samples": samples}))
    write(tmp_path / "sweep.yaml", results.spec)
    found = json.loads(
        run("evaluate", "vslam-recorded", "--sweep", tmp_path / "sweep.yaml", "--sampler", "full", "-o", "json").stdout
    )
    assert found["machines"] == 4
    assert found["prices"] == "free machines count as $1 per vCPU and hour"
    assert found["bench"] == pytest.approx(1)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("instance,latency\nc6i.large,1\n", "missing: instance_type"),
        ("instance_type,latency_s\nc6i.nano,1\nc6i.large,2\n", "c6i.nano is not in the catalog"),
        ("instance_type,latency_s\nc6i.large,0\n", "positive and finite"),
        ("instance_type,latency_s\nc6i.large,1\n", "a replay needs 2"),
        ("", "it needs the columns instance_type, latency_s"),
    ],
)
def test_a_wrong_sweep_is_said(tmp_path, text, says):
    (tmp_path / "sweep.csv").write_text(text)
    assert (
        says in run("evaluate", "specs/grasp-planning-recorded.yaml", "--sweep", tmp_path / "sweep.csv", code=1).stderr
    )


def test_a_library_is_built_from_a_folder_and_used(suite, tmp_path):
    run("library", "--from", suite, "--out", tmp_path / "a.json.gz")
    run("library", "--from", suite, "--out", tmp_path / "b.json.gz")
    assert (tmp_path / "a.json.gz").read_bytes() == (tmp_path / "b.json.gz").read_bytes()
    told = run("evaluate", "--suite", suite, "--library", tmp_path / "a.json.gz", "--workers", 1, "-o", "json").stdout
    assert json.loads(told)["library"].startswith("sha256:")


def _prices(suite):
    lines = (suite / "machines.csv").read_text().splitlines()[1:]
    return {f"aws/{line.split(',')[1]}": float(line.split(",")[4]) for line in lines}


@pytest.mark.slow
def test_the_choice_from_a_measured_full_sweep_of_a_case_study_is_near_its_best():
    words = ("evaluate", "specs/vslam.yaml", "--sweep", "tests/data/sweeps/vslam")
    found = json.loads(run(*words, "-o", "json").stdout)
    assert found["machines"] == 6
    assert (found["ok5"], found["best"].startswith("local/")) == (True, True)
    assert found["bench"] <= 1
