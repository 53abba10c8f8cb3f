"""Whatever kills an apply, between any two of its steps: apply goes on, down leaves nothing."""

import random

import pytest

from fogspec.backends import registry
from tests.faults import deployments as faulty
from tests.support.deployed import MANIFEST, Deployed, app, tiny  # noqa: F401
from tests.support.fake_sky import Cloud, beside

# Killed before a step is killed after the one before it: write (begun, half done), keep (the same), start, look, write.
STEPS = range(1, 10)


def test_apply_killed_at_each_step(tiny: Deployed) -> None:
    """Killed once at each step, then applied again: one machine, and after `down` nothing."""
    kills = 0
    for at in STEPS:
        kills += faulty.run(tiny, "apply", MANIFEST, "--yes", fault=faulty.killed(at, before=True)) == -9
        if at % 2:
            assert faulty.run(tiny, "apply", MANIFEST, "--yes") == 0
            assert [machine["state"] for machine in tiny.machines()] == ["serving"]
        assert faulty.run(tiny, "down", "tiny") == 0
        assert faulty.left(tiny).nothing, at
    assert kills >= 7


def test_down_killed_at_each_step(tiny: Deployed) -> None:
    """Write (begun, half done), end, write again, clear."""
    kills = 0
    for at in range(1, 8):
        assert faulty.run(tiny, "apply", MANIFEST, "--yes") == 0
        kills += faulty.run(tiny, "down", "tiny", fault=faulty.killed(at, before=True)) == -9
        assert faulty.run(tiny, "down", "tiny") == 0
        assert faulty.left(tiny).nothing, at
    assert kills >= 6


def test_a_full_disk_starts_nothing_or_leaves_nothing(tiny: Deployed) -> None:
    for after in range(1, 5):
        code = faulty.run(tiny, "apply", MANIFEST, "--yes", fault=faulty.full(after))
        assert code in (0, 1)
        if after == 1:
            assert tiny.alive() == [], "what cannot be journaled is not started"
        assert faulty.run(tiny, "down", "tiny") == 0
        assert faulty.left(tiny).nothing


def test_down_ends_machines_though_the_disk_is_full(tiny: Deployed) -> None:
    assert faulty.run(tiny, "apply", MANIFEST, "--yes") == 0
    assert faulty.run(tiny, "down", "tiny", fault=faulty.full(1)) == 1
    assert tiny.alive() == [], "what cannot be written down must not cost money"
    assert faulty.run(tiny, "down", "tiny") == 0
    assert faulty.left(tiny).nothing


def test_the_clock_jumps(tiny: Deployed) -> None:
    for days in (-400, 400):
        assert faulty.run(tiny, "apply", MANIFEST, "--yes", fault=faulty.jumped(days)) == 0
        assert 0 <= tiny.status()["spent_usd"] < 0.01
        assert faulty.run(tiny, "down", "tiny", fault=faulty.jumped(days)) == 0
        assert faulty.left(tiny).nothing


def test_a_network_that_is_cut_starts_nothing_twice(tiny: Deployed) -> None:
    assert faulty.run(tiny, "apply", MANIFEST, "--yes", fault=faulty.cut(polls=5, stops=0)) == 0
    (name,) = tiny.names()
    assert faulty.run(tiny, "apply", MANIFEST, "--yes", fault=faulty.cut(polls=99, stops=0)) == 6
    assert tiny.names() == [name], "another machine beside one that may be fine would cost twice"
    assert faulty.run(tiny, "down", "tiny", fault=faulty.cut(polls=0, stops=99)) == 6
    assert [machine["state"] for machine in tiny.machines()] == ["ending"]
    assert faulty.run(tiny, "down", "tiny") == 0
    assert faulty.left(tiny).nothing


def test_nodes_without_their_supervisor_are_ended_too(tiny: Deployed) -> None:
    assert faulty.run(tiny, "apply", MANIFEST, "--yes") == 0
    faulty.orphaned(tiny)
    assert faulty.run(tiny, "down", "tiny") == 0
    assert faulty.left(tiny).nothing


def test_a_damaged_live_state_hides_nothing(tiny: Deployed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        registry, "deployment_backend", beside(registry.deployment_backend, Cloud(tiny.folder / "cloud"))
    )
    assert faulty.run(tiny, "apply", MANIFEST, "--yes") == 0
    (name,) = tiny.names()
    (tiny.state / "deployment.yaml").write_text("machines: [")
    assert "machines are found by their names" in tiny("down", "tiny").stderr
    kept = tiny.state / "deployment.yaml.unreadable-1"
    assert kept.read_text() == "machines: [", "no record is deleted that could not be read"
    kept.unlink()
    assert f" down ended {name}, found by its name" in tiny("status", "-v").stdout
    assert faulty.left(tiny).nothing


def test_whatever_a_user_does_next(tiny: Deployed) -> None:
    chance = random.Random(1)
    for _, (_, fault) in zip(range(5), faulty.faults(chance), strict=False):
        faulty.life(tiny, chance, fault)
        assert faulty.left(tiny).nothing
