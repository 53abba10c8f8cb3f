"""Shapes of this host: what they are on hosts of several sizes, and that named ones do not depend on the host."""

import pytest

from fogspec.base import host
from fogspec.catalog.sources.host import load, shapes_of
from fogspec.language.schema import local_shape


@pytest.mark.parametrize(
    ("cpus", "memory_gib", "shapes"),
    [
        (1, 0.9, ["local/1cpu-1gib"]),
        (2, 23.4, ["local/1cpu-8gib", "local/2cpu-16gib"]),
        (6, 15.5, ["local/1cpu-2gib", "local/2cpu-4gib", "local/4cpu-8gib", "local/6cpu-8gib"]),
        (16, 8.0, [f"local/{n}cpu-{m}gib" for n, m in ((1, 1), (2, 1), (4, 2), (8, 4), (16, 8))]),
    ],
)
def test_shapes_are_shares_of_the_host(cpus: int, memory_gib: float, shapes: list[str]) -> None:
    assert shapes_of(cpus, memory_gib) == shapes
    for found in map(local_shape, shapes):
        assert found is not None
        assert found[1] <= max(1, memory_gib * found[0] / cpus)


def test_named_shapes_are_the_same_on_every_host_and_cost_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    named, other = load(["local/2cpu-3gib", "c6i.large"]), []
    for capacity in ((2, 8.0), (16, 64.0)):
        monkeypatch.setattr(host, "capacity", lambda capacity=capacity: capacity)
        assert load(["local/2cpu-3gib", "c6i.large"]).about == named.about
        other.append(load([]))
    (machine,) = map(named.machine, range(len(named)))
    assert (machine.infra, machine.instance, machine.cpus, machine.memory) == ("local", "2cpu-3gib", 2, 3)
    assert machine.price == 0
    assert other[0].about.digest != other[1].about.digest
    assert len(other[1]) == 5
