"""Compare records of results with the raw timings that they were computed from."""

import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fogspec.base.errors import InvalidInput
from fogspec.results.io import raw_timings, timings_path
from fogspec.results.ranges import ERROR
from fogspec.results.requests import RecordRules, parse_requests
from fogspec.results.schema import LatencySummary, Measured, Results
from fogspec.results.statistics import errors_of, latency_of, metric_of, paid_s


def contradictions(results: Results, folder: Path, rules: RecordRules) -> Iterator[str]:
    """Yield a sentence for each difference between the records of results in `folder` and their raw timings.

    Raw timings that are missing, damaged, or not as recorded are a difference too.
    """
    for record in results.spec.samples:
        if record.timings is not None:
            yield from _differences(record, folder, rules)


def _differences(record: Measured, folder: Path, rules: RecordRules) -> Iterator[str]:
    path = timings_path(folder, record.id)
    try:
        content = raw_timings(record, folder)
    except InvalidInput as wrong:
        yield wrong.message
        return
    requests = parse_requests(io.BytesIO(content), rules)
    latency = latency_of(requests, rules.scenarios)
    now: dict[str, Any] = {
        "requests": len(requests.latencies_s),
        "failed_requests": requests.failed,
        "latency": latency,
    }
    if record.busy is not None and latency is not None:
        now["busy"] = paid_s(requests, latency.mean, record.resources, rules)
    if record.errors is not None:
        now["errors"] = errors_of(requests, rules.scenarios)
    if record.metric_errors is not None:
        metrics = {name: metric_of(values, rules.scenarios) for name, values in requests.metrics.items()}
        now["metrics"] = {name: mean for name, (mean, _) in metrics.items()}
        now["metric_errors"] = {name: error for name, (_, error) in metrics.items() if error <= ERROR.most}
    for name, found in now.items():
        was = getattr(record, name)
        if not _same(was, found):
            yield f"{record.id}: {name} is {was} in the record, {found} from {path}"


def _same(was: Any, found: Any) -> bool:
    """Compare values, numbers to nine digits: another version may sum in another order."""
    if isinstance(was, LatencySummary) and isinstance(found, LatencySummary):
        return all(_same(getattr(was, name), getattr(found, name)) for name in LatencySummary.model_fields)
    if isinstance(was, dict) and isinstance(found, dict):
        return was.keys() == found.keys() and all(_same(was[name], found[name]) for name in was)
    if isinstance(was, float) and isinstance(found, float):
        return math.isclose(was, found, rel_tol=1e-9)
    return bool(was == found)
