"""What every deployer must do, whichever it is: the conformance suite of the Deployer seam."""

import json
import os
import secrets
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

import fogspec.agent
from fogspec.backends.local.deployer import LocalDeployer
from fogspec.backends.protocol import Deployer, DeploymentStatus, Launch, LaunchRefused, Unreachable
from fogspec.backends.skypilot.deployer import SkyPilotDeployer
from fogspec.backends.skypilot.errors import CloudProblem
from fogspec.catalog.machine import Gpu, Machine
from tests.support.fake_sky import Cloud, SimulatedClient

RUN = (
    "agent=${FOGSPEC_AGENT:-$HOME/.fogspec/agent/agent.py}\nout=${FOGSPEC_OUT:-$HOME/.fogspec/deployment}\n"
    'exec python3 "$(dirname "$agent")/keeper.py" --out "$out" %s'
    """ --process '["python3", "work.py"]'\n"""
)
LINE = {"name": "work", "start_s": 1.0, "latency_s": 0.25, "ok": True, "metrics": {}, "reason": None}
WORK = f"""import os, time
while not os.path.exists("crash"):
    with open(os.environ["FOGSPEC_TIMINGS"], "a") as file:
        file.write('{json.dumps(LINE)}' + chr(10))
    time.sleep(0.02)
raise SystemExit("no such model")
"""
PATIENCE_S = 120.0  # it only bounds hangs
AGENT = Path(next(iter(fogspec.agent.__path__)))


@dataclass
class Bed:
    """A deployer, the same as another process would make it anew, and launches it can and cannot have."""

    deployer: Deployer
    anew: Callable[[], Deployer]
    folder: Path
    cloud: Cloud | None = None

    def launch(self, cpus: float = 1, ready: str = "", gpu: Gpu | None = None) -> Launch:
        name = f"fogspec-demo-{secrets.token_hex(4)}-{secrets.token_hex(3)}"
        machine = Machine.model_construct(
            infra="local" if self.cloud is None else "aws/r1", instance=f"{cpus:g}cpu-1gib", cpus=cpus, memory=1.0,
            gpu=gpu, spot=False, price=0.1,
        )  # fmt: skip
        task = {"run": RUN % ready, "workdir": "specs", "file_mounts": {"~/.fogspec/agent": "agent"},
                "resources": {"labels": {"fogspec-application": "demo"}}}  # fmt: skip
        return Launch(name, machine, task, self.folder, self.folder / ".fogspec" / "demo" / "deployed" / name)

    def until(self, launch: Launch, state: str, deployer: Deployer | None = None) -> DeploymentStatus:
        end = time.monotonic() + PATIENCE_S
        while (live := (deployer or self.deployer).look(launch)).state != state:
            assert time.monotonic() < end, live
            time.sleep(0.05)
        return live

    def names(self) -> list[str]:
        return list(self.deployer.names("demo", self.folder / ".fogspec" / "demo"))


@pytest.fixture(params=["local", "skypilot"])
def bed(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bed]:
    (tmp_path / "specs").mkdir()
    (tmp_path / "specs" / "work.py").write_text(WORK)
    (tmp_path / "agent").symlink_to(AGENT)
    if request.param == "local":
        made = Bed(LocalDeployer(), LocalDeployer, tmp_path)
    else:
        cloud = Cloud(tmp_path / "cloud")
        new = lambda: SkyPilotDeployer(SimulatedClient(cloud))  # type: ignore[arg-type]  # noqa: E731
        made = Bed(new(), new, tmp_path, cloud)
    yield made
    for name in made.names():
        made.deployer.end(Launch(name, None, {}, tmp_path, tmp_path))


def test_from_start_to_end(bed: Bed) -> None:
    launch = bed.launch()
    assert bed.deployer.look(launch).state == "gone"
    bed.deployer.start(launch)
    live = bed.until(launch, "ready")
    assert live.address
    assert live.observed
    assert bed.names() == [launch.name]
    bed.deployer.end(launch)
    assert bed.deployer.look(launch).state in ("gone", "ended")
    assert bed.names() == []
    bed.deployer.end(launch)


def test_another_process_sees_and_ends_it(bed: Bed) -> None:
    launch = bed.launch()
    bed.deployer.start(launch)
    bed.until(launch, "ready")
    other = bed.anew()
    bare = Launch(launch.name, None, {}, launch.root, launch.folder)
    assert bed.until(bare, "ready", other).state == "ready"
    other.end(bare)
    assert bed.names() == []


