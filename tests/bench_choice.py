"""How long fitting and choosing takes, for one family and for a whole catalog: `python -m tests.bench_choice`.

Choosing again is with another alpha. Times are of the processor, of all threads;
commands have one for linear algebra, as with OPENBLAS_NUM_THREADS=1.
"""

import statistics
import time

import numpy as np

from fogspec.catalog.machine import Machine
from fogspec.catalog.sources import load_catalog
from fogspec.catalog.table import About, Catalog, strings
from fogspec.choice.choose import choose
from fogspec.language.schema import Application
from fogspec.model.fit import Fitted, fit
from fogspec.model.predict import predict
from fogspec.results.schema import LatencySummary, Measured, ResultsBody, results_of

OFFERS, RUNS = 50_000, 21


def offers(count: int, seed: int = 0) -> Catalog:
    """A made-up catalog: machines of many sizes in many regions, prices by size with noise."""
    random = np.random.default_rng(seed)
    vcpus = 2.0 ** random.integers(1, 8, count)
    memory = vcpus * 2.0 ** random.integers(1, 4, count)
    price = (0.03 * vcpus + 0.004 * memory) * np.exp(0.2 * random.standard_normal(count))
    names = strings(f"f{i % 400}.s{int(v)}m{int(m)}" for i, (v, m) in enumerate(zip(vcpus, memory, strict=True)))
    same, none = strings([""] * count), np.zeros(count)
    return Catalog(
        about=About("made up", "", "", ""),
        cloud=strings(["aws"] * count),
        region=strings(f"r{i % 30}" for i in range(count)),
        zone=same,
        instance=names,
        vcpus=vcpus,
        memory_gib=memory,
        gpu=same,
        gpu_count=none,
        gpu_memory_gib=none + np.nan,
        price_usd_per_hour=price,
        spot=none.astype(bool),
        arch=strings(["x86_64"] * count),
        family=same,
        physical_cores=vcpus / 2,
        clock_ghz=none + 3,
        burstable=none.astype(bool),
    ).in_order()


def application() -> Application:
    """An application with both limits."""
    return Application.model_validate({
        "apiVersion": "fogspec.dev/v1alpha1", "kind": "Application", "metadata": {"name": "made-up"},
        "spec": {
            "cloud": [{"cmd": ["true"]}], "probe": {"callback": "x"}, "infra": ["aws"],
            "constraints": {"latency": "3s", "cost": "$0.01/request"}, "objective": {"alpha": 0.6},
        },
    })  # fmt: skip


def measured(names: dict[str, tuple[float, float]] | None = None) -> Fitted:
    """Nine samples; `names` gives the instance types, vCPUs and GiB."""
    shapes = names or {f"s{c:g}-{m:g}": (c, m) for c in (2.0, 16.0, 128.0) for m in (2 * c, 4 * c, 8 * c)}
    records = [
        Measured(id=name, machine=Machine(infra="aws/r", instance=name, cpus=c, memory=m, price=0.1),
                 measured_on="x", state="ok", requests=9, latency=LatencySummary(mean=1 + 8 / c), duration=9.0, spent=0.0)
        for name, (c, m) in shapes.items()
    ]  # fmt: skip
    body = ResultsBody(inputs={}, runner="x", samples=records)
    return fit(application(), results_of(body))


def main() -> None:
    """Print the median, least and greatest time of each step."""
    catalog = load_catalog(None, ("aws",))
    of_type = np.array([str(name).partition(".")[0] for name in catalog.instance])
    family = catalog.take(np.isin(of_type, ("c6i", "m6i", "r6i")) & ~catalog.spot)
    grid = {f"{f}.{size}": (v, v * r) for f, r in (("c6i", 2), ("m6i", 4), ("r6i", 8))
            for size, v in (("large", 2.0), ("4xlarge", 16.0), ("16xlarge", 64.0))}  # fmt: skip
    for name, rows, models in (
        ("one family", family, measured(grid)), ("the catalog of one cloud", catalog, measured(grid)),
        (f"{OFFERS:,} offers", offers(OFFERS), measured()),
    ):  # fmt: skip
        made, took = application(), {"fit and choose": [], "choose again": []}
        spec = made.spec.model_copy(update={"objective": made.spec.objective.model_copy(update={"alpha": 0.4})})
        other = made.model_copy(update={"spec": spec})
        types = 0
        for _ in range(RUNS):
            start = time.process_time()
            predicted = predict(models, rows, ["latency"])
            assert choose(made, predicted).chosen is not None  # a choice is made when it is asked for
            fitted = time.process_time()
            assert choose(other, predicted).chosen is not None
            took["fit and choose"].append(fitted - start)
            took["choose again"].append(time.process_time() - fitted)
            types = len(predicted.types)
        for what, walls in took.items():
            ms = [1000 * wall for wall in sorted(walls)]
            print(
                f"{what}, {name} ({len(rows):,} offers of {types:,} types): median {statistics.median(ms):.1f} ms "
                f"(min {ms[0]:.1f}, max {ms[-1]:.1f}, {RUNS} runs)"
            )


if __name__ == "__main__":
    main()
