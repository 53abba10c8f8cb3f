"""Machines of a cloud, deployed from workspaces that come and go: shared state, adoption, and a repository that moved."""

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from fogspec.backends.naming import FALLBACK_LABEL, MANIFEST_LABEL, OWNER_LABEL, RUNS_LABEL
from fogspec.deploy import shared_state
from tests.e2e.test_deployment_skypilot import status
from tests.support.deployed_cloud import AT, MANIFEST
from tests.support.deployed_cloud import cloud as plain  # noqa: F401
from tests.support.fake_sky import Cloud
from tests.support.running import Shell, shell  # noqa: F401
from tests.support.scenes import until

PROJECT = "apiVersion: fogspec.dev/v1alpha1\nkind: Project\nspec: {state: git}\n"
Workspace = Callable[[], Shell]


def git(*words: str, folder: Path) -> None:
    who = ("-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false")
    subprocess.run(["git", *who, *words], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def cloud(shell: Shell, plain: Cloud, monkeypatch: pytest.MonkeyPatch) -> Cloud:
    monkeypatch.delenv("FOGSPEC_STATE", raising=False)
    monkeypatch.setattr(shared_state, "KEPT_S", -1.0)
    shell.write("fogspec.yaml", PROJECT)
    shell.write(".gitignore", ".fogspec/\n")
    remote = shell.folder.parent / "remote.git"
    git("init", "-q", "--bare", str(remote), folder=shell.folder)
    for words in (["init", "-q"], ["add", "."], ["commit", "-qm", "all"], ["remote", "add", "origin", str(remote)],
                  ["push", "-q", "origin", "HEAD:master"]):  # fmt: skip
        git(*words, folder=shell.folder)
    git("symbolic-ref", "HEAD", "refs/heads/master", folder=remote)
    return plain


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
    workspace()("apply", MANIFEST, "--yes")
    (old,) = cloud.machines
    assert "-demo-" in old
    again = workspace()("apply", MANIFEST, "--yes").out
    assert "no changes" in again
    assert "192.0.2.1" in again
    until(lambda: status(workspace())["observed"]["requests"] > 0)
    # The node answers in 20 ms: the results in this test said a second.
    assert "Synced, " in workspace()("status").out
    changed = workspace()
    spec = (changed.folder / "specs/demo.yaml").read_text()
    changed.write("specs/demo.yaml", spec + "  deployment: {ready: ['true']}\n")
    changed("apply", MANIFEST, "--yes", code=3)
    changed("compile", "specs/demo.yaml", *AT)
    assert status(changed)["sync"] == "OutOfSync"
    for words in (["--yes"], ["--dry-run"]):
        refused = changed("apply", MANIFEST, *words, code=5).err
        assert f"{MANIFEST}: is not what HEAD has" in refused
    assert list(cloud.machines) == [old]
    git("commit", "-qam", "ready", folder=changed.folder)
    git("push", "-q", "origin", "HEAD:master", folder=changed.folder)
    said = changed("apply", MANIFEST, "--yes").err
    assert said.index("starting fogspec-") < said.index(f"{old}: gone"), "without downtime"
    (new,) = cloud.machines
    assert new in workspace()("status", "-o", "json").out
    assert "1 ended" in workspace()("down", "demo").out
    assert cloud.machines == {}


def test_ci_deploys_what_is_committed(cloud: Cloud, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    shell.write("fogspec.yaml", PROJECT.replace("git", "folder"))
    shell.write("specs/demo.yaml", (shell.folder / "specs/demo.yaml").read_text() + "  deployment: {ready: ['true']}\n")
    shell("compile", "specs/demo.yaml", *AT)
    monkeypatch.setenv("CI", "true")
    assert "is not what HEAD has" in shell("apply", MANIFEST, "--yes", code=5).err
    assert cloud.machines == {}
    monkeypatch.delenv("CI")
    shell("apply", MANIFEST, "--yes")
    assert len(cloud.machines) == 1
    monkeypatch.setenv("CI", "true")
    git("commit", "-qam", "ready", folder=shell.folder)
    assert "no changes" in shell("apply", MANIFEST, "--yes").out
    (shell.folder / ".git").rename(shell.folder.parent / "no-git")
    shell.write("specs/demo.yaml", (shell.folder / "specs/demo.yaml").read_text().replace("'true'", "'true', x"))
    shell("compile", "specs/demo.yaml", *AT)
    assert "is a machine of another application" in shell("apply", MANIFEST, "--dry-run", code=1).out
    (shell.folder.parent / "no-git").rename(shell.folder / ".git")
    shell("down", "demo")
    assert cloud.machines == {}


def test_a_machine_is_adopted_by_its_labels_from_any_workspace(cloud: Cloud, workspace: Workspace) -> None:
    workspace()("apply", MANIFEST, "--yes")
    (name,) = cloud.machines
    labels = dict(cloud.machines[name].labels)
    assert {MANIFEST_LABEL, RUNS_LABEL, FALLBACK_LABEL, OWNER_LABEL} <= set(labels)
    assert all(len(text) <= 63 for text in labels.values())
    remote = workspace().folder.parent / "remote.git"
    forget = ["update-ref", "-d", subprocess.run(["git", "for-each-ref", "--format=%(refname)", "refs/fogspec"], cwd=remote,
              check=True, capture_output=True, text=True).stdout.strip()]  # fmt: skip
    git(*forget, folder=remote)
    assert "fogspec apply demo --adopt takes it over" in workspace()("apply", MANIFEST, "--yes", code=5).err
    assert f"{name} taken over" in workspace()("apply", "demo", "--adopt").out
    assert "no changes" in workspace()("apply", MANIFEST, "--yes").out

    git(*forget, folder=remote)
    cloud.machines[name].labels = {OWNER_LABEL: labels[OWNER_LABEL]}  # as one that an earlier version started
    assert "what it was given is unknown: apply replaces it" in workspace()("apply", "demo", "--adopt").out
    assert f"{name}: gone" in workspace()("apply", MANIFEST, "--yes").err

    (name,) = cloud.machines
    git(*forget, folder=remote)
    cloud.machines[name].labels = {**cloud.machines[name].labels, MANIFEST_LABEL: "a" * 52}
    refused = workspace()("apply", "demo", "--adopt", code=5).err
    assert "1 machine was not taken over" in refused
    assert "is neither at compiled/demo/manifest.yaml nor among" in refused
    assert list(cloud.machines) == [name]
    workspace()("down", "demo")


def test_machines_of_another_repository_need_its_url(cloud: Cloud, workspace: Workspace) -> None:
    workspace()("apply", MANIFEST, "--yes")
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
    workspace()("apply", MANIFEST, "--yes")
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
