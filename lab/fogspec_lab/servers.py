"""How servers of one instance type differ: fit `fogspec.numerics.servers` and score it on types kept out of the fit.

    python -m fogspec_lab.servers repeats.csv.gz

The file has columns cloud, benchmark, instance_type, log_ratio: how one score moved between two runs of a benchmark on a type,
more than a day apart. Each score is a program. A pair's difference is a mixture of two normals, of which the narrow one is the
error of a sample; tail and spread are those whose distribution is nearest to that of the pairs (Cramér and von Mises).
"""

import csv
import gzip
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from zlib import crc32

import numpy as np
from scipy.optimize import minimize

from fogspec.numerics.kernels import Floats
from fogspec.numerics.prediction import Prediction
from fogspec.numerics.servers import SHIFTS, Shift

SAMPLE_ERROR = 0.0153  # of a sample of many requests, with what servers differ by whatever runs on them
FOLDS = 8
ROOMS = (0.02, 0.05, 0.1, 0.2)
LEVEL = 0.9


def read(path: Path) -> dict[str, tuple[Floats, Floats]]:
    """Return the log ratios (n,) of each cloud, and the fold (n,) of each pair, the same for all pairs of a type."""
    found: dict[str, list[tuple[float, int]]] = {}
    with gzip.open(path, "rt", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            fold = crc32(row["instance_type"].encode()) % FOLDS
            found.setdefault(row["cloud"], []).append((float(row["log_ratio"]), fold))
    columns = {cloud: np.array(pairs).T for cloud, pairs in sorted(found.items())}
    return {cloud: (moved, fold) for cloud, (moved, fold) in columns.items()}


def fit(moved: Floats) -> Shift:
    """Return the shift whose distribution is nearest to that of these log ratios (n,)."""
    size = np.sort(np.abs(moved))
    share = (np.arange(len(size)) + 0.5) / len(size)

    def distance(at: Floats) -> float:
        likely = 2 * _prediction(_shift(at)).probability_below(np.exp(size)) - 1
        return float(((likely - share) ** 2).mean())

    return _shift(minimize(distance, [-0.5, np.log(0.1)], method="Nelder-Mead", options={"xatol": 1e-6}).x)


def _shift(at: Floats) -> Shift:
    return Shift(tail=float(1 / (1 + np.exp(-at[0]))), spread=float(np.exp(at[1])))


def _prediction(shift: Shift) -> Prediction:
    """Return the prediction of a second server's latency over the first one's."""
    return Prediction(np.zeros(1), np.full(1, SAMPLE_ERROR), np.full(1, shift.tail), np.full(1, shift.spread))


def scored(moved: Floats, shifts: Iterable[tuple[np.ndarray, Shift]]) -> tuple[float, list[tuple[float, float]]]:
    """Return the coverage of the range, and (stated, found) probabilities for `ROOMS`; each shift is for some pairs (n,)."""
    inside, stated, found = 0.0, np.zeros(len(ROOMS)), np.zeros(len(ROOMS))
    for some, shift in shifts:
        one, pairs = _prediction(shift), moved[some]
        low, high = one.interval(LEVEL)
        inside += float(((np.log(low) <= pairs) & (pairs <= np.log(high))).sum())
        for i, room in enumerate(np.log1p(ROOMS)):
            stated[i] += len(pairs) * float(one.probability_below(np.exp(room))[0])
            found[i] += float(((pairs <= room).sum() + (-pairs <= room).sum()) / 2)  # either may have been the first
    return inside / len(moved), list(zip((stated / len(moved)).tolist(), (found / len(moved)).tolist(), strict=True))


def main(arguments: Sequence[str]) -> None:
    """Print the fit of each cloud and its scores on types that were kept out, and those of what ships."""
    for cloud, (moved, fold) in read(Path(arguments[0])).items():
        folds = [(fold == one, fit(moved[fold != one])) for one in np.unique(fold)]
        fitted, shipped = fit(moved), SHIFTS.get(cloud)
        print(f"{cloud}: {len(moved)} pairs; tail {fitted.tail:.3f}, spread {fitted.spread:.4f}")
        ways = [("kept out", folds)] + ([("as shipped", [(fold >= 0, shipped)])] if shipped else [])
        for name, shifts in ways:
            covered, probabilities = scored(moved, shifts)
            words = ", ".join(
                f"{room:.0%} {p:.3f}/{met:.3f}" for room, (p, met) in zip(ROOMS, probabilities, strict=True)
            )
            print(f"  {name}: coverage {covered:.1%}; P stated/true at room {words}")


if __name__ == "__main__":
    main(sys.argv[1:])