def test_not_ready_before_the_nodes_answer(bed: Bed) -> None:
    launch = bed.launch(ready="""--ready '["test", "-e", "answers"]'""")
    bed.deployer.start(launch)
    bed.until(launch, "starting")
    time.sleep(1.0)
    assert bed.deployer.look(launch).state == "starting"
    where = launch.root / "specs" if bed.cloud is None else bed.cloud.machines[launch.name].folder / "sky_workdir"
    (where / "answers").touch()
    bed.until(launch, "ready")
    bed.deployer.end(launch)


def test_nodes_that_end_are_said(bed: Bed) -> None:
    launch = bed.launch()
    bed.deployer.start(launch)
    bed.until(launch, "ready")
    where = launch.root / "specs" if bed.cloud is None else bed.cloud.machines[launch.name].folder / "sky_workdir"
    (where / "crash").touch()
    live = bed.until(launch, "ended")
    assert live.detail == "python3 ended with exit code 1: no such model"
    bed.deployer.end(launch)
    assert bed.names() == []


def test_a_machine_that_cannot_be_had(bed: Bed) -> None:
    launch = bed.launch(cpus=9999)
    if bed.cloud is not None:
        bed.cloud.launch = lambda **_: {"request": launch.name}  # type: ignore[method-assign]
        bed.cloud.refused[launch.name] = CloudProblem("capacity", "InsufficientInstanceCapacity", again=True)
        bed.deployer.start(launch)
    with pytest.raises(LaunchRefused) as no:
        (bed.deployer.start if bed.cloud is None else bed.deployer.look)(launch)
    assert no.value.reason == "capacity"
    bed.deployer.end(launch)


def test_a_missing_secret(bed: Bed) -> None:
    launch = bed.launch()
    needs = Launch(
        launch.name, launch.machine, {**launch.task, "secrets": {"NOT_THERE": None}}, launch.root, launch.folder
    )
    with pytest.raises(LaunchRefused, match="NOT_THERE"):
        bed.deployer.start(needs)
    bed.deployer.end(needs)


def test_two_of_one_application_at_once(bed: Bed) -> None:
    old, new = bed.launch(), bed.launch()
    for launch in (old, new):
        bed.deployer.start(launch)
        bed.until(launch, "ready")
    assert sorted(bed.names()) == sorted([old.name, new.name])
    bed.deployer.end(old)
    assert bed.names() == [new.name]
    assert bed.deployer.look(new).state == "ready"
    bed.deployer.end(new)


def test_other_applications_are_not_its_own(bed: Bed) -> None:
    launch = bed.launch()
    bed.deployer.start(launch)
    bed.until(launch, "ready")
    assert bed.deployer.names("demo-two", bed.folder / ".fogspec" / "demo-two") == []
    assert bed.deployer.names("dem", bed.folder / ".fogspec" / "dem") == []
    bed.deployer.end(launch)


def test_requests_are_seen(bed: Bed, monkeypatch: pytest.MonkeyPatch) -> None:
    launch = bed.launch()
    bed.deployer.start(launch)
    end = time.monotonic() + PATIENCE_S
    while not (timings := bed.deployer.look(launch).timings):
        assert time.monotonic() < end
        time.sleep(0.2)
    first = json.loads(timings.splitlines()[0])
    assert (first["name"], first["latency_s"], first["ok"]) == ("work", 0.25, True)
    bed.deployer.end(launch)


def test_silence_is_not_an_end(tmp_path: Path) -> None:
    cloud = Cloud(tmp_path / "cloud", fails=lambda _op, _words: Unreachable("the network is down"))
    deployer = SkyPilotDeployer(SimulatedClient(cloud))  # type: ignore[arg-type]
    launch = Launch("fogspec-demo-00000000-000000", None, {}, tmp_path, tmp_path)
    with pytest.raises(Unreachable):
        deployer.look(launch)
    with pytest.raises(Unreachable):
        deployer.end(launch)
    with pytest.raises(Unreachable):
        deployer.names("demo", tmp_path)


def test_a_killed_keeper_leaves_no_one(tmp_path: Path) -> None:
    (tmp_path / "specs").mkdir()
    (tmp_path / "specs" / "work.py").write_text(WORK)
    (tmp_path / "agent").symlink_to(AGENT)
    bed = Bed(LocalDeployer(), LocalDeployer, tmp_path)
    launch = bed.launch()
    bed.deployer.start(launch)
    bed.until(launch, "ready")
    from fogspec.backends.local import processes

    pids = processes.marked("FOGSPEC_DEPLOYMENT", launch.name)
    for pid in pids:
        if b"keeper.py" in Path("/proc", str(pid), "cmdline").read_bytes():
            os.kill(pid, signal.SIGKILL)
    assert processes.marked("FOGSPEC_DEPLOYMENT", launch.name), "the node goes on"
    bed.deployer.end(launch)
    assert processes.marked("FOGSPEC_DEPLOYMENT", launch.name) == []
