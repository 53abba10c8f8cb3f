"""What samples used of their machines, for people, and samples that measured the wrong thing."""

from collections.abc import Iterable, Iterator, Sequence

from fogspec.base import units
from fogspec.results.schema import Measured, ResourceUse

BOUND = 0.9  # of the vCPUs, or of a GPU's time, from which it limits the latency
ONE_CORE = 1.1  # vCPUs that one thread may seem to use
IDLE_GPU = 0.02  # of a GPU's time
THROTTLED = 0.05  # of the periods of a quota
SMALLER = 0.95
SWAPPED_GIB = 2.0**-6
PAGED_PER_S = 10.0  # major page faults, from which disks are part of the latency
NETWORK_GIB = 2.0**-10
# Codes of what is doubted.
GPU_IDLE, SWAPS, QUOTA = "FS901", "FS902", "FS903"


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
        yield f"{of}, at most {units.shown(use.cpu_max)}"
    if use.throttled is not None and use.throttled >= THROTTLED:
        yield f"throttled in {use.throttled:.0%} of periods"
    yield f"{_memory(use.memory_peak)} of memory"
    if _swaps(use):
        yield f"swapping: {_memory(use.swapped or 0.0)}"
    if use.major_faults >= PAGED_PER_S * use.window:
        yield f"{use.major_faults:,} page faults that waited for a disk"
    if use.gpu_max is not None and use.gpu_mean is not None:
        gpu = "GPU" if use.gpus in (None, 1) else f"busiest of {use.gpus} GPUs"
        bound = "GPU-bound: " if use.gpu_mean >= BOUND else ""
        yield f"{gpu} idle" if use.gpu_max < IDLE_GPU else f"{bound}{gpu} {use.gpu_mean:.0%} busy"
    if use.gpu_memory_peak is not None:
        total = "" if use.gpu_memory is None else f" of {_memory(use.gpu_memory)}"
        yield f"{_memory(use.gpu_memory_peak)}{total} of GPU memory"
    if (use.received or 0.0) + (use.sent or 0.0) >= NETWORK_GIB:
        yield f"network {_memory(use.received or 0.0)} in, {_memory(use.sent or 0.0)} out"


def doubts(records: Iterable[Measured]) -> list[str]:
    """Return a warning with its code for each sample that measured something else than its machine at work."""
    return [f"sample {one.id}: {text}" for one in records if one.state == "ok" for text in doubts_of(one)]


def doubts_of(record: Measured) -> Sequence[str]:
    """Return why a sample measured something else than its machine at work, each with a code to explain."""
    use = record.resources
    if use is None:
        return ()
    found = []
    if record.machine.gpu is not None and use.gpu_max is not None and use.gpu_max < IDLE_GPU:
        found.append(f"its GPU was idle, {use.gpu_max:.0%} busy at most: a machine without one may do [{GPU_IDLE}]")
    if _swaps(use):
        swapped = _memory(use.swapped or 0.0)
        found.append(f"its machine swapped {swapped} while requests were measured: it needs more memory [{SWAPS}]")
    # A quota of the machine's own size, as a pod has it, is the machine.
    smaller = use.vcpus < SMALLER * record.machine.cpus
    if smaller and use.throttled is not None and use.throttled >= THROTTLED:
        share = f"in {use.throttled:.0%} of periods"
        found.append(f"a CPU quota of {units.shown(use.vcpus)} vCPUs stopped its processes {share} [{QUOTA}]")
    return found


def _swaps(use: ResourceUse) -> bool:
    return use.swapped is not None and use.swapped >= SWAPPED_GIB


def _memory(gib: float) -> str:
    return f"{units.shown(gib)} GiB" if gib >= 1 else f"{units.shown(gib * 1024)} MiB"
