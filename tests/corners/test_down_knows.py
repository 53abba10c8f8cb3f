"""`down` says that nothing runs only if it has asked every engine that a record names, or may name."""

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fogspec.backends import registry
from fogspec.base.errors import CloudError
from fogspec.base.layout import Layout
from fogspec.deploy.engines import engines_of
from tests.support.deployed import Deployed, app  # noqa: F401
from tests.support.deployed_cloud import MANIFEST, cloud  # noqa: F401
from tests.support.fake_sky import Cloud
from tests.support.running import Shell, shell  # noqa: F401
from tests.support.scenes import HALTING, Scene

MARKERS = "<<<<<<< HEAD\n"
COMPILED = ("compiled/demo/plan.yaml", "compiled/demo/manifest.yaml")
Damage = Callable[[Path], None]


def conflicts(folder: Path) -> None:
    """Both files that name clouds, and the spec, in the middle of a merge; no live state, as in a fresh clone."""
    for name in (*COMPILED, "specs/demo.yaml"):
        path = folder / name
        path.write_text(f"{MARKERS}{path.read_text()}=======\n>>>>>>> theirs\n")
    forget(folder)


def forget(folder: Path) -> None:
    subprocess.run(["rm", "-r", str(folder / ".fogspec")], check=True)


def without_compiled(folder: Path) -> None:
    subprocess.run(["rm", "-r", str(folder / "compiled")], check=True)
    forget(folder)


def only_committed(folder: Path) -> None:
    """Nothing is checked out any more: the last commit alone names the cloud."""
    who = ["-c", "user.name=a", "-c", "user.email=a@b"]
    for words in (["init", "-q"], ["add", "specs", "compiled"], [*who, "commit", "-qm", "a"]):
        subprocess.run(["git", *words], cwd=folder, check=True)
    without_compiled(folder)
    (folder / "specs/demo.yaml").unlink()


def damaged(folder: Path) -> None:
    """The live state is cut short, and nothing else names a cloud."""
    (folder / ".fogspec/demo/deployment.yaml").write_text("machines: [")
    for name in (*COMPILED, "specs/demo.yaml"):
        (folder / name).unlink()


@pytest.mark.parametrize("damage", [conflicts, without_compiled, only_committed, damaged])
def test_what_cannot_be_read_hides_no_machine(shell: Shell, cloud: Cloud, damage: Damage) -> None:
    shell("apply", MANIFEST, "--yes")
    damage(shell.folder)
    assert "1 ended" in shell("down", "demo").out
    assert cloud.machines == {}
    kept = shell.folder / ".fogspec/demo/deployment.yaml.unreadable-1"
    assert kept.exists() == (damage is damaged), "a record that could not be read is kept"


@pytest.mark.parametrize("damage", [conflicts, damaged])
def test_without_skypilot_nothing_is_said_to_be_gone(
    shell: Shell, cloud: Cloud, damage: Damage, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    shell("apply", MANIFEST, "--yes")
    damage(shell.folder)
    before = {path: path.read_bytes() for path in (shell.folder / ".fogspec").rglob("*.yaml")}

    def absent(infra: str) -> object:
        if infra != "local":
            raise CloudError("SkyPilot is not installed here", "pip install 'fogspec[sky]'")
        return host(infra)

    host = registry.deployment_backend
    monkeypatch.setattr(registry, "deployment_backend", absent)
    said = shell("down", "demo", code=6)
    assert "SkyPilot is not installed here" in said.err
    assert "cannot be read" in said.err
    assert "nothing runs" not in said.out
    assert len(cloud.machines) == 1
    assert {path: path.read_bytes() for path in before} == before


def until(done: Callable[[], object]) -> None:
    end = time.monotonic() + 1200
    while not done():
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.fixture(autouse=True)
def terminal() -> Iterator[None]:
    """As in a terminal: under nohup, and in some CI, HUP is ignored from the start, which children inherit."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


def hang_up(process: "subprocess.Popen[str]") -> int:
    """Close its terminal: nobody reads any more, and HUP arrives."""
    for pipe in (process.stdout, process.stderr):
        assert pipe is not None
        pipe.close()
    process.send_signal(signal.SIGHUP)
    return process.wait(600)


def test_a_closed_terminal_ends_a_bench_and_its_machines(tmp_path: Path) -> None:
    scene = Scene.made(tmp_path / "scene", HALTING)
    bench = scene.begin()
    until(lambda: scene.requests() >= 3)
    assert hang_up(bench) != 0
    assert scene.alive() == []
    ends = [event for event in scene.events() if event["do"] == "end"]
    assert len(ends) == 1, "it was verified gone, and is in the journal"


def test_a_closed_terminal_ends_what_apply_starts(
    app: Callable[..., Deployed], monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny = app()
    tiny.change("objective: {alpha: 0.5}", 'objective: {alpha: 0.5}\n  deployment: {ready: ["test", "-e", "never"]}')
    tiny("compile", "specs/tiny.yaml")
    applying = tiny.begin("apply", "compiled/tiny/manifest.yaml", "--yes")
    until(tiny.alive)
    hang_up(applying)
    assert tiny.alive() == []
    assert tiny.names() == []


def test_records_of_a_local_deployment_name_this_host_only(app: Callable[..., Deployed]) -> None:
    tiny = app()
    tiny.apply()
    named = engines_of(Layout.of(tiny.folder / "specs" / "tiny.yaml", "tiny"))
    assert (named.infra, named.doubts) == (["local"], ())


def test_down_goes_on_when_its_terminal_is_closed(app: Callable[..., Deployed]) -> None:
    tiny = app()
    tiny.apply()
    read, write = os.pipe()
    os.close(read)
    down = subprocess.Popen(
        tiny.command("down", "tiny"), cwd=tiny.folder, stdout=write, stderr=write, start_new_session=True
    )
    os.close(write)
    until(lambda: not tiny.alive())
    down.send_signal(signal.SIGHUP)
    down.wait(600)
    assert (tiny.alive(), tiny.names()) == ([], [])
