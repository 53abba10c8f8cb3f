"""The bars of choosing well from few samples, on part of the development set; `make evaluation` prints all of it."""

import pytest

from fogspec.evaluation.running import Campaign, by_kind, run
from fogspec.evaluation.suites import read_suite
from fogspec.model.priors import read_priors

# kind, sampler, with priors, every so many problems, ok5 at least, bench at most, violation5 at most
BARS = [
    ("family", "adaptive", True, 6, 0.90, 0.22, 0.03),
    ("family", "adaptive", False, 6, 0.88, 0.20, 0.03),
    ("family", "grid", False, 8, 0.78, 0.54, 0.04),
    ("gpu", "adaptive", True, 4, 0.90, 0.13, 0.0),
]


@pytest.fixture(scope="module")
def data(shared_data):
    return read_suite(shared_data / "dev"), read_priors(shared_data / "priors")


@pytest.mark.parametrize(("kind", "sampler", "priors", "every", "ok5", "bench", "violation5"), BARS)
def test_part_of_the_development_set_is_chosen_well(data, kind, sampler, priors, every, ok5, bench, violation5):
    suite, library = data
    problems = [one for one in suite.problems if one.kind == kind][::every]
    campaign = Campaign(sampler=sampler)
    ended = [one for problem in problems for one in run(problem, suite.table, library if priors else None, campaign)]
    ((row,), _) = by_kind(ended)
    assert row["ok5"] >= ok5
    assert row["bench"] <= bench
    assert row["violation5"] <= violation5
    assert 0.8 <= row["coverage90"] <= 0.98


def test_the_target_s_own_suite_is_left_out_of_the_library(data):
    suite, library = data
    problem = next(one for one in suite.problems if one.kind == "family")
    kept = [i for i, name in enumerate(library.suites) if name != problem.suite]
    without = type(library)(
        library.names, library.machines, tuple(library.workloads[i] for i in kept),
        tuple(library.suites[i] for i in kept), library.log_latency[kept],
    )  # fmt: skip
    lines = [
        [one.line() for one in run(problem, suite.table, one_library, Campaign())] for one_library in (library, without)
    ]
    assert lines[0] == lines[1]
