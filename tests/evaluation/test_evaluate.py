"""`fogspec evaluate` and `fogspec priors` as a user runs them."""

import json
import os
import sqlite3
import subprocess
import sys

import pytest

from fogspec.catalog.sources import load_catalog
from fogspec.evaluation.sweeps import read_sweep
from fogspec.spec.loader import load
from tests.conftest import ROOT
from tests.evaluation.making import write_suite

FIELDS = {
    "kind", "problems", "ok1", "ok5", "ok10", "bench", "samples", "violation5", "false_infeasible", "regret", "mdape",
    "coverage90", "hypervolume",
}  # fmt: skip


def run(*arguments, code=0, cwd=None, **environment):
    done = subprocess.run(
        [sys.executable, "-m", "fogspec", *map(str, arguments)], capture_output=True, text=True, check=False, cwd=cwd or ROOT,
        env={**os.environ, **environment},
    )  # fmt: skip
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
    found = json.loads(run("evaluate", "grasp-planning", "--sweep", sweep, "-o", "json").stdout)
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
    assert says in run("evaluate", "specs/grasp-planning.yaml", "--sweep", tmp_path / "sweep.csv", code=1).stderr


def test_a_library_is_built_from_a_folder_and_used(suite, tmp_path):
    run("priors", "build", "--from", suite, "--out", tmp_path / "a.zip")
    run("priors", "build", "--from", suite, "--out", tmp_path / "b.zip")
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()
    told = run("evaluate", "--suite", suite, "--priors", tmp_path / "a.zip", "--workers", 1, "-o", "json").stdout
    assert json.loads(told)["priors"].startswith("sha256:")


def test_without_sparecores_data_the_install_command_is_said(tmp_path):
    done = run("priors", "build", "--out", tmp_path / "a.zip", code=1, PYTHONPATH=str(_without_sc_data(tmp_path)))
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
