"""Replayed samples that end when they are decided: what is paid, and what the model is told."""

import numpy as np
import pytest

from fogspec_lab.evaluation.replay import Timing


def test_far_above_ends_at_the_first_checks_and_pays_set_up_and_those_requests():
    """Ten requests that happen to resemble each other do not decide."""
    found = [Timing(request_s=1.0).decided(1.0, 0.5, np.random.default_rng(seed)) for seed in range(50)]
    paid_s = [one[2] for one in found]
    assert min(paid_s) == pytest.approx(159 + 10)
    assert np.median(paid_s) <= 159 + 14
    assert max(paid_s) <= 159 + 40
    assert sum(abs(value - 1) <= 3 * error for value, error, _ in found) >= 45
    assert np.median([one[1] for one in found]) == pytest.approx(0.1 / np.sqrt(10), rel=0.6)


def test_far_below_is_measured_to_its_end():
    assert all(Timing().decided(1.0, 1.2, np.random.default_rng(seed)) is None for seed in range(50))


def test_requests_that_are_too_long_for_ten_are_never_decided():
    assert Timing().decided(31.0, 0.1, np.random.default_rng(0)) is None
