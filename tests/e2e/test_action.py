"""The steps of the GitHub Action as they are written, in GitHub's shell: on a shallow clone, with an API on loopback."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from fogspec.audit.comment import LONGEST, MARK
from tests.e2e.test_review import change, commit, git, repository  # noqa: F401
from tests.support.github import GitHub, serving
from tests.support.hostile_text import HOSTILE
from tests.support.running import Shell, shell  # noqa: F401

ROOT = Path(__file__).resolve().parents[2]


def steps() -> dict[str, dict[str, Any]]:
    action = YAML(typ="safe", pure=True).load(ROOT / "action.yml")
    return {step["name"]: step for step in action["runs"]["steps"] if "name" in step}


def run_step(name: str, folder: Path, **given: str) -> "subprocess.CompletedProcess[str]":
    """A step of the action with what GitHub gives it, in GitHub's own shell (`bash --noprofile --norc -eo pipefail`)."""
    step = steps()[name]
    assert step["shell"] == "bash"
    missing = [key for key, value in step.get("env", {}).items() if key not in given and "${{" in value]
    assert not missing, missing
    kept = {key: value for key, value in os.environ.items() if not key.startswith("GITHUB_")}
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return subprocess.run(
        ["bash", "--noprofile", "--norc", "-eo", "pipefail", "-c", step["run"]], cwd=folder,
        env={**kept, "PATH": path, **given}, capture_output=True, text=True, timeout=120,
    )  # fmt: skip


@pytest.fixture
def github() -> Iterator[GitHub]:
    with serving() as one:
        yield one


class Job:
    """A job of the pull request 7: a clone of its head alone, from a repository on this host."""

    def __init__(self, folder: Path, origin: Path, base: str, github: GitHub, token: str = "bot") -> None:
        folder.mkdir()
        git(folder, "clone", "-q", "--depth=1", f"file://{origin}", "clone")
        self.folder, self.temp = folder / "clone", folder
        self.head = git(self.folder, "rev-parse", "HEAD")
        self.given = {
            **github.environment(token), "PATHS": "specs\n", "BASE": base, "PULL_REQUEST": "7", "ACTION": str(ROOT),
            "RESOLVE_IMAGE": "false",
            "FILES": f"https://example.org/team/robots/raw/{self.head}", "RUNNER_TEMP": str(folder),
            "GITHUB_STEP_SUMMARY": str(folder / "summary.md"),
        }  # fmt: skip

    def run(self, name: str, code: int = 0) -> str:
        ended = run_step(name, self.folder, **self.given)
        assert ended.returncode == code, ended
        return ended.stdout

    @property
    def summary(self) -> str:
        return (self.temp / "summary.md").read_text()


@pytest.fixture
def origin(repository: Shell, tmp_path: Path) -> Path:
    """The repository on a server, which gives out any commit by its name, as GitHub does."""
    path = tmp_path / "origin.git"
    git(tmp_path, "clone", "-q", "--bare", str(repository.folder), str(path))
    git(path, "config", "uploadpack.allowAnySHA1InWant", "true")
    git(repository.folder, "remote", "add", "origin", str(path))
    return path


def pushed(shell: Shell, message: str) -> None:
    commit(shell, message)
    git(shell.folder, "push", "-q", "origin", "HEAD:main")


def cheaper(shell: Shell) -> str:
    """Push another choice; return the base."""
    base = git(shell.folder, "rev-parse", "HEAD")
    change(shell, "alpha: 0.5", "alpha: 0")
    shell("compile", "specs/demo.yaml")
    pushed(shell, "cheaper")
    return base


