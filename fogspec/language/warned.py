"""Warnings as files keep them: a code and its values, `{code: few_samples, target: latency, samples: 3}`.

The set of codes is closed. Each function here is one code: its parameters are the values, numbers with their unit in the name,
and it returns the sentence for people. Only `sentence` and `as_data` call it, where text is printed, so that another wording
changes no file.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, ParamSpec

from pydantic import AfterValidator, BaseModel, ValidationError, WithJsonSchema, validate_call

from fogspec.base.clouds import LOCAL, cloud_of
from fogspec.base.text import count, line
from fogspec.base.units import (
    UnitError,
    dollars,
    format_rate,
    rounded,
    shown,
    shown_beside,
    shown_duration,
    shown_memory,
)
from fogspec.language.fingerprints import change_text
from fogspec.language.schema import Waiver

P = ParamSpec("P")
NAMED = 6
MOST_MISSED = 1000.0
NEWER = "written by a newer fogspec: pip install --upgrade fogspec"


def partial(*, measured: int, planned: int, missing: list[str], candidates_changed: bool = False) -> str:
    """Warn that the plan was not carried out."""
    if missing:
        more = ", ..." if len(missing) > NAMED else ""
        return f"{measured} of {planned} planned samples are measured; to measure: {', '.join(missing[:NAMED])}{more}"
    changed, more = "the candidates have changed since machines were selected", "the next machines are not selected yet"
    return f"sampling did not end after {planned} samples; {changed if candidates_changed else more}"


def waived(*, samples: int, of: int, waivers: list[Waiver]) -> str:
    """Warn of samples from before changes that the spec waives, with its reasons."""
    named = "; ".join(f"{change_text(one)} ({one.reason})" for one in waivers)
    return f"{samples} of {count(of, 'sample')} measured before changes that the spec waives: {named}"


def confirmed(
    *,
    samples: int,
    of: int,
    changes: list[str],
    sample: str,
    latency_s: float,
    interval_s: tuple[float, float],
    level: float,
) -> str:
    """Warn of samples from before changes after which one more sample agreed with them."""
    low, high = map(shown_duration, interval_s)
    return (
        f"{samples} of {count(of, 'sample')} measured before changes: {'; '.join(changes)}; confirmed: {sample} took "
        f"{shown_duration(latency_s)}, the {level:.0%} interval of the older results is [{low}, {high}]"
    )


def host_only() -> str:
    """Warn that shapes of one host were measured."""
    return (
        "extrapolated: measured on one host's CPUs and memory, not on machines of the catalog, whose CPUs differ: "
        "the ranking is a guess, and how far off it is cannot be said"
    )


def relaxed_end(*, machine: str | None = None, better: str | None = None, probability: float | None = None) -> str:
    """Warn that the relaxed method ends elsewhere than the exhaustive one."""
    if machine is None:
        return "the relaxed method ends beside no machine that meets the limits, though there are some: use exhaustive"
    if better is not None:
        return f"the relaxed method ends at {machine}; {better} meets the limits and is better: use exhaustive"
    likely = "" if probability is None else f": with probability {probability:.2f} it does"
    return (
        f"the relaxed method ends at {machine} because its own curve says that it meets the limits; the model of method: "
        f"exhaustive says that it does not{likely}"
    )


def no_confidence(*, machine: str, probability: float | None = None) -> str:
    """Warn that the spec does not ask with which probability the choice meets the limits."""
    known = "is not known" if probability is None else f"is {probability:.2f}"
    return f"constraints.confidence: none: the probability that {machine} meets the limits {known}"


def not_verified(*, machine: str, extrapolated: bool = False) -> str:
    """Warn that the choice was not measured."""
    how = "extrapolated: it lies outside the vCPUs, memory and kinds of machine that were sampled"
    return f"not verified: {machine} was not measured, its latency is {how if extrapolated else 'predicted'}"


def spread_unknown(*, samples: int, of: int, assumed_error: float) -> str:
    """Warn of samples with a mean and no spread."""
    return (
        f"the spread of requests is unknown for {samples} of {of} samples: each is assumed to err by "
        f"{assumed_error:.1%}, on which probabilities rest"
    )


def error_unknown(*, samples: list[str], statistic: str) -> str:
    """Warn of samples whose requests do not tell how far their statistic is from that of more requests."""
    return (
        f"how far the {statistic} of {', '.join(samples)} is from that of more requests is not known: they are too few "
        f"or too much alike: measure more (spec.benchmark.stop)"
    )


def waits(*, machine: str, requests_per_s: float, alone_s: float, latency_s: float | None = None) -> str:
    """Warn of requests that wait for one another at the declared rate; without a latency, ever longer."""
    at_rate, alone = f"{machine}: at {format_rate(requests_per_s)}", shown_duration(alone_s)
    if latency_s is None:
        return (
            f"{at_rate}, requests come faster than it answers them, and wait ever longer: one by one they take {alone}"
        )
    return f"{at_rate}, evenly spaced, requests wait for one another: {shown_duration(latency_s)}, not {alone}"


def rate_unknown(*, samples: list[str], requests_per_s: float, sent_per_s: float | None = None) -> str:
    """Warn of samples that do not say how long requests wait at the declared rate."""
    rate, named = format_rate(requests_per_s), ", ".join(samples)
    if sent_per_s is None:
        return f"how long requests wait at {rate} is not known for {named}: no raw timings of them tell it"
    sent = f"several at a time, {shown(sent_per_s)} a second"
    return (
        f"how long requests wait at {rate} is not known for {named}, where they were sent {sent}: send them as fast, or one "
        f"after the other (spec.benchmark.workload)"
    )


def few_samples(*, target: str, gpu: str | None = None, samples: int) -> str:
    """Warn of a curve through few samples."""
    number = count(samples, "sample")
    return f"{_curve(target, gpu)}: R² is not informative with {number} and 2 parameters: it is high on noise too"


def constant_curve(*, target: str, gpu: str | None = None) -> str:
    """Warn of a curve that predicts as badly as the mean."""
    return f"{_curve(target, gpu)}: no curve has a lower leave-one-out error than the mean: the model is a constant"


def curve_error(*, target: str, gpu: str | None = None, leave_one_out: float) -> str:
    """Warn of a curve that misses samples that it was not fitted to."""
    large = leave_one_out >= MOST_MISSED
    worst = f"more than {MOST_MISSED:.0f} times its value" if large else f"up to {leave_one_out:.0%}"
    return f"{_curve(target, gpu)}: leave-one-out error of {worst}, whatever R² is"


def sample_rejected(
    *,
    sample: str,
    state: str,
    detail: str | None = None,
    statistic: str | None = None,
    requests: int = 0,
    latency_s: float | None = None,
) -> str:
    """Warn of a sample without a value that counts: too few requests for a statistic, no latency, or how it ended."""
    why = state.replace("_", " ") + (f": {detail}" if detail else "")
    if latency_s is not None:
        why = f"a latency of {latency_s:g} s is not a latency"
    elif statistic is not None:
        why = f"{requests} requests are too few for a {statistic}"
    return f"sample {sample} does not count: {why}"


def mixed_servers(*, machine: str, cpus: list[str]) -> str:
    """Warn of an instance type that was measured on servers with different CPUs."""
    return f"{machine} is not one kind of machine: it was measured on {' and on '.join(cpus)}"


def gpu_idle(*, sample: str, most_busy: float) -> str:
    """Warn of a sample that did not use its GPU."""
    return f"sample {sample}: its GPU was idle, {most_busy:.0%} busy at most: a machine without one may do [FS901]"


def swapped(*, sample: str, swapped_gib: float) -> str:
    """Warn of a sample that measured its machine's disk."""
    memory = shown_memory(swapped_gib)
    return f"sample {sample}: its machine swapped {memory} while requests were measured: it needs more memory [FS902]"


