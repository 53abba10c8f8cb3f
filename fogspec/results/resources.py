"""What samples used of their machines, for people, and samples that measured the wrong thing."""

from collections.abc import Iterator

from fogspec.base import units
from fogspec.language import warned as codes
from fogspec.language.warned import Warned, warned
from fogspec.results.schema import Measured, ResourceUse

BOUND = 0.9  # of the vCPUs, or of a GPU's time, from which it limits the latency
WAITS = 0.5  # vCPUs, below which no thread works most of the time
ONE_CORE = 1.1  # vCPUs that one thread may seem to use
IDLE_GPU = 0.02  # of a GPU's time
THROTTLED = 0.05  # of the periods of a quota
CONTENDED = 0.05  # of its vCPUs, from which what others took is part of a latency
BETWEEN = 0.5  # of the CPU time of open requests, from which that of others is more than keeping a node going
PROBE_S = 0.001  # of CPU time a request, which the probe itself does not reach
SMALLER, LARGER = 0.95, 1.05
SWAPPED_GIB = 2.0**-6
PAGED_PER_S = 10.0  # major page faults, from which disks are part of the latency
NETWORK_GIB = 2.0**-10


def use_line(use: ResourceUse) -> str:
    """Return what a sample used in one line, what limits it first: `CPU-bound: 7.8 of 8 vCPUs; 1.2 GiB of memory`."""
    return "; ".join(_words(use))


def _words(use: ResourceUse) -> Iterator[str]:
    of = f"{units.shown(use.cpu_mean)} of {units.shown(use.vcpus)} vCPU{'' if use.vcpus == 1 else 's'}"
    if use.cpu_mean >= BOUND * use.vcpus:
        yield f"CPU-bound: {of}"
    elif use.cpu_mean >= BOUND and use.cpu_max <= ONE_CORE:
        yield f"one core busy: {of}"
    else:
        waits = "mostly waiting: " if use.cpu_mean < WAITS else ""
        yield f"{waits}{of}, at most {units.shown(use.cpu_max)}"
    if use.throttled is not None and use.throttled >= THROTTLED:
        yield f"throttled in {use.throttled:.0%} of periods"
    yield f"{units.shown_memory(use.memory_peak)} of memory"
    if _swaps(use):
        yield f"swapping: {units.shown_memory(use.swapped or 0.0)}"
    if use.major_faults >= PAGED_PER_S * use.window:
        yield f"{use.major_faults:,} page faults that waited for a disk"
    if use.gpu_max is not None and use.gpu_mean is not None:
        gpu = "GPU" if use.gpus in (None, 1) else f"busiest of {use.gpus} GPUs"
        bound = "GPU-bound: " if use.gpu_mean >= BOUND else ""
        yield f"{gpu} idle" if use.gpu_max < IDLE_GPU else f"{bound}{gpu} {use.gpu_mean:.0%} busy"
    if use.gpu_memory_peak is not None:
        total = "" if use.gpu_memory is None else f" of {units.shown_memory(use.gpu_memory)}"
        yield f"{units.shown_memory(use.gpu_memory_peak)}{total} of GPU memory"
    if (use.received or 0.0) + (use.sent or 0.0) >= NETWORK_GIB:
        yield f"network {units.shown_memory(use.received or 0.0)} in, {units.shown_memory(use.sent or 0.0)} out"


def contended(record: Measured) -> bool:
    """Return whether other processes, or the host, took more than `CONTENDED` of a sample's vCPUs."""
    return record.resources is not None and (record.resources.outside or 0.0) > CONTENDED


def doubts(record: Measured) -> Iterator[Warned]:
    """Yield a warning for each reason why a sample measured something else than its machine at work."""
    use = record.resources
    if use is None or record.state != "ok":
        return
    if record.machine.gpu is not None and use.gpu_max is not None and use.gpu_max < IDLE_GPU:
        yield warned(codes.gpu_idle, sample=record.id, most_busy=use.gpu_max)
    if _swaps(use):
        yield warned(codes.swapped, sample=record.id, swapped_gib=use.swapped or 0.0)
    if contended(record):
        mean_s = None if record.latency is None else record.latency.mean
        yield warned(codes.contended, sample=record.id, cpu_time=use.outside or 0.0, mean_s=mean_s)
    if use.memory_peak > LARGER * record.machine.memory:
        yield warned(codes.more_memory, sample=record.id, used_gib=use.memory_peak, memory_gib=record.machine.memory)
    # A quota of the machine's own size, as a pod has it, is the machine.
    smaller = use.vcpus < SMALLER * record.machine.cpus
    if smaller and use.throttled is not None and use.throttled >= THROTTLED:
        yield warned(codes.cpu_quota, sample=record.id, vcpus=use.vcpus, periods=use.throttled)


def at_work(record: Measured, busy_s: float) -> float:
    """Return for which share of the `busy_s` of each request all of its vCPUs could have worked, at most; 1 if that is unknown.

    What others took of them counts as work, and so does all of a sample that waited for memory.
    """
    use = record.resources
    if use is None or not record.requests or not busy_s or _swaps(use) or use.major_faults >= PAGED_PER_S * use.window:
        return 1.0
    return min(1.0, use.cpu_mean * use.window / record.requests / busy_s / use.vcpus + (use.outside or 0.0))


def between_s(use: ResourceUse | None, open_s: float, requests: int) -> float:
    """Return the CPU seconds a request that were used while none was open, at least; 0 where that is little.

    While one is open, its machine's vCPUs bound what can be used, or what was used in a second where the processes left them.
    """
    if use is None or not requests:
        return 0.0
    most_s = max(use.vcpus, use.cpu_max) * open_s
    beyond_s = use.cpu_mean * use.window - most_s
    return beyond_s / requests if beyond_s > max(BETWEEN * most_s, PROBE_S * requests) else 0.0


def _swaps(use: ResourceUse) -> bool:
    return use.swapped is not None and use.swapped >= SWAPPED_GIB
