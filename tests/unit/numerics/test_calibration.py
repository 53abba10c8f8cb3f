"""How far left-out machines lie from what the others say, against fits without them, and the widths of ranges."""

from dataclasses import replace

import numpy as np
import pytest

from fogspec.numerics.calibration import MOST_WIDENED, Calibration
from fogspec.numerics.observations import observations
from fogspec.numerics.surrogate import Posterior, fit
from tests.support.machines import amdahl, family

AT = [0, 2, 4, 7, 9, 11, 13, 16]


def samples(off: float) -> np.ndarray:
    """Latencies of a scaling law, each off by up to this."""
    random = np.random.default_rng(3)
    return amdahl(family(), 0.1)[AT] * np.exp(off * random.uniform(-1, 1, len(AT)))


def posterior(latency: np.ndarray, errors: list[float] | None = None) -> Posterior:
    machines = family()
    machines = replace(machines, cloud=np.full(len(machines), -1))
    return fit(machines, observations(AT, latency, errors))


def test_deviations_are_those_of_fits_without_each_machine() -> None:
    latency = samples(0.15)
    found = posterior(latency)
    assert found.left_out is not None
    for deviation, left, seconds in zip(found.left_out(), AT, latency, strict=True):
        others = [i for i, one in enumerate(AT) if one != left]
        without = fit(found.machines, observations(np.array(AT)[others], latency[others])).widened(float(deviation))
        above = seconds > np.exp(without.mean[left])
        assert without.quantile(0.95 if above else 0.05)[left] == pytest.approx(seconds, rel=0.02)


def test_ranges_that_hold_stay_and_others_widen_until_they_do() -> None:
    assert posterior(samples(0.0)).calibration.factor == 1
    found = posterior(samples(0.5))
    calibration = found.calibration
    assert calibration.machines == len(AT)
    assert calibration.covered < calibration.covered_widened == 7
    assert 1 < calibration.factor <= MOST_WIDENED
    wide, narrow = found.elsewhere, found.widened(1.0)
    for p in (0.05, 0.95):
        stretched = found.mean + (np.log(narrow.quantile(p)) - found.mean) * calibration.factor
        assert np.log(wide.quantile(p)) == pytest.approx(stretched, abs=1e-6)
        assert wide.probability_below(wide.quantile(p)) == pytest.approx(p, abs=1e-6)
    some = wide.take(np.array([5, 2]))
    assert some.quantile(0.9) == pytest.approx(wide.quantile(0.9)[[5, 2]], rel=1e-9)


def test_measured_machines_widen_only_where_their_spread_is_unknown() -> None:
    machines = family()
    known = [0.01] * 4 + [np.nan] * 4
    found = fit(machines, observations([*AT, AT[7]], [*samples(0.5), 1.0], [*known, np.nan])).widened(2.0)
    assert found.stretch is not None
    assert found.stretch[AT].tolist() == [1, 1, 1, 1, 2, 2, 2, 1]
    assert set(np.delete(found.stretch, AT)) == {2}


def test_few_samples_say_nothing_of_ranges() -> None:
    assert Calibration.of(np.array([9.0, 9.0, 9.0, 9.0])) == Calibration(4, 0, 1.0, 0)
    assert Calibration.of(np.array([0.5, 1.31, 0.2, 0.7, 0.9])) == Calibration(5, 4, 1.4, 5)
    assert Calibration.of(np.full(20, 50.0)).factor == MOST_WIDENED
    assert fit(family(), observations([], [])).calibration == Calibration(0, 0, 1.0, 0)
