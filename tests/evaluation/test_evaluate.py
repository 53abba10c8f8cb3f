"""`fogspec evaluate` and `fogspec priors` as a user runs them."""

import json
import os
import sqlite3
import subprocess
import sys

import pytest

from fogspec.catalog.machine import Machine
from fogspec.catalog.sources import load_catalog
from fogspec.evaluation.sweeps import read_sweep
from fogspec.results.schema import Results, with_checksum
from fogspec.spec.loader import load, read_document
from tests.conftest import ROOT
from tests.evaluation.making import write_suite
from tests.support.files import write_yaml
from tests.support.forking import forked

FIELDS = {
    "kind", "problems", "ok1", "ok5", "ok10", "bench", "samples", "violation5", "false_infeasible", "regret", "mdape",
    "coverage90", "hypervolume",
}  # fmt: skip


def run(*arguments, code=0):
    done = forked(ROOT, [str(one) for one in arguments])
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


@pytest.mark.parametrize(
    "options", [("grid", "paper"), ("grid", "r2"), ("grid", "ours"), ("random", "ours"), ("cherrypick", "ours")]
)
def test_every_baseline_runs_and_its_choices_can_be_scored_anew(suite, tmp_path, options):
    sampler, method = options
    choices = tmp_path / "choices.jsonl"
    told = run(
        "evaluate", "--suite", suite, "--sampler", sampler, "--method", method, "--choices", choices, "--workers", 1,
        "-o", "json",
    ).stdout  # fmt: skip
    (row,) = json.loads(told)["by_kind"]
    lines = [json.loads(line) for line in choices.read_text().splitlines()]
    assert len(lines) == 6
    prices = _prices(suite)
    bench = [sum(prices[name] for name in line["sampled"]) / sum(prices.values()) for line in lines]
    assert row["bench"] == pytest.approx(sum(bench) / len(bench))
    assert all(line["chosen"] in prices for line in lines if line["chosen"] is not None)


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
    assert 0 < found["cost_usd"] <= found["full_sweep_usd"] * 1.5
    assert found["bench"] == pytest.approx(found["cost_usd"] / found["full_sweep_usd"])


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


def test_results_are_a_sweep_and_every_sampler_is_replayed(tmp_path):
    chart = tmp_path / "chart.svg"
    words = ("evaluate", "vslam-recorded", "--sweep", "results/vslam-recorded.yaml", "--all")
    told = run(*words, "--chart", chart).stdout
    assert "noise none: the sweep has one measurement of each machine" in told
    rows = told.partition("\n\n")[0].splitlines()[2:]  # of the first block of columns
    assert rows[0][:30].strip() == "paper: grid, best R², relaxed"
    assert any(row.startswith("adaptive ") for row in rows)
    # Parts of machines were not measured.
    assert not any("nested" in row for row in rows)
    found = json.loads(run(*words, "-o", "json").stdout)
    assert len(found) == len(rows)
    assert {one["best"] for one in found} == {"aws/c6i.4xlarge"}
    svg = chart.read_text("utf-8")
    assert "Quality against money" in svg
    assert "price per hour" in svg


def test_failed_samples_of_results_are_named_and_repeats_are_the_noise(tmp_path):
    found = json.loads(
        run(
            "evaluate",
            "motion-planning-cubicles-recorded",
            "--sweep",
            "results/motion-planning-cubicles-recorded.yaml",
            "-o",
            "json",
        ).stdout
    )
    [failed] = found["not_measured"]
    assert failed.startswith("r6i.large (insufficient")
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
    assert found["metrics"]["path"]["r2"] == pytest.approx(1)
    told = run(*words, "--all", "--chart", tmp_path / "chart.svg").stdout
    assert "CherryPick" not in told
    assert "adaptive" in told
    assert "path (log scale)" in (tmp_path / "chart.svg").read_text("utf-8")
    assert "weighs the latency only" in run(*words, "--sampler", "cherrypick", code=2).stderr
    (tmp_path / "sweep.csv").write_text("instance_type,latency_s\nc6i.large,0.2\n")
    assert "missing: path" in run(*words, code=1).stderr


