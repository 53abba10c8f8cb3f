"""The scores that README and docs show are those of the code: a part of them is replayed."""

import json

import pytest

from fogspec_lab.evaluation.campaign import Campaign, by_kind, run
from fogspec_lab.evaluation.suites import read_suite
from fogspec_lab.libraries import library_named
from tests.tools import quality

SCORES = json.loads(quality.SCORES.read_text("utf-8"))


def test_the_scores_are_of_the_suite_that_is_here():
    assert SCORES["suite"] == quality.digest()
    assert quality.SUITE.joinpath("README.md").read_text("utf-8").count("CC BY-SA 4.0") >= 2
    files = [one for one in quality.SUITE.iterdir() if one.is_file()]
    assert sum(one.stat().st_size for one in files) < 2_000_000
    suite = read_suite(quality.SUITE)
    assert len(suite.problems) <= 40


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), [("**fogspec**", "family"), ("**fogspec**", "gpu")])
def test_a_replay_gives_the_scores_that_are_shown(name, kind):
    """Sums over thousands of machines differ in their last digit between processors, and so, rarely, does a sample."""
    *_, sampler, method, library = next(row for row in quality.ROWS if row[0] == name)
    suite = read_suite(quality.SUITE)
    problems = [one for one in suite.problems if one.kind == kind]
    known, campaigns = library_named(library), [Campaign(sampler, method, seed=seed) for seed in SCORES["seeds"]]
    jobs = [(problem, campaign) for campaign in campaigns for problem in problems]
    (row,), _ = by_kind([one for problem, campaign in jobs for one in run(problem, suite.table, known, campaign)])
    shown = next(one for one in SCORES["rows"][name] if one["kind"] == kind)
    assert row["ok5"] == pytest.approx(shown["ok5"], abs=0.02)
    assert row["bench"] == pytest.approx(shown["bench"], rel=0.05)
    assert row["violation5"] == pytest.approx(shown["violation5"], abs=0.01)
    assert row["coverage90"] == pytest.approx(shown["coverage90"], abs=0.02)


def test_the_tables_are_those_of_the_scores():
    assert {path: path.read_text("utf-8") for path in quality.files()} == quality.files()
