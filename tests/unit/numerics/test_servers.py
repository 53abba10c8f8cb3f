"""Another server of the same type: the shift is by cloud and heavy-tailed, and ranges hold there."""

import csv
import gzip
import io

import numpy as np
import pytest
from scipy import stats

from fogspec.numerics.kernels import Machines, codes
from fogspec.numerics.observations import observations
from fogspec.numerics.prediction import Prediction
from fogspec.numerics.servers import OTHER, SHIFTS, shifts_of
from fogspec.numerics.surrogate import Posterior, fit
from fogspec_lab.servers import main, read, scored
from tests.conftest import SHARED
from tests.support.site import ROOT

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


def posterior(cloud: str) -> Posterior:
    """The posterior of five measured machines of nine."""
    random, machines = np.random.default_rng(0), nine(cloud)
    at = random.choice(9, 5, replace=False)
    latency_s = machines.vcpus[at] ** -0.8 * np.exp(0.02 * random.standard_normal(5))
    return fit(machines, observations(at, latency_s, np.full(5, SD)))


@pytest.mark.parametrize(("cloud", "percent"), [("aws", 5), ("azure", 10)])
def test_the_room_that_the_documents_name_is_what_a_measured_machine_needs(cloud: str, percent: int) -> None:
    found = posterior(cloud)
    needed = found.prediction.quantile(0.9)[found.measured] / found.prediction.value[found.measured]
    assert (np.abs(100 * (1 - 1 / needed) - percent) < 1).all()
    shown = [
        (ROOT / name).read_text("utf-8") for name in ("docs/explanation/uncertainty.md", "docs/reference/fields.md")
    ]
    assert all(f"{percent}%" in text for text in shown)


@pytest.mark.parametrize(("cloud", "least", "most"), [("aws", 0.07, 0.1), ("azure", 0.13, 0.17), ("gcp", 0.09, 0.15)])
def test_the_range_of_a_measured_machine_is_that_of_another_server(cloud: str, least: float, most: float) -> None:
    found = posterior(cloud)
    low, high = (np.log(end[found.measured]) for end in found.prediction.interval(0.9))
    here_low, here_high = (np.log(end[found.measured]) for end in found.prediction.on_measured_server.interval(0.9))
    assert ((high - low) / 2 > least).all()
    assert ((high - low) / 2 < most).all()
    assert (here_high - here_low < high - low).all()
    assert np.array_equal(found.prediction.mu, found.mean)


@pytest.mark.parametrize("cloud", ["local", "slurm", "kubernetes", "ssh"])
def test_machines_of_ones_own_have_no_shift(cloud: str) -> None:
    found = posterior(cloud).prediction
    assert np.array_equal(found.interval(0.9), found.on_measured_server.interval(0.9))
    assert SHIFTS[cloud].beyond(0.05) == 0
    assert (found.room(0.9) == 0).all()


def test_unknown_clouds_are_between_the_known() -> None:
    tail, spread = shifts_of(codes(["nowhere", ""]))
    assert (tail == OTHER.tail).all()
    assert (spread == OTHER.spread).all()
    assert SHIFTS["aws"].tail < OTHER.tail < SHIFTS["azure"].tail
    assert SHIFTS["aws"].spread < OTHER.spread < SHIFTS["azure"].spread


def test_the_probability_of_a_larger_shift_is_that_of_the_mixture() -> None:
    shift, random = SHIFTS["aws"], np.random.default_rng(0)
    drawn = random.standard_normal(200_000) * shift.spread * (random.random(200_000) < shift.tail)
    assert shift.beyond(0.05) == pytest.approx((np.abs(drawn) > 0.05).mean(), abs=0.003)


MIXED = Prediction(
    np.array([0.0, 1.0, 2.0, -3.0]),
    np.array([0.01, 0.3, 0.02, 0.001]),
    np.array([0.333, 0.518, 0.0, 0.5]),
    np.array([0.083, 0.119, 0.0, 0.12]),
)


def cdf(one: Prediction, log_value: np.ndarray) -> np.ndarray:
    wide = np.hypot(one.sigma, one.spread)
    return (1 - one.tail) * stats.norm.cdf(log_value, one.mu, one.sigma) + one.tail * stats.norm.cdf(
        log_value, one.mu, wide
    )


