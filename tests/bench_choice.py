"""How long choosing over 50,000 offers takes: `python -m tests.bench_choice`."""

import statistics
import time

import numpy as np

from fogspec.admissible import Admissible, Funnel
from fogspec.catalog import About, Catalog, texts
from fogspec.choice import choose
from fogspec.models import fit
from fogspec.plan import MachineRef, PlanMetadata
from fogspec.results import LatencySummary, Measured, ResultsBody, sealed
from fogspec.spec import Application

OFFERS, RUNS = 50_000, 21


def offers(count: int, seed: int = 0) -> Catalog:
    """A made-up catalog: machines of many sizes in many regions, prices by size with noise."""
    random = np.random.default_rng(seed)
    vcpus = 2.0 ** random.integers(1, 8, count)
    memory = vcpus * 2.0 ** random.integers(1, 4, count)
    price = (0.03 * vcpus + 0.004 * memory) * np.exp(0.2 * random.standard_normal(count))
    names = texts(f"f{i % 400}.s{int(v)}m{int(m)}" for i, (v, m) in enumerate(zip(vcpus, memory, strict=True)))
    same, none = texts([""] * count), np.zeros(count)
    return Catalog(
        About("made up", "", "", ""), texts(["aws"] * count), texts(f"r{i % 30}" for i in range(count)), same, names, vcpus,
        memory, same, none, none + np.nan, price, none.astype(bool), texts(["x86_64"] * count), same, vcpus / 2, none + 3,
        none.astype(bool),
    ).in_order()  # fmt: skip


def application() -> Application:
    """An application with both limits."""
    return Application.model_validate({
        "apiVersion": "fogspec.dev/v1alpha1", "kind": "Application", "metadata": {"name": "made-up"},
        "spec": {
            "cloud": [{"cmd": ["true"]}], "probe": {"callback": "x"}, "infra": ["aws"],
            "constraints": {"latency": "3s", "cost": "$0.01/request"}, "objective": {"alpha": 0.6},
        },
    })  # fmt: skip


def main() -> None:
    """Print the median, least and greatest time of one choice."""
    catalog = offers(OFFERS)
    admissible = Admissible(catalog, Funnel(OFFERS, ()))
    records = [
        Measured(id=f"s{c:g}-{m:g}", machine=MachineRef(infra="aws/r", instance=f"s{c:g}-{m:g}", cpus=c, memory=m, price=0.1),
                 measured_on="x", state="ok", requests=9, latency=LatencySummary(mean=1 + 8 / c), duration=9.0, spent=0.0)
        for c in (2.0, 16.0, 128.0) for m in (2 * c, 4 * c, 8 * c)
    ]  # fmt: skip
    results = sealed(PlanMetadata(name="made-up"), ResultsBody(
        application="", plan=None, runner="x", spent=0.0, samples=records))  # fmt: skip
    made = application()
    fit_s, choose_s = [], []
    for _ in range(RUNS):
        start = time.perf_counter()
        models = fit(made, results)
        fitted = time.perf_counter()
        choose(made, models, admissible)
        fit_s.append(fitted - start)
        choose_s.append(time.perf_counter() - fitted)
    for name, walls in ((f"choosing over {OFFERS:,} offers", choose_s), ("fitting 9 samples", fit_s)):
        ms = [1000 * wall for wall in sorted(walls)]
        print(f"{name}: median {statistics.median(ms):.1f} ms (min {ms[0]:.1f}, max {ms[-1]:.1f}, {RUNS} runs)")


if __name__ == "__main__":
    main()
