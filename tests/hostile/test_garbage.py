"""Files in which nothing is right, or that are no files: each verb says which and what to do, at once, and loses nothing."""

import os
from pathlib import Path

import pytest

from fogspec.backends import registry
from fogspec.base.layout import Layout
from fogspec.catalog.machine import Machine
from fogspec.deploy.schema import DeployedMachine
from fogspec.deploy.state import DeploymentState, SystemWallClock
from tests.support.deployed import Deployed, app, tiny  # noqa: F401
from tests.support.fake_sky import Cloud, beside
from tests.support.running import Shell, chosen, measure, project, shell  # noqa: F401

AT = ("--catalog", "offers.csv")
MANIFEST = "compiled/demo/manifest.yaml"
LIVE = ".fogspec/demo/deployment.yaml"
READ_BY = {
    "specs/demo.yaml": [
        ["validate", "specs/demo.yaml"],
        ["compile", "specs/demo.yaml", *AT],
        ["lock", "specs/demo.yaml", *AT],
    ],
    "offers.csv": [["compile", "specs/demo.yaml", *AT], ["apply", MANIFEST, "--dry-run", "--prices", "offers.csv"]],
    "results/demo/aws-r1-a-small.yaml": [
        ["compile", "specs/demo.yaml", *AT],
        ["bench", "demo", "--runner", "local"],
        ["report", "demo"],
    ],
    "compiled/demo/plan.yaml": [["bench", "demo", "--runner", "local"], ["status"]],
    "compiled/demo/models.yaml": [["check"], ["status"]],
    MANIFEST: [["apply", MANIFEST, "--dry-run"], ["check"]],
    "specs/demo.lock": [["status"], ["compile", "specs/demo.yaml"]],
    LIVE: [["status"], ["diff"]],
}
MADE_AGAIN = ("compiled/demo/plan.yaml", "compiled/demo/models.yaml")
GARBAGE = {
    "empty": b"", "zeros": b"\0" * 999, "binary": bytes(range(256)), "a list": b"[]\n", "deep": b"[" * 9999,
    "another version": b"apiVersion: fogspec.dev/v9\nkind: Other\nmetadata: {name: demo}\n",
}  # fmt: skip


@pytest.fixture
def whole(shell: Shell) -> Shell:
    """A project with every file that a verb may read; what its live state names does not run."""
    project(shell)
    measure(shell)
    shell("lock", *AT)
    shell("compile", "specs/demo.yaml")
    layout = Layout.of(shell.folder / "specs/demo.yaml", "demo")
    machine = Machine.model_construct(infra="local", instance="1cpu-1gib", cpus=1, memory=1.0, spot=False, price=0.02)
    live = DeploymentState(layout, SystemWallClock(), [])
    name = live.owner.deployment_name("sha256:12345678", "abcdef")
    live.put(DeployedMachine.model_construct(
        name=name, deployer="local", state="serving", manifest="sha256:1", machine=machine,
        runs="sha256:2", files={}, fallback=0, image=None, address="127.0.0.1", at=5.0, boot="b",
        since="2026-11-21T00:00:00+00:00",
    ))  # fmt: skip
    return shell


def place(kind: str, path: Path) -> None:
    """Put it where the file was."""
    path.unlink()
    if kind in GARBAGE:
        path.write_bytes(GARBAGE[kind])
    elif kind == "a folder":
        path.mkdir()
    elif kind == "a pipe":
        os.mkfifo(path)
    elif kind == "a device":
        path.symlink_to("/dev/zero")
    else:
        path.symlink_to(path.name)


def remove(path: Path) -> None:
    path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()


@pytest.mark.parametrize("name", READ_BY)
def test_garbage_in_the_place_of_a_file(whole: Shell, name: str) -> None:
    path = whole.folder / name
    content = path.read_bytes()
    for number, kind in enumerate((*GARBAGE, "a folder", "a pipe", "a device", "a loop")):
        words = READ_BY[name][number % len(READ_BY[name])]
        place(kind, path)
        ended = whole(*words, code=None)
        said = f"{words} with {kind} for {name}: {ended}"
        assert ended.code in ((0, 1, 3) if name in MADE_AGAIN else (1, 3)), said
        assert path.name in ended.out + ended.err, said
        if kind in GARBAGE and name not in MADE_AGAIN:
            assert path.read_bytes() == GARBAGE[kind], f"{said}: it may be all that is left"
        remove(path)
        path.write_bytes(content)


def test_down_ends_what_runs_whatever_its_live_state_is(tiny: Deployed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        registry, "deployment_backend", beside(registry.deployment_backend, Cloud(tiny.folder / "cloud"))
    )
    path = tiny.state / "deployment.yaml"
    for number, kind in enumerate(("zeros", "a list", "a pipe"), 1):
        tiny.apply()
        place(kind, path)
        assert tiny.alive()
        said = tiny("down", "tiny")
        assert "1 ended" in said.stdout
        assert "found by their names" in said.stderr
        assert tiny.alive() == [], kind
        assert sorted(tiny.left()) == [
            str(tiny.state / f"deployment.yaml.unreadable-{n}") for n in range(1, number + 1)
        ], kind


def test_nothing_is_written_over_what_is_no_file(whole: Shell) -> None:
    device = whole.folder / "null"
    device.symlink_to("/dev/null")
    said = whole("report", "demo", "--out", "null", code=1).err
    assert said.startswith("error: null: it is a link, which may lead out of the project: not followed\n")
    assert device.is_symlink()


@pytest.mark.parametrize("path", ["plan", "models", "menu", "manifest"])
@pytest.mark.parametrize(
    "verb", ["validate", "compile", "explain", "bench", "check", "status", "lock", "report", "diff"]
)
def test_a_file_of_another_kind_is_one_error_that_says_what_to_name(shell: Shell, path: str, verb: str) -> None:
    chosen(shell)
    ended = shell(verb, f"compiled/demo/{path}.yaml", code=None)
    assert ended.code in (1, 3)
    assert "kind must be Application, not " in ended.err
    assert "give the name of its application in place of the file: demo\n\n1 error in 1 file" in ended.err


def test_a_spec_in_place_of_a_manifest_is_one_error_and_so_is_a_manifest_in_place_of_a_spec(shell: Shell) -> None:
    chosen(shell)
    said = shell("apply", "specs/demo.yaml", "--dry-run", code=1).err
    assert "kind must be DeploymentManifest, not Application" in said
    assert "give the name of its application in place of the file: demo\n\n1 error in 1 file" in said
    for verb in ("down", "logs"):
        assert "fogspec down demo\n" in shell(verb, MANIFEST, code=1).err
