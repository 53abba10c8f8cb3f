"""Suites and libraries from files: what is read, and what is said of wrong ones."""

import gzip
import json

import pytest

from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import InvalidInput
from fogspec_lab.evaluation.suites import read_suite
from fogspec_lab.libraries import library_named, suite_library
from tests.evaluation.making import write_suite


@pytest.fixture
def suite(tmp_path):
    return write_suite(tmp_path / "suite")


def test_reads_machines_latencies_and_problems(suite):
    read = read_suite(suite)
    assert len(read.table.names) == 21
    (problem, *_) = read.problems
    assert problem.kind == "family"
    assert problem.settings[0].rule.alpha == 0.0
    assert len(problem.latency_s) == 21


def test_reads_gzipped_files_alike(suite):
    before = read_suite(suite)
    for name in ("latencies.csv", "problems.jsonl"):
        (suite / f"{name}.gz").write_bytes(gzip.compress((suite / name).read_bytes()))
        (suite / name).unlink()
    assert (read_suite(suite).problems[0].latency_s == before.problems[0].latency_s).all()


@pytest.mark.parametrize(
    ("file", "old", "new", "says"),
    [
        ("machines.csv", "vCPUs", "cpus", "missing: vCPUs"),
        ("machines.csv", "m0,", "m1,", "aws/m1 is there twice"),
        ("latencies.csv", ",m3,", ",m99,", "machine aws/m99 is not in machines.csv"),
        ("latencies.csv", "latency_s\n", "latency_s\nw0,s0,aws,m0,-1\n", "must be positive and finite"),
        ("latencies.csv", "latency_s\n", "latency_s\nw0,s0,aws,m0,inf\n", "must be positive and finite"),
        ("latencies.csv", "latency_s\n", "latency_s\nw0,s0,aws,m0,fast\n", "not a number"),
        ("latencies.csv", "latency_s\n", "latency_s\nw0,other,aws,m0,1\n", "is in suite"),
        ("latencies.csv", "latency_s\n", "latency_s\nw0,s0\n", "a row must have 5 fields"),
        ("problems.jsonl", '"family"', '"families"', "kind is one of"),
        ("problems.jsonl", '"w0"', '"w9"', "has no latencies"),
        ("problems.jsonl", '"settings"', '"setting"', "not a problem"),
        ("problems.jsonl", '"alpha": 0.0', '"alpha": 7', "alpha between 0 and 1"),
        ("problems.jsonl", '"aws/m2"', '"aws/m77"', "machine aws/m77 is not in machines.csv"),
    ],
)
def test_says_what_is_wrong_and_where(suite, file, old, new, says):
    text = (suite / file).read_text()
    assert old in text
    (suite / file).write_text(text.replace(old, new, 1))
    with pytest.raises(DiagnosticError, match=says) as wrong:
        read_suite(suite)
    (found,) = wrong.value.diagnostics
    assert found.span.line >= 1


def test_a_missing_file_is_named(suite):
    (suite / "latencies.csv").unlink()
    with pytest.raises(InvalidInput, match=r"no latencies\.csv"):
        read_suite(suite)


def test_a_damaged_file_is_an_error_not_a_crash(suite):
    (suite / "latencies.csv").rename(suite / "latencies.csv.gz")
    with pytest.raises(InvalidInput, match="cannot be read"):
        read_suite(suite)


def test_problems_that_are_no_json_are_an_error(suite):
    (suite / "problems.jsonl").write_text(json.dumps([1]) + "\n")
    with pytest.raises(DiagnosticError, match="not a problem"):
        read_suite(suite)


def test_a_library_says_the_same_from_a_folder_twice(suite):
    assert suite_library(suite).digest == suite_library(suite).digest
    with pytest.raises(InvalidInput, match="not a machine library"):
        library_named(str(suite / "machines.csv"))
