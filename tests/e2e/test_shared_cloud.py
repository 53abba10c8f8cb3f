"""Machines of a cloud, deployed from workspaces that come and go: shared state, adoption, and a repository that moved."""

import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fogspec.backends import registry
from fogspec.backends.naming import FALLBACK_LABEL, MANIFEST_LABEL, OWNER_LABEL, RUNS_LABEL
from fogspec.backends.skypilot.backend import SkyPilotDeployments
from fogspec.deploy import shared_state
from tests.e2e.test_deployment_skypilot import AT, MANIFEST, WORK
from tests.support.fake_sky import Cloud, SimulatedClient
from tests.support.running import Shell, measure, project, shell  # noqa: F401

PROJECT = "apiVersion: fogspec.dev/v1alpha1\nkind: Project\nspec: {state: git}\n"
Workspace = Callable[[], Shell]


def git(*words: str, folder: Path) -> None:
    who = ("-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false")
    subprocess.run(["git", *who, *words], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def cloud(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cloud]:
    monkeypatch.delenv("FOGSPEC_STATE", raising=False)
    monkeypatch.setattr(shared_state, "KEPT_S", -1.0)
    project(shell)
    shell.write("specs/work.py", WORK)
    measure(shell)
    shell("compile", "specs/demo.yaml", *AT)
    shell.write("fogspec.yaml", PROJECT)
    shell.write(".gitignore", ".fogspec/\n")
    remote = shell.folder.parent / "remote.git"
    git("init", "-q", "--bare", str(remote), folder=shell.folder)
    for words in (["init", "-q"], ["add", "."], ["commit", "-qm", "all"], ["remote", "add", "origin", str(remote)],
                  ["push", "-q", "origin", "HEAD:master"]):  # fmt: skip
        git(*words, folder=shell.folder)
    git("symbolic-ref", "HEAD", "refs/heads/master", folder=remote)
    made = Cloud(shell.folder.parent / "cloud")
    monkeypatch.setattr(SkyPilotDeployments, "poll_s", 0.05)
    monkeypatch.setattr(registry, "deployment_backend", lambda _infra: SkyPilotDeployments(SimulatedClient(made)))
    yield made
    for name in list(made.machines):
        made.end(name)


@pytest.fixture
def workspace(shell: Shell) -> Workspace:
    """A fresh clone, after the one before was deleted, as CI has it."""
    numbers = iter(range(99))

    def fresh() -> Shell:
        for before in shell.folder.parent.glob("ci-*"):
            shutil.rmtree(before)
        folder = shell.folder.parent / f"ci-{next(numbers)}"
        git("clone", "-q", str(shell.folder.parent / "remote.git"), str(folder), folder=shell.folder)
        return Shell(folder, shell.monkeypatch, shell.capsys)

    return fresh


def test_each_workspace_goes_on_where_the_last_one_stopped(cloud: Cloud, workspace: Workspace) -> None:
    workspace()("apply", MANIFEST, *AT, "--yes")
    (old,) = cloud.machines
    assert "no changes" in workspace()("apply", MANIFEST, *AT, "--yes").out
    assert "Synced, Healthy" in workspace()("status", *AT).out
    changed = workspace()
    spec = (changed.folder / "specs/demo.yaml").read_text()
    changed.write("specs/demo.yaml", spec + "  deployment: {ready: ['true']}\n")
    changed("compile", "specs/demo.yaml", *AT)
    git("commit", "-qam", "ready", folder=changed.folder)
    git("push", "-q", "origin", "HEAD:master", folder=changed.folder)
    said = changed("apply", MANIFEST, *AT, "--yes").err
    assert said.index("starting fogspec-") < said.index(f"{old}: gone"), "without downtime"
    (new,) = cloud.machines
    assert new in workspace()("ps", "-o", "json").out
    assert "1 ended" in workspace()("down", "demo").out
    assert cloud.machines == {}


def test_a_machine_is_adopted_by_its_labels_from_any_workspace(cloud: Cloud, workspace: Workspace) -> None:
    workspace()("apply", MANIFEST, *AT, "--yes")
    (name,) = cloud.machines
    labels = dict(cloud.machines[name].labels)
    assert {MANIFEST_LABEL, RUNS_LABEL, FALLBACK_LABEL, OWNER_LABEL} <= set(labels)
    assert all(len(text) <= 63 for text in labels.values())
    remote = workspace().folder.parent / "remote.git"
    forget = ["update-ref", "-d", subprocess.run(["git", "for-each-ref", "--format=%(refname)", "refs/fogspec"], cwd=remote,
              check=True, capture_output=True, text=True).stdout.strip()]  # fmt: skip
    git(*forget, folder=remote)
    assert "fogspec adopt demo takes it over" in workspace()("apply", MANIFEST, *AT, "--yes", code=5).err
    assert f"{name} taken over" in workspace()("adopt", "demo", *AT).out
    assert "no changes" in workspace()("apply", MANIFEST, *AT, "--yes").out

    git(*forget, folder=remote)
    cloud.machines[name].labels = {OWNER_LABEL: labels[OWNER_LABEL]}  # as one that an earlier version started
    assert "what it was given is unknown: apply replaces it" in workspace()("adopt", "demo", *AT).out
    assert f"{name}: gone" in workspace()("apply", MANIFEST, *AT, "--yes").err

    (name,) = cloud.machines
    git(*forget, folder=remote)
    cloud.machines[name].labels = {**cloud.machines[name].labels, MANIFEST_LABEL: "a" * 52}
    refused = workspace()("adopt", *AT, code=5).err
    assert "1 machine was not taken over" in refused
    assert "is neither at compiled/demo/manifest.yaml nor among" in refused
    assert list(cloud.machines) == [name]
    workspace()("down", "demo")


def test_machines_of_another_repository_need_its_url(cloud: Cloud, workspace: Workspace) -> None:
    workspace()("apply", MANIFEST, *AT, "--yes")
    (name,) = cloud.machines
    moved, before = workspace(), str(workspace().folder.parent / "remote.git")
    moved = workspace()
    (moved.folder / "fogspec.yaml").unlink()
    git("remote", "set-url", "origin", "https://forge.test/lab/robots.git", folder=moved.folder)
    assert "nothing runs" in moved("down", "demo").out
    asked = moved("down", "demo", "--repository", before, code=5).err
    assert f"  {name}" in asked
    assert "confirmation required" in asked
    assert "nothing runs" in moved("down", "demo", "--repository", "https://forge.test/fork/robots.git", "--yes").out
    assert list(cloud.machines) == [name]
    assert "1 ended" in moved("down", "demo", "--repository", before, "--yes").out
    assert cloud.machines == {}


def test_a_terminal_lists_what_ends_and_asks(
    cloud: Cloud, workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    workspace()("apply", MANIFEST, *AT, "--yes")
    (name,) = cloud.machines
    answers = iter([False, True])
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("fogspec.cli.down.ask", lambda _: next(answers))
    refused = workspace()("down", "demo", code=5).err
    assert f"  {name}" in refused
    assert "nothing was ended" in refused
    assert list(cloud.machines) == [name]
    assert "1 ended" in workspace()("down", "demo").out
    assert cloud.machines == {}
    assert "nothing runs" in workspace()("down", "demo").out, "there is nothing to ask"
