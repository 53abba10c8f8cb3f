"""Build the tables of the report: samples, curves, residuals."""

import numpy as np

from fogspec.base import units
from fogspec.base.units import rounded
from fogspec.catalog.machine import Machine
from fogspec.choice.sensitivity import Refits, left_out_prediction
from fogspec.model.fit import Fitted, Observation
from fogspec.numerics import families
from fogspec.plan.schema import Plan
from fogspec.report.facts import Block
from fogspec.results.resources import use_line
from fogspec.results.schema import Measured, Results

MEASURED_HEADS = (
    "machine", "infra", "vCPU", "memory", "GPU", "price per hour", "state", "requests", "mean", "sd", "p50", "p95", "p99",
    "metrics", "took", "spent", "measured on", "used",
)  # fmt: skip


def planned_table(plan: Plan) -> Block:
    """Return the table of planned samples."""
    rows = [(s.machine.instance, s.machine.infra, *_shape(s.machine), s.reason) for s in plan.spec.samples]
    return Block(rows, ("machine", "infra", "vCPU", "memory", "GPU", "price per hour", "why"), numbers=(2, 3, 5))


def measured_table(results: Results) -> Block:
    """Return the table of measured samples, without empty columns."""
    source = f"; {results.spec.source}" if results.spec.source else ""
    rows = [_measured(one) for one in results.spec.samples]
    numbers = (2, 3, 5, 7, 8, 9, 10, 11, 12, 14, 15)
    used = [at for at in range(len(MEASURED_HEADS)) if any(row[at] for row in rows)]
    return Block(
        [tuple(row[at] for at in used) for row in rows],
        tuple(MEASURED_HEADS[at] for at in used),
        [f"runner: {results.spec.runner}{source}"],
        tuple(i for i, at in enumerate(used) if at in numbers),
    )


def _shape(machine: Machine) -> tuple[str, str, str, str]:
    gpu = machine.gpu.label if machine.gpu else ""
    return f"{machine.cpus:g}", f"{units.shown(machine.memory)} GiB", gpu, units.shown_price(machine.price)


def _measured(one: Measured) -> tuple[str, ...]:
    why = ": ".join(text for text in (one.reason, one.detail) if text)
    latency = one.latency
    times = (latency.mean, latency.sd, latency.p50, latency.p95, latency.p99) if latency else (None,) * 5
    metrics = ", ".join(f"{name} {rounded(value):g}" for name, value in one.metrics.items())
    return (
        one.machine.instance + (" spot" if one.machine.spot else ""),
        one.machine.infra,
        *_shape(one.machine),
        f"{one.state} ({why})" if why else one.state,
        str(one.requests),
        *(_time(value) for value in times),
        metrics,
        units.shown_duration(one.duration),
        units.money(one.spent),
        "" if one.server is None else one.server.line(),
        "" if one.resources is None else use_line(one.resources),
    )


def _time(seconds: float | None) -> str:
    return "" if seconds is None else units.shown_duration(seconds)


def curve_table(models: Fitted) -> Block:
    """Return the table of the curves, one for each GPU type and target."""
    heads = ("of", "formula", "coefficients", "samples", "R²", "leave-one-out error, median", "max")
    rows = [
        (
            model.target + (f" with {model.gpu}" if model.gpu else ""),
            model.formula,
            ", ".join(f"{name} = {rounded(value):g}" for name, value in model.coefficients.items()),
            str(model.n),
            "" if model.r2 is None else f"{model.r2:.4f}",
            _share(model.loo_median_error),
            _share(model.loo_max_error),
        )
        for model in models.curves
    ]
    return Block(rows, heads, numbers=range(3, 7))


def residual_table(models: Fitted, refits: Refits) -> Block:
    """Return the table of samples, with the prediction of each by its curve and by the samples of all other machines."""
    fitted = {model.gpu: model for model in models.curves if model.target == "latency"}
    heads = ("sample", "measured", "curve", "curve's error", "predicted without it", "90% interval", "error")
    rows = []
    for one in models.observations:
        model = fitted.get(one.machine.gpu_key)
        latency = one.values["latency"]
        curve = None
        if model is not None:
            at = np.array([one.machine.cpus]), np.array([one.machine.memory])
            curve = float(families.predict(model.shape, list(model.coefficients.values()), *at)[0])
        known = _predicted(models, refits, one)
        rows.append(
            (one.machine.instance, _time(latency), _time(curve), _off(curve, latency), *_without(known, latency))
        )
    return Block(rows, heads, numbers=range(1, 7))


def _without(known: tuple[float, float, float] | None, latency: float) -> tuple[str, str, str]:
    """Return the leave-one-out prediction of a sample: value, interval and error, empty if it is unavailable."""
    if known is None:
        return "", "", ""
    value, low, high = known
    return _time(value), f"{_time(low)} to {_time(high)}", _off(value, latency)


def _predicted(models: Fitted, refits: Refits, one: Observation) -> tuple[float, float, float] | None:
    key = one.machine.type_key
    others = [other for other in models.observations if other.machine.type_key != key]
    predicted = refits.of(others) if others else None
    return None if predicted is None else left_out_prediction(predicted, one)


def _off(predicted: float | None, measured: float) -> str:
    return "" if predicted is None else f"{predicted / measured - 1:+.1%}"


def _share(value: float | None) -> str:
    return "" if value is None else f"{value:.1%}"
