"""Instance types: one for all places and price kinds of a machine."""

from dataclasses import replace

import numpy as np
import pytest

from fogspec.catalog.instance_types import instance_types, types_with_measured
from fogspec.catalog.machine import Machine
from fogspec.catalog.table import concatenated
from tests.bench_choice import offers


def test_places_of_one_type_are_one_type_and_the_cheapest_stands_for_it():
    few = offers(20)
    twice = few.take(np.repeat(np.arange(20), 2))
    twice.price_usd_per_hour[1::2] *= 0.5
    twice.region[1::2] = "elsewhere"
    types = instance_types(twice)
    assert len(types) == len(set(few.instance))
    for row, one in enumerate(types.of):
        assert types.keys[one][1] == twice.instance[row]
        assert twice.price_usd_per_hour[types.offer[one]] <= twice.price_usd_per_hour[row]


def test_the_order_of_offers_does_not_matter():
    few = offers(40)
    order = np.random.default_rng(1).permutation(40)
    one, other = instance_types(few), instance_types(few.take(order))
    assert one.keys == other.keys
    assert np.array_equal(one.of[order], other.of)


def test_a_measured_machine_that_is_not_offered_is_described_by_the_catalog():
    catalog = offers(30)
    some = catalog.take(np.arange(5, 30))
    gone = Machine(infra="aws/r0", instance=str(catalog.instance[0]), cpus=2.0, memory=4.0, price=0.1)
    strange = Machine(infra="aws/r0", instance="never-heard.of", cpus=7.0, memory=9.0, price=0.1)
    types = types_with_measured(some, [gone, strange], catalog)
    known, unknown = types.keys.index(gone.type_key), types.keys.index(strange.type_key)
    assert types.machines.vcpus[known] == catalog.vcpus[0]
    assert (types.machines.vcpus[unknown], types.machines.memory_gib[unknown], types.machines.arch[unknown]) == (
        7,
        9,
        -1,
    )
    assert {int(types.offer[known]), int(types.offer[unknown])} == {25, 26}


def test_types_of_measured_machines_lie_among_those_of_the_offers():
    """As if the machines were offers, so that numbers do not depend on what was measured."""
    catalog = offers(60)
    gone = [catalog.machine(row) for row in (7, 31, 52)]
    offered = catalog.take(~np.isin(catalog.instance, [one.instance for one in gone]))
    types, whole = types_with_measured(offered, gone, catalog), instance_types(catalog)
    assert types.keys == whole.keys
    assert np.array_equal(types.machines.cpu_model, whole.machines.cpu_model)
    assert np.array_equal(types.machines.vcpus, whole.machines.vcpus)
    names = [types.keys[one][1] for one in types.of.tolist()]
    assert names == [*offered.instance, *(one.instance for one in gone)]
    assert types.of[types.offer].tolist() == list(range(len(types)))
    same = types_with_measured(catalog, gone)
    assert same.keys == whole.keys
    assert np.array_equal(same.of, whole.of)


def test_a_type_has_a_row_and_what_is_none_of_the_types_has_not():
    types = instance_types(offers(40))
    assert [types.row(key) for key in types.keys] == list(range(len(types)))
    for strange in (("", "", "", 0.0), ("aws", "f1.none", "", 0.0), ("zzz", "", "", 0.0)):
        with pytest.raises(KeyError):
            types.row(strange)


def test_without_clock_rates_the_family_tells_the_cpu():
    """SkyPilot's lists have none: machines of one family share a CPU, whose speed the models then learn."""
    family = np.array(["c5", "m5"] * 20, dtype=np.object_)
    catalog = replace(offers(40), family=family)
    known, unknown = instance_types(catalog), instance_types(replace(catalog, clock_ghz=np.full(40, np.nan)))
    cpu, of_family = unknown.machines.cpu_model, unknown.machines.family
    assert len(set(zip(cpu.tolist(), of_family.tolist(), strict=True))) == len(set(cpu.tolist())) == 2
    assert (cpu >= 0).all()
    assert not set(cpu.tolist()) & set(known.machines.cpu_model.tolist())
    # Where others of the cloud have one, a machine without is of no kind.
    some = instance_types(replace(catalog, clock_ghz=np.array([3.0, *[np.nan] * 39])))
    assert set(some.machines.cpu_model.tolist()) == {some.machines.cpu_model.max(), -1}


def test_catalogs_are_concatenated():
    catalog = offers(30)
    some = catalog.take(np.arange(5, 30))
    assert len(concatenated([some], some.about)) == 25


def test_of_equal_prices_on_demand_comes_first_then_the_first_offer(monkeypatch):
    few = offers(12)
    places = few.take(np.repeat(np.arange(12), 4))
    places.price_usd_per_hour[:] = np.repeat(few.price_usd_per_hour, 4)
    places.spot[:] = np.tile([True, False, False, True], 12)
    found = instance_types(places)
    assert sorted(found.offer.tolist()) == list(range(1, 48, 4))
    monkeypatch.setattr("fogspec.catalog.table.COUNTED", 0)
    many = instance_types(places)
    assert many.keys == found.keys
    assert np.array_equal(many.of, found.of)
    assert np.array_equal(many.offer, found.offer)
    assert len(instance_types(places.take(np.empty(0, dtype=np.intp)))) == 0
