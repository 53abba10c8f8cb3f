"""Another server of the same type: the shift is by cloud and heavy-tailed, and ranges hold there."""

import csv
import gzip
import io
from collections import defaultdict

import numpy as np
import pytest
from scipy import stats

from fogspec.numerics.kernels import Machines, codes
from fogspec.numerics.observations import observations
from fogspec.numerics.servers import OTHER, SHIFTS, shifts_of
from fogspec.numerics.surrogate import Posterior, fit
from tests.conftest import SHARED

REPEATS = SHARED / "data" / "servers" / "repeats.csv.gz"
SD = 0.0153  # of a sample of many requests, with what two servers usually differ by


def nine(cloud: str) -> Machines:
    """Three families of three sizes."""
    vcpus, none = np.tile([2.0, 8.0, 32.0], 3), np.zeros(9, dtype=np.int64)
    return Machines(
        vcpus=vcpus, memory_gib=vcpus * np.repeat([2.0, 4.0, 8.0], 3), price_usd_per_hour=vcpus * 0.04,
        family=none + np.repeat([1, 2, 3], 3), arch=none + 1, cloud=codes([cloud] * 9), cpu_model=none + 1, gpu=none - 1,
        gpu_count=np.zeros(9), gpu_memory_gib=np.full(9, np.nan), physical_cores=vcpus / 2, clock_ghz=np.full(9, 3.0),
        burstable=np.zeros(9, dtype=bool),
    )  # fmt: skip


def posterior(cloud: str, seed: int = 0, count: int = 5) -> tuple[Posterior, np.ndarray]:
    """The posterior of `count` measured machines, and their log-latencies as measured."""
    random, machines = np.random.default_rng(seed), nine(cloud)
    at = random.choice(9, count, replace=False)
    latency_s = machines.vcpus[at] ** -0.8 * np.exp(0.02 * random.standard_normal(count))
    values = np.full(9, np.nan)
    values[at] = np.log(latency_s)
    return fit(machines, observations(at, latency_s, np.full(count, SD))), values


def ends(one: Posterior) -> tuple[np.ndarray, np.ndarray]:
    return np.log(one.quantile(0.05)), np.log(one.quantile(0.95))


@pytest.mark.parametrize(
    ("cloud", "least", "most"), [("aws", 0.029, 0.045), ("azure", 0.12, 0.17), ("gcp", 0.06, 0.15)]
)
def test_the_range_of_a_measured_machine_is_that_of_another_server(cloud: str, least: float, most: float) -> None:
    found, _ = posterior(cloud)
    low, high = (end[found.measured] for end in ends(found.elsewhere))
    assert ((high - low) / 2 > least).all()
    assert ((high - low) / 2 < most).all()
    assert (np.diff(ends(found), axis=0)[0] < high.max() - low.min()).all()


def test_quantiles_and_probabilities_agree_with_scipy() -> None:
    found, _ = posterior("azure")
    elsewhere, shift = found.widened(1.0), SHIFTS["azure"]
    assert elsewhere.mean is not None
    assert np.array_equal(elsewhere.mean, found.mean)
    limit = float(np.exp(found.mean[0] + 0.05))
    core = found.weights @ stats.norm.cdf(np.log(limit), found.means, np.sqrt(found.variances + shift.core**2))
    wide = stats.norm.cdf(np.log(limit), found.mean, np.sqrt(found.sd**2 + shift.core**2 + shift.spread**2))
    expected = (1 - shift.tail) * core + shift.tail * wide
    assert elsewhere.probability_below(limit) == pytest.approx(expected, abs=1e-6)
    assert elsewhere.probability_below(elsewhere.quantile(0.95)) == pytest.approx(0.95, abs=1e-5)
    some = elsewhere.take(np.array([3, 1]))
    assert some.quantile(0.9) == pytest.approx(elsewhere.quantile(0.9)[[3, 1]], rel=1e-9)


@pytest.mark.parametrize("cloud", ["aws", "azure", "gcp", "local"])
def test_a_shift_in_a_range_is_as_likely_as_drawn(cloud: str) -> None:
    random, shift, n = np.random.default_rng(0), SHIFTS.get(cloud, OTHER), 200_000
    wide = shift.spread * (random.random(n) < shift.tail)
    drawn = random.standard_normal(n) * np.hypot(shift.core, wide)
    for low, high in ((-0.01, 0.02), (0.03, 0.2), (-1.0, 1.0)):
        inside = float(np.mean((drawn > low) & (drawn < high)))
        found = shifts_of(codes([cloud])).between(np.array([low]), np.array([high]))
        assert found == pytest.approx([inside], abs=0.005)


def test_the_probability_of_a_larger_shift_is_that_of_the_mixture() -> None:
    shift = SHIFTS["aws"]
    drawn = np.random.default_rng(0).standard_normal(200_000)
    tail = np.random.default_rng(1).random(200_000) < shift.tail
    assert shift.beyond(0.05) == pytest.approx(
        (np.abs(drawn * np.where(tail, shift.spread, shift.core)) > 0.05).mean(), abs=0.003
    )
    assert SHIFTS["local"].beyond(0.05) == 0


def test_this_host_has_one_server_and_unknown_clouds_are_between_the_known() -> None:
    found, _ = posterior("local")
    assert np.allclose(ends(found.widened(1.0)), ends(found))
    unknown = shifts_of(codes(["nowhere", ""]))
    assert (unknown.tail == OTHER.tail).all()
    assert SHIFTS["aws"].tail < OTHER.tail < SHIFTS["azure"].tail


def shifts(cloud: str, benchmark: str) -> np.ndarray:
    """The median over the scores of each pair of servers."""
    found = defaultdict(list)
    for row in csv.DictReader(io.StringIO(gzip.decompress(REPEATS.read_bytes()).decode())):
        if (row["cloud"], row["benchmark"].partition(":")[0]) == (cloud, benchmark):
            found[row["instance_type"]].append(float(row["log_ratio"]))
    return np.array([np.median(one) for one in found.values()])


@pytest.mark.parametrize(("cloud", "benchmark"), [("aws", "redis"), ("aws", "static_web"), ("azure", "geekbench")])
def test_ranges_cover_a_second_server(cloud: str, benchmark: str) -> None:
    """90% ranges of measured machines, scored against second servers of real types: 0.82 and 0.59 without the term."""
    if not REPEATS.is_file():
        pytest.skip("needs the larger data in FOGSPEC_SHARED")
    moved = shifts(cloud, benchmark)
    covered = []
    for seed in range(12):
        found, values = posterior(cloud, seed, count=3 + seed % 7)
        low, high = (end[found.measured][:, None] for end in ends(found.elsewhere))
        second = values[found.measured][:, None] + moved
        covered.append(float(((low <= second) & (second <= high)).mean()))
    assert 0.88 <= np.mean(covered) <= 0.92
