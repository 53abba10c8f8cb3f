"""Applying with a backend that does as it is told: which machine is tried next, which stays, what is said."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import pytest

from fogspec.backends.protocol import DeploymentStatus, Job, LaunchRefused, Unreachable
from fogspec.base.errors import Busy, CloudError, InvalidInput, Refused
from fogspec.base.layout import Layout
from fogspec.catalog.machine import Machine
from fogspec.deploy.apply import Rollout
from fogspec.deploy.candidates import Candidate
from fogspec.deploy.preflight import allowed
from fogspec.deploy.schema import DeployedMachine
from fogspec.deploy.state import DeploymentState
from tests.support.jobs import WORK

FIRST, SECOND = "sha256:" + "1" * 64, "sha256:" + "2" * 64


@dataclass
class Times:
    """A clock that goes on when somebody waits."""

    now: float = 0.0

    def now_s(self) -> float:
        return self.now

    def boot(self) -> str:
        return "boot"

    def date(self) -> datetime:
        return datetime.fromtimestamp(self.now, UTC)

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@dataclass
class FakeBackend:
    """A backend; `says` has what is known of each instance type: a state, or what is raised."""

    says: dict[str, list[object]]
    name: str = "skypilot"
    poll_s: float = 5.0
    up: dict[str, str] = field(default_factory=dict)
    log: list[str] = field(default_factory=list)

    def start(self, job: Job) -> None:
        assert job.machine is not None
        self.up[job.name] = job.machine.instance
        self.log.append(f"start {job.machine.instance}")

    def poll(self, job: Job) -> DeploymentStatus:
        answers = self.says[self.up.get(job.name, "nothing")]
        answer = answers.pop(0) if len(answers) > 1 else answers[0]
        if isinstance(answer, Exception):
            raise answer
        return (
            answer if isinstance(answer, DeploymentStatus) else DeploymentStatus(state=str(answer), address="192.0.2.1")
        )  # type: ignore[arg-type]

    def read_log(self, job: Job) -> bytes:
        return f"printed by {self.up[job.name]}\n".encode()

    def stop(self, job: Job) -> None:
        self.log.append(f"end {self.up.pop(job.name, 'nothing')}")

    def list(self, application: str, directory: Path) -> Sequence[str]:
        return list(self.up)


@dataclass
class World:
    """One application's folder, clock and backend."""

    folder: Path
    backend: FakeBackend
    times: Times = field(default_factory=Times)
    said: list[str] = field(default_factory=list)

    def apply(
        self,
        digest: str,
        *machines: str,
        runs: str = "same",
        linked: Callable[[DeployedMachine, DeploymentStatus], str | None] | None = None,
    ) -> Rollout:
        candidates = [
            Candidate(
                number=n, machine=Machine(infra="aws/r1", instance=name, cpus=2, memory=4.0, price=0.1), work=WORK, task={},
                runs=f"{runs} {name}", approved_usd_per_hour=0.1,
            )
            for n, name in enumerate(machines)
        ]  # fmt: skip
        live = DeploymentState.read(Layout.of(self.folder / "specs" / "demo.yaml", "demo"), self.times)
        work = Rollout(
            live=live, manifest=b"the manifest", digest=digest, candidates=candidates, image=None, files={},
            ready_timeout_s=600.0, backend_of=lambda _infra: self.backend, report=self.said.append,
        )  # fmt: skip
        if linked is not None:
            work.link_check = linked
        return work


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(tmp_path, FakeBackend({"a": ["starting", "ready"], "b": ["ready"], "nothing": ["gone"]}))


def test_the_first_machine_that_answers(world: World) -> None:
    served = world.apply(FIRST, "a", "b").run()
    assert (served.machine.instance, served.fallback, served.address) == ("a", 0, "192.0.2.1")
    assert world.backend.log == ["start a"]
    again = world.apply(FIRST, "a", "b")
    assert again.current() == served


@dataclass
class RacedBackend(FakeBackend):
    """A backend on which another clone starts a machine as well, and whose lists fail at times."""

    other: str = ""
    lists: int = 0

    def poll(self, job: Job) -> DeploymentStatus:
        self.up[self.other] = "b"
        return super().poll(job)

    def list(self, application: str, directory: Path) -> Sequence[str]:
        self.lists += 1
        if self.lists % 2:
            raise Unreachable("no route to host")
        return super().list(application, directory)


def test_a_machine_that_another_clone_started_meanwhile_leaves_one_of_them_at_most(world: World) -> None:
    world.apply(FIRST, "a").run()
    rollout = world.apply(SECOND, "b")
    (served,) = rollout.live.machines
    other = rollout.live.owner.deployment_name(SECOND, "abcdef")
    raced = world.backend = RacedBackend(world.backend.says, other=other, up=world.backend.up)
    with pytest.raises(Busy, match="at the same time") as no:
        rollout.run()
    assert other in no.value.hints
    assert set(raced.up) == {served.name, other}, "what served still does, and the other's is not touched"
    assert [one.name for one in rollout.live.machines] == [served.name]