def more_memory(*, sample: str, used_gib: float, memory_gib: float) -> str:
    """Warn of a sample whose processes had more memory than its machine has."""
    used, has = shown_memory(used_gib), shown_memory(memory_gib)
    return (
        f"sample {sample}: its processes had {used} of memory, and its machine has {has}: pages that they share count in "
        f"each, and on this host each may be limited by itself. If they share none, set hardware.memory to what they need"
    )


def contended(*, sample: str, cpu_time: float, mean_s: float | None = None) -> str:
    """Warn of a sample that other processes slowed down: the prediction, which others bear on, may be far from its mean."""
    what = f"contended: other processes took {cpu_time:.0%} of its CPU time"
    less = "" if mean_s is None else f", so its mean of {shown_duration(mean_s)} counts for less"
    return (
        f"sample {sample}: {what}{less}: measure it again while the machine is idle: fogspec bench APP --only {sample}"
    )


def cpu_quota(*, sample: str, vcpus: float, periods: float) -> str:
    """Warn of a sample whose processes a quota stopped."""
    return f"sample {sample}: a CPU quota of {shown(vcpus)} vCPUs stopped its processes in {periods:.0%} of periods [FS903]"


def image_unpinned(*, image: str) -> str:
    """Warn of an image that is not pinned."""
    return f"image {image} is not pinned to a digest, so that what is deployed may differ from what is measured: fogspec lock"


