"""Replayed samples that end when they are decided: what is paid, and what the model is told."""

import numpy as np
import pytest

from fogspec.evaluation.replay import Timing


def test_far_above_ends_at_the_first_check_and_pays_set_up_and_ten_requests():
    timing = Timing(request_s=1.0)
    value, error, share = timing.decided(1.0, 0.5, np.random.default_rng(0))
    assert share == pytest.approx((159 + 10) / (159 + 200))
    assert value == pytest.approx(1, abs=4 * error)
    assert error == pytest.approx(0.1 / np.sqrt(10), rel=0.6)


def test_far_below_is_measured_to_its_end():
    assert all(Timing().decided(1.0, 1.2, np.random.default_rng(seed)) is None for seed in range(50))


def test_requests_that_are_too_long_for_ten_are_never_decided():
    assert Timing().decided(31.0, 0.1, np.random.default_rng(0)) is None