@pytest.mark.parametrize("reason", ["capacity", "quota"])
def test_want_of_capacity_known_late_goes_on_to_the_next(world: World, reason: str) -> None:
    world.backend.says["a"] = ["starting", LaunchRefused(reason, "sold out")]  # type: ignore[arg-type]
    served = world.apply(FIRST, "a", "b").run()
    assert (served.machine.instance, served.fallback) == ("b", 1)
    assert world.backend.log == ["start a", "end a", "start b"]
    assert any("a in aws/r1 is unavailable: sold out; trying the next" in line for line in world.said)


def test_what_another_machine_would_not_mend(world: World) -> None:
    world.backend.says["a"] = [LaunchRefused("image", "manifest unknown")]
    with pytest.raises(CloudError, match="manifest unknown"):
        world.apply(FIRST, "a", "b").run()
    world.backend.says["a"] = [LaunchRefused("budget", "it costs $0.2 per hour now")]
    with pytest.raises(Refused, match="it costs"):
        world.apply(FIRST, "a", "b").run()
    assert world.backend.up == {}


def test_nothing_can_be_had(world: World) -> None:
    for name in "ab":
        world.backend.says[name] = [LaunchRefused("capacity", "sold out")]
    with pytest.raises(CloudError) as failed:
        world.apply(FIRST, "a", "b").run()
    assert "none of 2 machines" in failed.value.hints[0]
    assert world.backend.up == {}


def test_the_old_machine_ends_after_the_new_one_answers(world: World) -> None:
    world.apply(FIRST, "b").run()
    world.apply(SECOND, "a").run()
    assert world.backend.log == ["start b", "start a", "end b"]


def test_the_same_machine_takes_the_new_manifest(world: World) -> None:
    first = world.apply(FIRST, "b").run()
    kept = world.apply(SECOND, "b").adopt()
    assert kept is not None
    assert (kept.name, kept.manifest) == (first.name, SECOND)
    assert world.apply(SECOND, "b", runs="other").adopt() is None


def test_nodes_that_end_while_they_start(world: World) -> None:
    world.backend.says["a"] = ["starting", DeploymentStatus(state="ended", detail="planner ended with exit code 1")]
    with pytest.raises(InvalidInput, match="planner ended with exit code 1"):
        world.apply(FIRST, "a").run()
    assert world.backend.up == {}


def test_a_machine_that_is_taken_away(world: World) -> None:
    world.backend.says["a"] = ["starting", DeploymentStatus(state="gone", detail="spot capacity was reclaimed")]
    with pytest.raises(CloudError, match="spot capacity was reclaimed"):
        world.apply(FIRST, "a").run()
    assert world.backend.up == {}


def test_patience_has_an_end(world: World) -> None:
    world.backend.says["a"] = [DeploymentStatus(state="starting", detail="the job is setting_up")]
    with pytest.raises(CloudError, match=r"did not answer within 600 s: the job is setting_up"):
        world.apply(FIRST, "a").run()
    assert world.times.now == pytest.approx(605)
    assert world.backend.up == {}


def test_silence_while_waiting_is_waited_out(world: World) -> None:
    world.backend.says["a"] = [Unreachable("timeout"), Unreachable("timeout"), "ready"]
    assert world.apply(FIRST, "a").run().state == "serving"
    assert world.backend.log == ["start a"]


def test_silence_starts_nothing_new(world: World) -> None:
    world.apply(FIRST, "b").run()
    world.backend.says["b"] = [Unreachable("timeout")]
    with pytest.raises(CloudError, match="status unknown, no contact with the machine"):
        world.apply(FIRST, "b").current()
    with pytest.raises(CloudError, match="status unknown, no contact with the machine"):
        world.apply(SECOND, "b").adopt()
    assert world.backend.log == ["start b"]


def test_ready_means_that_the_link_answers_too(world: World) -> None:
    answers = iter(["the tunnel is not up yet", "the tunnel is not up yet", None])
    world.apply(FIRST, "b", linked=lambda _machine, _live: next(answers)).run()
    assert world.times.now == pytest.approx(10)
    assert sum("the tunnel is not up yet" in line for line in world.said) == 1, "said once"


def test_a_killed_apply_is_seen_through(world: World) -> None:
    class Killed(BaseException):
        pass

    world.backend.says["a"] = ["starting", Killed(), "starting", "ready"]  # type: ignore[list-item]
    world.backend.poll = lambda launch: (_ for _ in ()).throw(Killed())  # type: ignore[method-assign]
    with pytest.raises(Killed):
        world.apply(FIRST, "a").run()
    del world.backend.poll
    world.backend.says["a"] = ["starting", "starting", "ready"]
    world.apply(FIRST, "a").run()
    assert world.backend.log == ["start a"], "it was not started twice"


def test_what_the_caller_allows_is_what_the_engine_checks() -> None:
    task = {"resources": {"max_hourly_cost": 0.1}, "run": "x"}
    assert allowed(task, None) == task
    assert allowed(task, 0.2)["resources"] == {"max_hourly_cost": 0.2}
    assert allowed({"resources": {}}, 0.2) == {"resources": {}}
