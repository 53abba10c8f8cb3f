"""Parts of a machine stand for smaller types: they inform, with an error of their own, and measure none of them."""

from dataclasses import replace

import numpy as np
import pytest

from fogspec.numerics.acquisition import propose_batch
from fogspec.numerics.nested import P90_ALONE, P90_SHARED, Parts, learnt_factor, nested_error, nested_rows
from fogspec.numerics.observations import observations
from fogspec.numerics.surrogate import fit
from tests.support.machines import family, rule_over, selected
from tests.unit.numerics.test_servers import nine


def test_parts_are_of_one_family_and_shape() -> None:
    machines = nine("aws")  # 2, 8 and 32 vCPUs in each family
    assert nested_rows(machines) == [(), (0,), (1,), (), (3,), (4,), (), (6,), (7,)]
    assert nested_rows(replace(machines, gpu=np.zeros(9, dtype=np.int64))) == [()] * 9
    assert nested_rows(replace(machines, family=np.full(9, -1))) == [()] * 9
    assert nested_rows(replace(machines, burstable=np.ones(9, dtype=bool))) == [()] * 9
    other_memory = replace(machines, memory_gib=machines.memory_gib * np.tile([1.0, 1.5, 1.0], 3))
    assert nested_rows(other_memory) == [()] * 9


def test_two_threads_of_a_core_err_more() -> None:
    machines = nine("aws")
    shared, alone = nested_error(machines), nested_error(replace(machines, physical_cores=machines.vcpus))
    assert shared / alone == pytest.approx(np.full(9, P90_SHARED / P90_ALONE))
    assert nested_error(replace(machines, physical_cores=np.full(9, np.nan))) == pytest.approx(shared)


def test_a_campaign_learns_its_own_error() -> None:
    assert learnt_factor([], []) == 1
    assert learnt_factor([0.1] * 4, [0.1] * 4) == pytest.approx(1)
    assert learnt_factor([0.4, -0.5], [0.1, 0.1]) > 2.5
    assert 0.5 < learnt_factor([0.001] * 6, [0.1] * 6) < 0.7


def test_a_nested_observation_informs_and_does_not_measure() -> None:
    machines = nine("aws")
    before = fit(machines, observations([2], [0.1]))
    after = fit(machines, observations([2, 1], [0.1, 0.3], [np.nan, 0.03], nested=[False, True]))
    assert after.measured.tolist() == [False, False, True, *[False] * 6]
    assert after.nested.tolist() == [False, True, *[False] * 7]
    assert not after.extrapolated[1]
    assert after.sd[1] < before.sd[1] / 2
    assert after.sd[0] < before.sd[0]
    both = fit(machines, observations([2, 1, 1], [0.1, 0.3, 0.31], [np.nan, 0.03, np.nan], nested=[False, True, False]))
    assert both.measured[1]
    assert not both.nested.any()


def test_parts_are_measured_where_they_cost_less_than_what_they_stand_for() -> None:
    machines = family()
    cost = machines.price_usd_per_hour
    free, dear = Parts.of(machines, 1e-6), Parts.of(machines, 10.0)
    biggest = int(np.argmax(machines.vcpus))
    sure, open_ = np.full(len(cost), 1e-9), np.ones(len(cost))
    every = np.ones(len(cost), dtype=bool)
    assert free.worth(biggest, cost, open_, every) == tuple(free.rows[biggest]) != ()
    assert free.worth(biggest, cost, sure, every) == ()
    assert free.worth(biggest, cost, open_, ~every) == ()
    assert dear.worth(biggest, cost, open_, every) == ()


def test_the_first_batch_takes_machines_whose_parts_tell_much() -> None:
    machines = family()
    posterior = fit(machines, observations([], []))
    question = selected(posterior, rule_over(machines)).utility()
    price = np.ones(len(machines))  # of one's own machines: then a large one tells more for the same
    alone = propose_batch(posterior, question, sample_cost=price)
    nested = propose_batch(posterior, question, sample_cost=price, nested=Parts.of(machines, 0.1))
    assert alone.parts == ((),) * len(alone.machines)
    assert any(nested.parts)
    assert machines.vcpus[nested.machines[0]] > machines.vcpus[alone.machines[0]]
