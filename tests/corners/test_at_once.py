"""How many machines run at the same time: 8 unless `--at-once` says otherwise, and then really that many."""

from collections.abc import Iterator
from typing import Any, ClassVar

import pytest

from fogspec.backends import registry
from fogspec.backends.skypilot import backend
from fogspec.catalog import sources
from tests.corners.test_no_access import AT, WORK, bench, results, sources_missing
from tests.e2e.test_bench_money import _Shop
from tests.support.fake_sky import Cloud, SimulatedClient
from tests.support.running import CATALOG, Shell, shell, spec  # noqa: F401


class Together(Cloud):
    """A cloud where none but the first machine is up before so many were requested, and that remembers how many there were."""

    wanted = 0
    most = 0
    names: ClassVar[dict[str, None]] = {}

    def launch(self, task: Any, name: str, root: str) -> dict[str, Any]:
        asked = super().launch(task, name, root)
        self.names = {**self.names, name: None}
        self.most = max(self.most, len(self.machines))
        return asked

    def launched(self, request: str, name: str) -> dict[str, Any] | None:
        alone = next(iter(self.names)) == name
        return super().launched(request, name) if alone or self.most >= self.wanted else None


@pytest.fixture
def cloud(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> Iterator[Together]:
    def none(*_: object) -> None:
        raise sources_missing()

    monkeypatch.setattr(sources, "load_catalog", _Shop(none))
    made = Together(shell.folder.parent / "cloud")
    monkeypatch.setattr(backend.SkyPilotSamples, "poll_s", 0.05)
    monkeypatch.setattr(backend, "LAUNCH_POLL_S", 0.05)
    monkeypatch.setattr(registry, "sample_backend", lambda _: lambda: backend.SkyPilotSamples(SimulatedClient(made)))
    yield made
    for name in list(made.machines):
        made.end(name)


def listed(shell: Shell, count: int) -> list[str]:
    """Write a spec that lists so many machines, and return their names."""
    names = [f"m5.{number}xlarge" for number in range(count)]
    shell.write("offers.csv", CATALOG + "".join(f"{one},,,2,4,0.1{at:02},,r1,\n" for at, one in enumerate(names)))
    shell.write("specs/work.py", WORK)
    stop = "warmup: 0, stop: {requests: 5, duration: 1min}, ready_timeout: 10min"
    shell.write("specs/demo.yaml", spec(benchmark=f"{{budget: $50, machines: [{', '.join(names)}], {stop}}}"))
    return names


@pytest.mark.slow
@pytest.mark.parametrize(("words", "wanted"), [((), 8), (("--at-once", "12"), 12), (("--at-once", "3"), 3)])
def test_so_many_machines_run_at_once(shell: Shell, cloud: Together, words: tuple[str, ...], wanted: int) -> None:
    names = listed(shell, wanted + 1)
    shell("compile", "specs/demo.yaml", *AT)
    cloud.wanted = wanted
    said = bench(shell, *words)
    assert cloud.most == wanted, "no machine was up before so many were requested, and there were never more"
    assert f"{wanted} machines at once: at most $" in said.err
    assert [one["state"] for one in results(shell)["samples"]] == ["ok"] * len(names)


@pytest.mark.slow
def test_a_mistake_costs_two_machines_and_not_the_plan(shell: Shell, cloud: Together) -> None:
    """What ends before it begins for one reason is no matter of the machine: the rest is kept, and the command goes on."""
    listed(shell, 6)
    shell.write("specs/work.py", "raise SystemExit('no module named numpy')\n")
    shell("compile", "specs/demo.yaml", *AT)
    said = bench(shell, code=1)
    assert [(one["state"], one["reason"]) for one in results(shell)["samples"]] == [("failed", "crash")] * 2
    assert "no more were started, for they would end alike" in said.out
    assert len(cloud.names) == 2
    bench(shell, code=1)
    assert len(results(shell)["samples"]) == 4
    assert cloud.machines == {}