@pytest.mark.parametrize("p", [0.001, 0.05, 0.3, 0.5, 0.7, 0.9, 0.95, 0.999])
def test_quantiles_and_probabilities_agree_with_scipy(p: float) -> None:
    at = MIXED.quantile(p)
    assert cdf(MIXED, np.log(at)) == pytest.approx(p, abs=2e-6)
    assert MIXED.probability_below(at) == pytest.approx(p, abs=2e-6)
    assert MIXED.take(np.array([3, 1])).quantile(p) == pytest.approx(at[[3, 1]], rel=1e-9)
    assert MIXED.quantile(np.array([p] * 4)) == pytest.approx(at, rel=1e-9)


def test_ends_of_probabilities() -> None:
    assert (MIXED.probability_below(np.inf) == 1).all()
    assert (MIXED.probability_below(0.0) == 0).all()
    assert (MIXED.probability_below(-1.0) == 0).all()
    for p in (0.0, 1.0, np.nan):
        with pytest.raises(ValueError, match="between 0 and 1"):
            MIXED.quantile(p)


def test_a_range_covers_what_lies_in_it() -> None:
    low, high = (np.log(end) for end in MIXED.interval(0.9))
    assert MIXED.covers(low + 1e-4, 0.9).all()
    assert not MIXED.covers(low - 1e-4, 0.9).any()
    assert not MIXED.covers(high + 1e-4, 0.9).any()


@pytest.mark.parametrize("level", [0.5, 0.9, 0.99])
def test_room_is_what_a_machine_known_exactly_needs(level: float) -> None:
    known = MIXED.widened(1e-6)
    room = known.room(level)
    assert (known.probability_below(np.exp(known.mu + room + 1e-5)) >= level).all()
    assert (known.probability_below(np.exp(known.mu + room - 1e-3)) < max(level, 0.5 + 1e-9)).all()


def test_what_ships_is_what_the_command_fits(capsys: pytest.CaptureFixture[str]) -> None:
    if not REPEATS.is_file():
        pytest.skip("needs the larger data in FOGSPEC_SHARED")
    main([str(REPEATS)])
    said = capsys.readouterr().out
    assert "aws: 25876 pairs; tail 0.333, spread 0.0830" in said
    assert "azure: 2394 pairs; tail 0.518, spread 0.1189" in said


@pytest.mark.parametrize("cloud", ["aws", "azure"])
def test_ranges_and_probabilities_hold_on_second_servers(cloud: str) -> None:
    if not REPEATS.is_file():
        pytest.skip("needs the larger data in FOGSPEC_SHARED")
    moved, _ = read(REPEATS)[cloud]
    covered, probabilities = scored(moved, [(np.ones(len(moved), dtype=bool), SHIFTS[cloud])])
    assert 0.88 <= covered <= 0.92
    for stated, true in probabilities:
        assert stated == pytest.approx(true, abs=0.02)


def test_the_command_reads_and_scores_pairs(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    random = np.random.default_rng(1)
    text = io.StringIO()
    rows = csv.writer(text)
    rows.writerow(["cloud", "benchmark", "instance_type", "days_between", "log_ratio"])
    for i in range(4000):
        moved = SD * random.standard_normal() + 0.1 * random.standard_normal() * (random.random() < 0.3)
        rows.writerow(["aws", "redis", f"type{i % 40}", "2.0", moved])
    path = tmp_path / "repeats.csv.gz"
    path.write_bytes(gzip.compress(text.getvalue().encode()))
    main([str(path)])
    first, kept_out, shipped = capsys.readouterr().out.splitlines()
    tail, spread = (float(part.split()[-1]) for part in first.partition("; ")[2].split(", "))
    assert tail == pytest.approx(0.3, abs=0.06)
    assert spread == pytest.approx(0.1, abs=0.02)
    assert 0.88 <= float(kept_out.split("coverage ")[1].split("%")[0]) / 100 <= 0.92
    assert shipped.startswith("  as shipped: ")