def open_port(*, cloud: str, protocol: str, port: int) -> str:
    """Warn that the user must open the link's port."""
    if protocol == "tcp":
        return f"{cloud} opens no ports: let the robot reach TCP port {port} of the machine yourself"
    how = "fogspec apply says the command" if cloud_of(cloud).open_udp else f"in the way of {cloud}"
    return f"open UDP port {port} of the machine yourself, because SkyPilot opens TCP ports only: {how}"


def unpredicted(*, machines: int) -> str:
    """Warn of machines without a prediction."""
    return f"{machines} admissible machines cannot be predicted, or failed when they were measured"


def nothing_sampled(*, infra: str, gpu: str) -> str:
    """Note that no machine is admissible in a place."""
    return f"{infra}, GPU {gpu}: no admissible machine, nothing is sampled"


def one_platform(*, infra: str, gpu: str, families: list[str], kinds: int) -> str:
    """Note that the grid has one kind of CPU."""
    only = f"sizes of one kind of CPU, {', '.join(families)}"
    return f"{infra}, GPU {gpu}: {only}; sampler: adaptive compares all {kinds} kinds"


def level_skipped(*, infra: str, gpu: str, level: str) -> str:
    """Note that the grid has fewer sizes."""
    other = "smallest" if level == "largest" else "smallest or largest"
    return f"{infra}, GPU {gpu}: the {level} vCPU count is also the {other}: its cells are skipped"


def memory_snapped(*, infra: str, gpu: str, vcpus: float, level: str, wanted_gib: float, memory_gib: float) -> str:
    """Note that no machine has the memory of a cell of the grid."""
    cell = f"{infra}, GPU {gpu}: {vcpus:g} vCPUs with {level} memory"
    return f"{cell}: no machine has {wanted_gib:g} GiB, the nearest on offer is {memory_gib:g} GiB"


def sampled_once(*, infra: str, machine: str) -> str:
    """Note a machine that was found more than once."""
    return f"{infra} {machine} is a duplicate: sampled once"


def burstable(*, infra: str, machine: str) -> str:
    """Note a machine whose latency varies."""
    return f"{infra} {machine} is burstable, its latency depends on CPU credits left"


def selects_more(*, at_once: int | None = None, budget_usd: float | None = None) -> str:
    """Note that the model selects the next machines; how, of a plan of the first batch."""
    if at_once is None:
        return "fogspec bench selects the next machines"
    many = "one by one" if at_once == 1 else f"{at_once} at once"
    end = ": there is no budget" if budget_usd is None else f", never beyond the budget of {dollars(budget_usd)}"
    return f"the first batch; then the model selects the next machines, {many}, until none is worth its price{end}"


def batch(*, number: int, samples: int, reason: str) -> str:
    """Note why a batch was selected."""
    return f"batch {number} ({samples}): {reason}"


def sampling_ended(*, reason: str) -> str:
    """Note why no further machine is selected."""
    return f"sampling ended: {reason}"


def left_out(
    *, what: Literal["image", "spot", "login"], cloud: str, image: str = "", secrets: list[str] | None = None
) -> str:
    """Note what of the spec does not exist in a cloud."""
    if what == "login":
        return f"{', '.join(secrets or ())}: not used in {cloud}, where the cluster's imagePullSecrets pull {image}"
    if what == "spot":
        return f"spot is left out in {cloud}, which has none"
    if cloud == LOCAL:
        return f"image {image} is left out on this host: its own ROS 2 is used"
    return f"image {image} is left out in {cloud}: ROS 2 is installed with apt, if it is absent"


