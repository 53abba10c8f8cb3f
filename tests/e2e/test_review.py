"""The review of a change in a real git repository, and the steps of the GitHub Action, run as they are written."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from tests.support.running import CATALOG, Shell, measure, project, shell  # noqa: F401

ROOT = Path(__file__).resolve().parents[2]
AT = ("--catalog", "offers.csv")


def git(folder: Path, *words: str) -> str:
    who = {"GIT_AUTHOR_NAME": "a", "GIT_AUTHOR_EMAIL": "a@example.org", "GIT_COMMITTER_NAME": "a",
           "GIT_COMMITTER_EMAIL": "a@example.org"}  # fmt: skip
    run = subprocess.run(
        ["git", "-c", "init.defaultBranch=main", "-c", "commit.gpgsign=false", *words], cwd=folder, check=True,
        capture_output=True, text=True, env={**os.environ, **who},
    )  # fmt: skip
    return run.stdout.strip()


@pytest.fixture
def repository(shell: Shell) -> Shell:
    """A project whose manifest is committed on main, with a lock, as a team has it."""
    project(shell)
    shell("lock", *AT)
    shell("compile", "specs/demo.yaml")
    measure(shell)
    shell("compile", "specs/demo.yaml")
    git(shell.folder, "init", "-q")
    commit(shell, "first")
    return shell


def commit(shell: Shell, message: str) -> str:
    git(shell.folder, "add", "-A")
    git(shell.folder, "commit", "-q", "-m", message)
    return git(shell.folder, "rev-parse", "HEAD")


def change(shell: Shell, old: str, new: str, name: str = "specs/demo.yaml") -> None:
    before = shell.read(name)
    assert old in before
    shell.write(name, before.replace(old, new))


def test_nothing_changed(repository: Shell) -> None:
    assert "Unchanged and fresh: demo." in repository("review", "HEAD", "--exit-code").out


def test_another_machine_with_its_price_and_why(repository: Shell) -> None:
    base = git(repository.folder, "rev-parse", "HEAD")
    change(repository, "alpha: 0.5", "alpha: 0")
    repository("compile", "specs/demo.yaml")
    commit(repository, "cheaper")
    said = repository("review", f"{base}..HEAD", "--picture-base", "https://example.org/raw/abc", "--exit-code").out
    assert "### demo: a.large in aws/r1 -\\> a.small in aws/r1" in said
    assert "| machine | $0.4/h | $0.1/h | -75% |" in said
    assert "why: spec.objective changed" in said
    assert "![menu of demo](https://example.org/raw/abc/compiled/demo/menu.svg)" in said
    assert re.search(r"\| results \| results/demo\.yaml \| `[0-9a-f]{12}` \|", said)
    assert "everything is fresh; no benchmark needed" in said


def test_what_is_not_fresh_is_said(repository: Shell) -> None:
    change(repository, "alpha: 0.5", "alpha: 0")
    commit(repository, "forgot to compile")
    ended = repository("review", "HEAD~1", "--exit-code", code=3)
    assert "### demo: the manifest is not fresh" in ended.out
    assert "**manifest is stale**" in ended.out
    assert "**to do**: `fogspec compile specs/demo.yaml`, and commit what it writes" in ended.out
    assert "not fresh: demo" in ended.err


def test_an_application_that_is_gone_and_one_that_stays(repository: Shell) -> None:
    other = repository.read("specs/demo.yaml").replace("name: demo", "name: other")
    repository.write("specs/other.yaml", other)
    base = commit(repository, "two")
    git(repository.folder, "rm", "-q", "-r", "specs/demo.yaml", "compiled/demo")
    said = repository("review", base, *AT).out
    assert "### demo: no longer deployed" in said
    assert "- runs on a.large in aws/r1, $0.4/h, $292.00/month" in said
    assert "`fogspec down demo` ends it" in said
    assert "### other: no manifest" in said
    git(repository.folder, "rm", "-q", "-r", "specs")
    assert "### demo: no longer deployed" in repository("review", base).out


def test_warnings_are_new_or_folded_away(repository: Shell) -> None:
    change(repository, "alpha: 0.5", "alpha: 0")
    change(repository, "latency: 10s", "latency: 1s")
    repository("compile", "specs/demo.yaml")
    said = repository("review", "HEAD").out
    new, _, old = said.partition("warnings, as before</summary>")
    assert "- **warning**: no machine meets the limits with constraints.confidence 0.9" in new
    assert "- curve of latency: " in old


def test_outside_of_a_repository_it_says_what_to_do(shell: Shell) -> None:
    said = shell("review", "main", code=2).err
    assert said.startswith(f"error: {shell.folder} is in no git repository")
    assert "fogspec diff says without git" in said
    git(shell.folder, "init", "-q")
    assert shell("review", code=2).err == "error: there is no commit HEAD here\n  commit something first\n"


def test_a_new_application_and_one_that_is_not_measured(repository: Shell) -> None:
    repository.write("specs/other.yaml", repository.read("specs/demo.yaml").replace("name: demo", "name: other"))
    said = repository("review", "HEAD", *AT).out
    assert "### other: no manifest" in said
    assert "**plan is missing**" in said
    (repository.folder / "specs/other.yaml").unlink()
    manifest = repository.folder / "compiled/demo/manifest.yaml"
    content = manifest.read_bytes()
    manifest.unlink()
    commit(repository, "without a manifest")
    manifest.write_bytes(content)
    assert "### demo: a new manifest" in repository("review", "HEAD").out


def test_the_base_is_where_the_branches_part(repository: Shell) -> None:
    git(repository.folder, "checkout", "-q", "-b", "mine")
    change(repository, "latency: 10s", "latency: 9s")
    repository("compile", "specs/demo.yaml")
    commit(repository, "mine")
    git(repository.folder, "checkout", "-q", "main")
    change(repository, "alpha: 0.5", "alpha: 0")
    repository("compile", "specs/demo.yaml")
    commit(repository, "theirs")
    git(repository.folder, "checkout", "-q", "mine")
    said = repository("review", "main..HEAD").out
    assert "a.large in aws/r1 stays" in said
    assert "| `expected.latency.limit` | 10s | 9s |" in said


def test_wrong_commits_and_no_repository(repository: Shell) -> None:
    commit(repository, "again") if git(repository.folder, "status", "--porcelain") else None
    assert "no commit" in repository("review", "nowhere", code=2).err
    repository("review", "--", "-x", code=2)
    first = git(repository.folder, "rev-parse", "HEAD")
    change(repository, "latency: 10s", "latency: 9s")
    commit(repository, "later")
    assert "is not what is checked out" in repository("review", f"{first}..{first}", code=2).err


def steps() -> dict[str, dict]:
    action = YAML(typ="safe", pure=True).load(ROOT / "action.yml")
    return {step["name"]: step for step in action["runs"]["steps"] if "name" in step}


def run_step(name: str, shell: Shell, **given: str) -> "subprocess.CompletedProcess[str]":
    """A step of the action with what GitHub gives it, in GitHub's own shell (`bash --noprofile --norc -eo pipefail`)."""
    step = steps()[name]
    assert step["shell"] == "bash"
    missing = [key for key, value in step.get("env", {}).items() if key not in given and "${{" in value]
    assert not missing, missing
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}", **given}
    return subprocess.run(
        ["bash", "--noprofile", "--norc", "-eo", "pipefail", "-c", step["run"]], cwd=shell.folder, env=environment,
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip


def test_the_action_validates_and_checks(repository: Shell) -> None:
    assert run_step("validate", repository, PATHS="specs\n").returncode == 0
    base = git(repository.folder, "rev-parse", "HEAD")
    for since in ("", base):
        passed = run_step("check", repository, PATHS="specs\n", BASE=since)
        assert passed.returncode == 0, passed.stderr
    change(repository, "alpha: 0.5", "alpha: 5")
    wrong = run_step("validate", repository, PATHS="specs\n")
    assert wrong.returncode == 1
    assert "::error file=specs/demo.yaml,line=" in wrong.stdout
    change(repository, "alpha: 5", "alpha: 0.25")
    stale = run_step("check", repository, PATHS="specs", BASE=base)
    assert stale.returncode == 3
    assert "FAIL  demo" in stale.stdout
    assert "spec.objective" in stale.stdout


@pytest.mark.parametrize("posted", [True, False])
def test_the_action_posts_the_review(repository: Shell, tmp_path: Path, posted: bool) -> None:
    base = git(repository.folder, "rev-parse", "HEAD")
    change(repository, "alpha: 0.5", "alpha: 0")
    repository("compile", "specs/demo.yaml")
    head = commit(repository, "cheaper")
    # What GitHub's own runners have as `gh` is not here: this one keeps what it was told to post.
    gh = tmp_path / "bin" / "gh"
    gh.parent.mkdir()
    gh.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/called\ncp "$5" {tmp_path}/posted\nexit {0 if posted else 1}\n')
    gh.chmod(0o755)
    summary = tmp_path / "summary.md"
    done = run_step(
        "review", repository, PATHS="specs", BASE=base, FILES=f"https://example.org/o/r/raw/{head}", PULL_REQUEST="7",
        GH_TOKEN="t", RUNNER_TEMP=str(tmp_path), GITHUB_STEP_SUMMARY=str(summary),
        PATH=f"{gh.parent}{os.pathsep}{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    called = (tmp_path / "called").read_text()
    assert called.startswith("pr comment 7 --body-file ")
    assert "--edit-last --create-if-none" in called
    assert (tmp_path / "posted").read_text() == summary.read_text()
    assert "a.large in aws/r1 -\\> a.small in aws/r1" in summary.read_text()
    assert f"raw/{head}/compiled/demo/menu.svg" in summary.read_text()
    assert ("::warning::" in done.stdout) is not posted


def test_the_action_names_only_inputs_it_has() -> None:
    text = (ROOT / "action.yml").read_text(encoding="utf-8")
    action = YAML(typ="safe", pure=True).load(text)
    assert set(re.findall(r"inputs\.(\w+)", text)) == set(action["inputs"])


def test_the_hooks_run_what_they_say(repository: Shell) -> None:
    hooks = {hook["id"]: hook for hook in YAML(typ="safe", pure=True).load(ROOT / ".pre-commit-hooks.yaml")}
    assert hooks.keys() == {"fogspec-validate", "fogspec-ci"}
    for hook in hooks.values():
        words = hook["entry"].split()[1:]
        names = [] if hook.get("pass_filenames") is False else ["specs/demo.yaml"]
        repository(*words, *names)
    for name in ("specs/demo.yaml", "compiled/demo/manifest.yaml", "results/demo.yaml", "fogspec.lock"):
        assert re.search(hooks["fogspec-ci"]["files"], name)