def test_the_action_validates_and_checks(repository: Shell) -> None:
    assert run_step("validate", repository.folder, PATHS="specs\n").returncode == 0
    base = git(repository.folder, "rev-parse", "HEAD")
    for since, resolve in (("", "false"), (base, "false"), ("", "true")):
        passed = run_step("check", repository.folder, PATHS="specs\n", BASE=since, RESOLVE_IMAGE=resolve)
        assert passed.returncode == 0, passed.stderr
    change(repository, "alpha: 0.5", "alpha: 5")
    wrong = run_step("validate", repository.folder, PATHS="specs\n")
    assert wrong.returncode == 1
    assert "::error file=specs/demo.yaml,line=" in wrong.stdout
    change(repository, "alpha: 5", "alpha: 0.25")
    stale = run_step("check", repository.folder, PATHS="specs", BASE=base, RESOLVE_IMAGE="false")
    assert stale.returncode == 3
    assert "FAIL  demo" in stale.stdout
    assert "spec.objective" in stale.stdout


def test_a_comment_is_created_and_then_updated(repository: Shell, origin: Path, github: GitHub, tmp_path: Path) -> None:
    base = cheaper(repository)
    job = Job(tmp_path / "first", origin, base, github)
    assert not (tmp_path / "first/review.md").exists()
    job.run("review")
    assert job.run("comment") == "comment created\n"
    job.run("check")
    assert [one.body for one in github.comments] == [job.summary]
    text = github.comments[0].body
    assert text.startswith(MARK)
    assert "a.large in aws/r1 -\\> a.small in aws/r1" in text
    assert f"raw/{job.head}/compiled/demo/menu.svg" in text
    # The same again after another push, while others comment too.
    github.add("somebody", "looks good")
    github.add("bot", "coverage: 97%")
    change(repository, "latency: 10s", "latency: 9s")
    repository("compile", "specs/demo.yaml")
    pushed(repository, "a limit")
    job = Job(tmp_path / "second", origin, base, github)
    job.run("review")
    assert job.run("comment") == "comment updated\n"
    assert [one.body for one in github.comments] == [job.summary, "looks good", "coverage: 97%"]
    assert "| `spec.constraints.latency` | 10s | 9s |" in job.summary
    assert github.writes[-1] == ("PATCH", "/api/repos/team/robots/issues/comments/101")


def test_a_comment_of_others_is_left_alone_whatever_it_begins_with(
    repository: Shell, origin: Path, github: GitHub, tmp_path: Path
) -> None:
    github.add("somebody", f"{MARK}\nforged")
    github.add("bot", "from another action")
    github.add("bot", f"I quote: {MARK}")
    before = [one.body for one in github.comments]
    job = Job(tmp_path / "job", origin, cheaper(repository), github)
    job.run("review")
    assert job.run("comment") == "comment created\n"
    assert [one.body for one in github.comments] == [*before, job.summary]


def test_of_two_jobs_that_begin_at_once_one_comment_stays(
    repository: Shell, origin: Path, github: GitHub, tmp_path: Path
) -> None:
    job = Job(tmp_path / "job", origin, cheaper(repository), github)
    job.run("review")
    github.meanwhile = lambda: github.add("bot", f"{MARK}\nof the other job")
    assert job.run("comment") == "comment created\n"
    assert [one.body for one in github.comments] == [job.summary]


def test_a_fork_without_rights_has_the_summary(repository: Shell, origin: Path, github: GitHub, tmp_path: Path) -> None:
    github.refused = ("fork",)
    job = Job(tmp_path / "job", origin, cheaper(repository), github, token="fork")
    job.run("review")
    said = job.run("comment")
    assert said.startswith("::warning::the review is in the job's summary; as a comment it was not posted: HTTP 403: ")
    assert "Resource not accessible by integration" in said
    assert job.summary.startswith(MARK)
    assert not github.comments


def test_an_api_that_fails_for_a_while_and_one_that_is_away(
    repository: Shell, origin: Path, github: GitHub, tmp_path: Path
) -> None:
    job = Job(tmp_path / "job", origin, cheaper(repository), github)
    job.run("review")
    github.failing = 2
    assert job.run("comment") == "comment created\n"
    github.failing = 99
    assert "HTTP 502: Server Error" in job.run("comment")
    job.given |= {"GITHUB_GRAPHQL_URL": "http://127.0.0.1:1/graphql"}
    assert job.run("comment").startswith("::warning::")
    job.given |= {"GITHUB_GRAPHQL_URL": "file:///etc/passwd"}
    assert "are not addresses of the web" in job.run("comment")