def test_shapes_of_one_host_are_machines_that_count_by_their_vcpus(tmp_path):
    body = read_document(ROOT / "results/vslam-recorded.yaml", Results)
    samples = [
        one.model_copy(
            update={
                "machine": Machine(infra="local", instance=f"{n}cpu-{m}gib", cpus=n, memory=m, price=0),
                "id": f"{n}-{m}",
            }
        )
        for one, (n, m) in zip(body.spec.samples, ((1, 1), (1, 2), (2, 1), (2, 2)), strict=False)
    ]
    results = with_checksum(body.metadata, body.spec.model_copy(update={"samples": samples}))
    write_yaml(tmp_path / "sweep.yaml", results.model_dump(mode="json", exclude_none=True), "a test")
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
    run("priors", "build", "--from", suite, "--out", tmp_path / "a.zip")
    run("priors", "build", "--from", suite, "--out", tmp_path / "b.zip")
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()
    told = run("evaluate", "--suite", suite, "--priors", tmp_path / "a.zip", "--workers", 1, "-o", "json").stdout
    assert json.loads(told)["priors"].startswith("sha256:")


def test_without_sparecores_data_the_install_command_is_said(tmp_path):
    words = [sys.executable, "-m", "fogspec", "priors", "build", "--out", str(tmp_path / "a.zip")]
    environment = {**os.environ, "PYTHONPATH": str(_without_sc_data(tmp_path))}
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=ROOT, env=environment)
    assert done.returncode == 1, done.stderr
    assert "python -m pip install sparecores-data" in done.stderr
    assert not (tmp_path / "a.zip").exists()


def test_a_library_is_built_from_spare_cores_tables(tmp_path):
    database = tmp_path / "sc.db"
    with sqlite3.connect(database) as connection:
        connection.executescript("""
            CREATE TABLE server (vendor_id, server_id, api_reference, family, vcpus, cpu_cores, cpu_speed, cpu_architecture,
                cpu_manufacturer, cpu_model, cpu_allocation, memory_amount, gpu_count, gpu_memory_min, gpu_model);
            CREATE TABLE server_price (vendor_id, server_id, allocation, unit, currency, price);
            CREATE TABLE benchmark (benchmark_id, framework, higher_is_better);
            CREATE TABLE benchmark_score (benchmark_id, vendor_id, server_id, config, score);
        """)
        for i in range(12):
            server = (
                "aws",
                f"c{i}.large",
                f"c{i}.large",
                "c",
                2,
                1,
                3.5,
                "X86_64",
                "Intel",
                "8375C",
                "DEDICATED",
                4096,
            )
            connection.execute(f"INSERT INTO server VALUES ({', '.join('?' * 15)})", (*server, 0, None, None))
            connection.execute(
                "INSERT INTO server_price VALUES (?, ?, ?, ?, ?, ?)", (*server[:2], "ONDEMAND", "HOUR", "USD", 0.1)
            )
            for name in ("ops", "seconds"):
                score = (name, *server[:2], '{"n": 1}', i + 1.0)
                connection.execute("INSERT INTO benchmark_score VALUES (?, ?, ?, ?, ?)", score)
        connection.executemany("INSERT INTO benchmark VALUES (?, 'bogus', ?)", [("ops", 1), ("seconds", 0)])
    done = run("priors", "build", "--from", database, "--out", tmp_path / "a.zip")
    assert "2 workloads on 12 machines" in done.stdout
    assert (
        "not a database" in run("priors", "build", "--from", ROOT / "README.md", "--out", tmp_path / "c", code=1).stderr
    )


def _without_sc_data(folder):
    """A place before all others whose `sc_data` is not there."""
    (folder / "first").mkdir()
    (folder / "first" / "sc_data.py").write_text("raise ModuleNotFoundError('sc_data')\n")
    return folder / "first"


def _prices(suite):
    lines = (suite / "machines.csv").read_text().splitlines()[1:]
    return {f"aws/{line.split(',')[1]}": float(line.split(",")[4]) for line in lines}


@pytest.mark.slow
def test_the_choice_from_a_measured_full_sweep_of_a_case_study_is_near_its_best():
    words = ("evaluate", "specs/vslam.yaml", "--sweep", "tests/data/sweeps/vslam.yaml")
    found = json.loads(run(*words, "-o", "json").stdout)
    assert found["machines"] == 6
    assert (found["ok5"], found["best"].startswith("local/")) == (True, True)
    assert found["bench"] <= 1
