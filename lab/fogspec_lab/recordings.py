"""What is replayed: the results of a benchmark, or a sweep of full measurements."""

import math
import statistics
from dataclasses import dataclass
from pathlib import Path

from fogspec.catalog.machine import Machine
from fogspec.plan.schema import sample_id
from fogspec.results.io import raw_timings, read_results_folder, timings_path
from fogspec.results.ranges import LATENCY_S
from fogspec.results.schema import PUBLISHED, LatencySummary, Measured
from fogspec_lab.tables import read_table

COLUMNS = ("instance_type", "latency_s")  # of a sweep


@dataclass(frozen=True, slots=True)
class Recording:
    """One record to replay, and its raw timings if they were kept (gzip).

    A record that is not `priced` has no cost of its own: it costs the plan's price for its duration. `runner` is that of the
    results that it is replayed into: they are `PUBLISHED` too where the record is.
    """

    record: Measured
    timings: Path | None = None
    priced: bool = True
    runner: str = "replay"


def replayable(path: str, after_s: float) -> tuple[list[Recording], str]:
    """Return the recordings of a file and their source; raise DiagnosticError or InvalidInput.

    A folder of results has each sample as it was. A sweep is CSV with `COLUMNS`, and `infra` where a type is on offer in
    several places; its machines are taken to have measured for `after_s`, and to have cost the plan's price for that time.
    """
    if not path.endswith(".csv"):
        return recordings(path)
    latencies: dict[tuple[str, str], list[float]] = {}
    table = read_table(Path(path), COLUMNS)
    latency_s = table.numbers("latency_s", positive=True, bounds=LATENCY_S).tolist()
    table.check()
    for infra, name, value in zip(table.column("infra"), table.column("instance_type"), latency_s, strict=True):
        latencies.setdefault((infra, name), []).append(value)
    found = [
        Recording(_record(infra, name, measured, after_s), priced=False)
        for (infra, name), measured in latencies.items()
    ]
    return found, f"replayed from the sweep {Path(path).name}"


def _record(infra: str, instance: str, latencies_s: list[float], after_s: float) -> Measured:
    """Repeats of one machine as one record: their mean; what they differ by, as if each had been one request."""
    # The machine of the plan's sample takes its place.
    machine = Machine.model_construct(infra=infra, instance=instance, cpus=0, memory=0.0, price=0.0)
    mean = math.fsum(latencies_s) / len(latencies_s)
    latency = LatencySummary(mean=mean, sd=statistics.stdev(latencies_s) if len(latencies_s) > 1 else None)
    return Measured.model_construct(
        id=sample_id(machine),
        machine=machine,
        measured_on=f"{infra}/{instance}".strip("/"),
        state="ok",
        requests=len(latencies_s),
        latency=latency,
        duration=after_s,
        spent=0.0,
    )


def recordings(path: str) -> tuple[list[Recording], str]:
    """Return the records of a folder of results, to replay, and their source; raises DiagnosticError or InvalidInput."""
    folder = Path(path)
    results = read_results_folder(folder)
    for record in results.spec.samples:
        if record.timings is not None:
            raw_timings(record, folder)
    runner = PUBLISHED if results.spec.runner == PUBLISHED else "replay"
    found = [
        Recording(record, timings_path(folder, record.id) if record.timings else None, runner=runner)
        for record in results.spec.samples
    ]
    return found, f"replayed from {Path(path).name}: {results.spec.source or f'measured with {results.spec.runner}'}"