def test_an_invalid_spec_and_a_broken_policy_are_in_the_comment_and_fail_other_steps(
    repository: Shell, origin: Path, github: GitHub, tmp_path: Path
) -> None:
    base = git(repository.folder, "rev-parse", "HEAD")
    policy = (
        '{"properties": {"spec": {"properties": {"objective": {"properties": {"alpha": '
        '{"minimum": 0.4, "description": "latency counts, </details> @team"}}}}}}}'
    )
    repository.write("policies/team.schema.json", policy)
    change(repository, "alpha: 0.5", "alpha: 0")
    repository("compile", "specs/demo.yaml", code=1)
    pushed(repository, "against the policy")
    job = Job(tmp_path / "policy", origin, base, github)
    job.run("review")
    job.run("comment")
    text = github.comments[0].body
    assert "- **Policies broken**: 1 time, by demo." in text
    assert "**policy broken**: `specs/demo.yaml:8`: latency counts, \\</details\\> @\u200b" in text.replace(
        "&#8203;", "\u200b"
    )
    job.run("check", 3)
    change(repository, "alpha: 0", "alpha: zero")
    pushed(repository, "not valid")
    job = Job(tmp_path / "invalid", origin, base, github)
    job.run("review")
    job.run("comment")
    assert "### Invalid specs\n\n- `specs/demo.yaml:8:" in github.comments[0].body
    job.run("check", 1)


def test_a_review_that_ends_early_replaces_what_was_said_of_an_earlier_commit(
    repository: Shell, origin: Path, github: GitHub, tmp_path: Path
) -> None:
    base = cheaper(repository)
    earlier = github.add("bot", f"{MARK}\nall is well")
    repository.write("offers.csv", repository.read("offers.csv").replace("0.40", "0.41"))
    pushed(repository, "another catalog than the lock's")
    job = Job(tmp_path / "job", origin, base, github)
    job.run("review")
    job.run("comment")
    assert "**cannot be compiled**: demo: the catalog offers.csv is not the one that fogspec.lock pins" in earlier.body
    assert job.summary == earlier.body
    job.run("check", 3)
    job.given |= {"BASE": "0" * 40}
    job.run("review", 2)
    job.run("comment")
    assert "fogspec review ended with exit code 2" in earlier.body
    job.run("check", 2)


def test_hostile_texts_stay_texts_on_the_way_to_the_api(github: GitHub, tmp_path: Path) -> None:
    text = MARK + "\n" + "\n".join(one.encode("utf-8", "replace").decode() for one in HOSTILE)
    (tmp_path / "review.md").write_text(text, newline="")
    given = {**github.environment(), "PULL_REQUEST": "7", "ACTION": str(ROOT), "RUNNER_TEMP": str(tmp_path)}
    assert run_step("comment", tmp_path, **given).returncode == 0
    assert github.comments[0].body == (tmp_path / "review.md").read_text()
    assert run_step("comment", tmp_path, **given | {"PULL_REQUEST": "7/../8"}).stdout.startswith("::warning::")
    assert run_step("comment", tmp_path, **given | {"GITHUB_REPOSITORY": "team/robots/../x"}).stdout.startswith(
        "::warning"
    )
    assert len(github.comments) == 1
    (tmp_path / "review.md").write_text("without the mark")
    assert run_step("comment", tmp_path, **given).returncode == 1


def test_the_token_is_in_one_step_alone() -> None:
    for name, step in steps().items():
        has = "token" in str(step.get("env", {}))
        assert has == (name == "comment"), name
    assert LONGEST == 65_536


def test_the_action_names_only_inputs_it_has() -> None:
    text = (ROOT / "action.yml").read_text(encoding="utf-8")
    action = YAML(typ="safe", pure=True).load(text)
    assert set(re.findall(r"inputs\.([\w-]+)", text)) == set(action["inputs"])
