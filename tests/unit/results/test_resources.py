"""What a sample used is said in a line, doubted with a code, and believed only within its ranges."""

import pytest

from fogspec.backends.agent_state import resource_use
from fogspec.catalog.machine import Gpu, Machine
from fogspec.language.warned import sentence
from fogspec.results.resources import doubts, use_line
from fogspec.results.schema import Measured, ResourceUse

SENT = {
    "window": 12.5, "vcpus": 8.0, "cpu_mean": 7.8, "cpu_max": 8.0, "throttled": 0.0, "memory_peak": 1.25,
    "minor_faults": 900, "major_faults": 0, "swapped": 0.0, "received": 0.0, "sent": 0.0, "overhead": 0.0004,
}  # fmt: skip
GPU = {"gpus": 1, "gpu_mean": 0.0, "gpu_max": 0.01, "gpu_memory_peak": 0.5, "gpu_memory": 15.0}


def use(**changed: float) -> ResourceUse:
    found = resource_use({**SENT, **changed})
    assert found is not None
    return found


def record(found: ResourceUse | None, gpu: Gpu | None = None, state: str = "ok") -> Measured:
    machine = Machine.model_construct(
        infra="aws/us-east-1", instance="g4dn.xlarge", cpus=4.0, memory=16.0, gpu=gpu, spot=False, price=0.5
    )
    return Measured.model_construct(id="one", machine=machine, state=state, resources=found)


def test_more_memory_than_the_machine_has_is_said() -> None:
    assert not list(doubts(record(use(memory_peak=16.5))))
    [said] = doubts(record(use(memory_peak=23.9)))
    assert said["code"] == "more_memory"
    assert "its processes had 23.9 GiB of memory, and its machine has 16 GiB" in sentence(said)


@pytest.mark.parametrize(
    ("changed", "line"),
    [
        ({}, "CPU-bound: 7.8 of 8 vCPUs; 1.25 GiB of memory"),
        ({"cpu_mean": 0.99, "cpu_max": 1.01}, "one core busy: 0.99 of 8 vCPUs; 1.25 GiB of memory"),
        ({"cpu_mean": 1.0, "cpu_max": 1.0, "vcpus": 1.0}, "CPU-bound: 1 of 1 vCPU; 1.25 GiB of memory"),
        ({"cpu_mean": 2.5}, "2.5 of 8 vCPUs, at most 8; 1.25 GiB of memory"),
        ({"swapped": 0.5, "throttled": 0.2, "cpu_mean": 2.0},
         "2 of 8 vCPUs, at most 8; throttled in 20% of periods; 1.25 GiB of memory; swapping: 512 MiB"),
        ({"major_faults": 500, "cpu_mean": 2.0},
         "2 of 8 vCPUs, at most 8; 1.25 GiB of memory; 500 page faults that waited for a disk"),
        ({**GPU, "cpu_mean": 2.0},
         "2 of 8 vCPUs, at most 8; 1.25 GiB of memory; GPU idle; 512 MiB of 15 GiB of GPU memory"),
        ({**GPU, "gpu_mean": 0.97, "gpu_max": 1.0, "gpus": 2, "cpu_mean": 2.0},
         "2 of 8 vCPUs, at most 8; 1.25 GiB of memory; GPU-bound: busiest of 2 GPUs 97% busy; "
         "512 MiB of 15 GiB of GPU memory"),
        ({"received": 0.25, "cpu_mean": 2.0}, "2 of 8 vCPUs, at most 8; 1.25 GiB of memory; network 256 MiB in, 0 MiB out"),
    ],
)  # fmt: skip
def test_what_limits_a_sample_is_said_first(changed: dict[str, float], line: str) -> None:
    assert use_line(use(**changed)) == line


@pytest.mark.parametrize(
    ("changed", "gpu", "code"),
    [
        ({}, None, None),
        (GPU, Gpu(name="T4", count=1), "gpu_idle"),
        (GPU, None, None),
        ({**GPU, "gpu_max": 0.5}, Gpu(name="T4", count=1), None),
        ({}, Gpu(name="T4", count=1), None),  # nobody could look at it
        ({"swapped": 0.1}, None, "swapped"),
        ({"swapped": 0.001}, None, None),
        ({"throttled": 0.06, "vcpus": 2.0}, None, "cpu_quota"),
        ({"throttled": 0.9, "vcpus": 4.0}, None, None),  # the whole machine
    ],
)
def test_a_sample_that_measured_something_else_is_a_warning_with_a_code(
    changed: dict[str, float], gpu: Gpu | None, code: str | None
) -> None:
    found = list(doubts(record(use(**changed), gpu)))
    assert [one["code"] for one in found] == ([] if code is None else [code])
    assert list(doubts(record(use(**changed), gpu, "failed"))) == []


def test_results_without_these_figures_have_no_doubts() -> None:
    assert list(doubts(record(None))) == []


@pytest.mark.parametrize(
    "wrong",
    [{"cpu_mean": -1.0}, {"throttled": 2.0}, {"memory_peak": float("inf")}, {"minor_faults": "many"}, {"window": None},
     {"gpus": 0}, {"unknown": 1}, {"major_faults": 10**40}, {"cpu_max": 1e9}],
)  # fmt: skip
def test_a_machine_that_sends_nonsense_has_no_figures(wrong: dict[str, object]) -> None:
    assert resource_use({**SENT, **wrong}) is None


def test_they_are_written_and_read_back() -> None:
    found = use(**GPU)
    assert resource_use(found.model_dump(mode="json")) == found
    assert found.model_dump(mode="json")["memory_peak"] == "1.25GiB"
    assert "resources" in Measured.model_fields