def over_limit(*, limit: str, bound: float, value: float | None = None, unit: str | None = None) -> str:
    """Say that a machine violates a limit; without a value it has none that can be modeled."""
    name = "busy time a request, for the rate," if limit == "rate" else limit.removeprefix("metrics.")
    if value is None:
        return f"{name} is not known: no sample has a value of it that can be modeled"
    return "{} {} is over the limit of {}".format(name, *shown_beside(limit, value, bound, unit or ""))


def machine_failed() -> str:
    """Say that a machine failed, or has no more memory than one that ran out of it."""
    return "it failed when it was measured, or has no more memory than a machine that ran out of it"


def unlikely(*, required: float, probability: float | None = None) -> str:
    """Say that a machine meets the limits with too low a probability, or with one that is not known."""
    if probability is None:
        return "with which probability it meets the limits is not known"
    return f"meets the limits with {100 * probability:.3g}% probability, below the required {100 * required:.3g}%"


CODES: Mapping[str, Callable[..., str]] = {
    one.__name__: one
    for one in (
        partial, waived, confirmed, host_only, relaxed_end, no_confidence, not_verified, spread_unknown, error_unknown,
        waits, rate_unknown, few_samples, constant_curve, curve_error, sample_rejected, mixed_servers, gpu_idle, swapped,
        contended, more_memory, cpu_quota, image_unpinned, open_port,
        unpredicted, nothing_sampled, one_platform, level_skipped, memory_snapped,
        sampled_once, burstable, selects_more, batch, sampling_ended, left_out, over_limit, machine_failed,
        unlikely,
    )
}  # fmt: skip


# Those that say that the choice may be another one, or that what runs may be something else than what was measured. Others are
# about models and prices.
DECISIVE = frozenset(
    one.__name__
    for one in (
        partial, waived, confirmed, host_only, relaxed_end, no_confidence, not_verified, error_unknown, waits, rate_unknown,
        sample_rejected, mixed_servers, gpu_idle, swapped, contended, more_memory, cpu_quota, image_unpinned, open_port,
    )
)  # fmt: skip


def is_decisive(one: Mapping[str, Any]) -> bool:
    """Return whether a warning bears on the decision."""
    return one.get("code") in DECISIVE


def _known(one: dict[str, Any]) -> dict[str, Any]:
    """Return a warning of a document; raise UnitError for one that this version does not have."""
    try:
        _sentence(one)
    except ValidationError as wrong:
        first = wrong.errors()[0]
        if first["type"] != "unexpected_keyword_argument":
            where = ".".join(map(str, first["loc"]))
            raise UnitError(f"of code {one['code']}: {where}: {first['msg'].lower()}", code="FS303") from None
        raise UnitError("is not known", code="FS301") from None
    except (ValueError, LookupError):
        raise UnitError("is not known", code="FS301") from None
    return one


Warned = Annotated[
    dict[str, Any],
    AfterValidator(_known),
    WithJsonSchema({"type": "object", "required": ["code"], "properties": {"code": {"enum": list(CODES)}}}),
]


def warned(code: Callable[P, str], *_: P.args, **values: P.kwargs) -> Warned:
    """Return the warning of this code and these values, floats rounded and without those that are None or False."""
    there = {name: _plain(value) for name, value in values.items() if value is not None and value is not False}
    return {"code": code.__name__, **there}


def sentence(one: Mapping[str, Any]) -> str:
    """Return a warning for people, on one line, also one of a file that another version wrote or that was edited."""
    try:
        return line(_sentence(one))
    except (ValueError, LookupError):
        return line(f"{one.get('code')}: {NEWER}")


def as_data(found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return warnings for JSON: code, values and `text`."""
    return [{**one, "text": sentence(one)} for one in found]


def _sentence(one: Mapping[str, Any]) -> str:
    """Raise LookupError for an unknown code, ValidationError for values that are not those of the code."""
    return _checked(str(one.get("code")))(**{str(name): value for name, value in one.items() if name != "code"})


@functools.cache
def _checked(code: str) -> Callable[..., str]:
    return validate_call(config={"allow_inf_nan": False})(CODES[code])


def _plain(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", exclude_none=True)
    return rounded(value) if isinstance(value, float) else value


def _curve(target: str, gpu: str | None) -> str:
    return f"curve of {target}{f' with {gpu}' if gpu else ''}"
