"""The page of the paper: path lengths of our own runs are listed and drawn once there are results with them."""

import pytest

from tools.paper import __main__ as page
from tools.paper import figures, tables
from tools.paper.cases import OwnRun

RUN = OwnRun("arm", "m", "shapes of one host", (("1cpu-1gib", 1.0, 2.0, 40.0), ("2cpu-1gib", 2.0, 1.5, 35.0)))


def test_path_lengths_are_listed_with_their_unit_and_where_they_were_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "own_runs", lambda: (RUN,))
    found = tables._path_length()
    assert found.rows == [("arm", "1cpu-1gib", "1", "2s", "40 m"), ("arm", "2cpu-1gib", "2", "1.5s", "35 m")]
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
