"""Second samples of a machine: how they are named, replayed, and what they are expected to tell."""

import numpy as np
import pytest

from fogspec.backends.naming import Owner
from fogspec.backends.protocol import Job, LaunchRefused
from fogspec.catalog.machine import Machine
from fogspec.numerics.observations import observations
from fogspec.numerics.replicates import after_one_more
from fogspec.numerics.surrogate import fit
from fogspec.plan.schema import next_on, replicate, sample_on
from fogspec.results.schema import LatencySummary, Measured
from fogspec_lab.recordings import Recording
from fogspec_lab.replay import ReplaySamples
from tests.support.machines import amdahl, family

MACHINE = Machine(infra="aws/us-east-1", instance="c6i.large", cpus=2, memory=4, price=0.085)


def moves(times: list[float]) -> float:
    """Standard deviation of what one more sample of a machine makes of its log-latency."""
    machines = family()
    others = [0, 3, 6, 10]
    found = after_one_more(fit(machines, observations(
        [*others, *(17 for _ in times)], [*amdahl(machines, 0.1)[others], *(amdahl(machines, 0.1)[17] * f for f in times)]
    )))  # fmt: skip
    column = found.at.tolist().index(17)
    assert found.probability[:, column].sum() == pytest.approx(1)
    weight, value = found.probability[:, column], found.log_latency[:, column]
    return float(np.sqrt(weight @ (value - weight @ value) ** 2))


def test_repeats_that_agree_leave_less_to_learn_than_one_sample_and_contradictions_more():
    assert moves([1.0, 1.001]) < moves([1.0])
    assert moves([1.0, 1.001, 0.999]) < moves([1.0, 1.001])
    assert moves([0.8, 1.2]) > moves([1.0, 1.001])


def test_each_sample_of_a_machine_has_an_id_of_its_own():
    taken: dict[str, Machine] = {}
    for nth in (1, 2, 3):
        sample = next_on(MACHINE, "why", taken)
        assert replicate(sample.id) == nth
        assert sample == sample_on(MACHINE, "why", nth)
        taken[sample.id] = MACHINE
    assert list(taken) == [
        "aws-us-east-1-c6i-large",
        "aws-us-east-1-c6i-large-repeat-2",
        "aws-us-east-1-c6i-large-repeat-3",
    ]


def replay_job(folder, nth: int) -> Job:
    owner = Owner("a repository", "default", "a")
    directory = folder / str(nth)
    name = f"{owner.prefix}{nth}"
    return Job(name=name, owner=owner, root=folder, directory=directory, machine=MACHINE, replicate=nth)


def test_a_replay_has_as_many_samples_as_were_recorded(tmp_path):
    base = {"machine": MACHINE, "measured_on": "x", "state": "ok", "requests": 9, "duration": 60.0, "spent": 0.1}
    records = [Measured(id=f"s{n}", latency=LatencySummary(mean=1.0 + n), **base) for n in range(2)]
    backend = ReplaySamples([Recording(one, priced=True) for one in records], "a file", lambda: 0.0)
    played = []
    for nth in (1, 2):
        job = replay_job(tmp_path, nth)
        backend.start(job)
        played.append(backend.poll(job).recorded.latency.mean)
    assert played == [1.0, 2.0]
    with pytest.raises(LaunchRefused, match="no further recording"):
        backend.start(replay_job(tmp_path, 3))
