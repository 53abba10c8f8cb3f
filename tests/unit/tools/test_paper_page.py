"""The page of the paper: path lengths of our own runs are listed and drawn once there are results with them."""

import numpy as np
import pytest

from fogspec.numerics.pareto import pareto
from tools.paper import __main__ as page
from tools.paper import figures, tables
from tools.paper.cases import Case, OwnRun, cases

RUN = OwnRun("arm", "m", "shapes of one host", (("1cpu-1gib", 1.0, 2.0, 40.0), ("2cpu-1gib", 2.0, 1.5, 35.0)))


def test_path_lengths_are_listed_with_their_unit_and_where_they_were_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "own_runs", lambda: (RUN,))
    found = tables._path_length()
    assert found.rows == [("arm", "1cpu-1gib", "1", "2 s", "40 m"), ("arm", "2cpu-1gib", "2", "1.5 s", "35 m")]
    assert "never published" in found.before
    assert "shapes of one host" in found.before
    assert "paper-path-length.svg" in page.page([found])


def test_without_a_run_the_place_is_left_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "own_runs", tuple)
    found = tables._path_length()
    assert found.rows[0][-1] == "not measured yet"
    assert not found.charts


def test_every_run_is_drawn_by_its_latency_and_its_path_length() -> None:
    drawn = figures._path_lengths((RUN,))
    assert drawn.count("<circle") == 2 * len(RUN.samples) + 1  # and the legend
    assert "path length in m" in drawn
    assert "Our own runs, on shapes of one host" in drawn


def test_no_line_of_the_page_is_broken_inside_a_word() -> None:
    assert page._wrapped("one two three", 7) == ["one two", "three"]


def medians(case: Case, *, of_cost: bool) -> dict[float, float]:
    """The median latency, or the median of latency times price, by vCPUs of the samples without a GPU."""
    known = [one for one in case.models.spec.observations if one.machine.gpu is None]
    values = {vcpus: [one.values["latency"] * (one.machine.price if of_cost else 1) for one in known
                      if one.machine.cpus == vcpus] for vcpus in {one.machine.cpus for one in known}}  # fmt: skip
    return {vcpus: float(np.median(found)) for vcpus, found in values.items()}


@pytest.mark.parametrize("case", cases(), ids=lambda case: case.title)
def test_the_titles_of_the_charts_are_true_of_the_measurements(case: Case) -> None:
    latency_s, cost = medians(case, of_cost=False), medians(case, of_cost=True)
    assert (latency_s[64] > latency_s[16]) == (case.title == "SLAM")
    assert cost[64] > cost[2]
    offers, latency = case.open.offers, case.open.latency
    front = pareto(offers.price_usd_per_hour, latency.value)
    assert not latency.measured[front].all(), "predicted machines are on the frontier"
