"""The steps of the GitHub Action as they are written, in GitHub's shell.

The checkout is the documented one: the merge commit and its parents, of a private repository, with an API on loopback.
"""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from fogspec.review.comment import LONGEST, MARK
from fogspec.review.github_comment import mark_of
from tests.e2e.test_diff import change, commit, git, repository  # noqa: F401
from tests.support.github import GitHub, serving
from tests.support.hostile_text import HOSTILE
from tests.support.loaded import programs
from tests.support.running import Shell, shell  # noqa: F401

ROOT = Path(__file__).resolve().parents[2]


def steps() -> dict[str, dict[str, Any]]:
    action = YAML(typ="safe", pure=True).load(ROOT / "action.yml")
    return {step["name"]: step for step in action["runs"]["steps"] if "name" in step}


def run_step(name: str, folder: Path, starts: bool = False, **given: str) -> "subprocess.CompletedProcess[str]":
    """A step of the action with what GitHub gives it, in GitHub's own shell (`bash --noprofile --norc -eo pipefail`).

    With `starts` its programs are started as installed, at a second each.
    """
    step = steps()[name]
    assert step["shell"] == "bash"
    missing = [key for key, value in step.get("env", {}).items() if key not in given and "${{" in value]
    assert not missing, missing
    kept = {key: value for key, value in os.environ.items() if not key.startswith("GITHUB_")}
    assert step.get("working-directory", "${{ runner.temp }}") == "${{ runner.temp }}"
    place = Path(given["RUNNER_TEMP"]) if "working-directory" in step else folder
    path = os.pathsep.join(
        [*([] if starts else [str(programs())]), str(Path(sys.executable).parent), os.environ["PATH"]]
    )
    return subprocess.run(
        ["bash", "--noprofile", "--norc", "-eo", "pipefail", "-c", step["run"]], cwd=place,
        env={**kept, "PATH": path, **given}, capture_output=True, text=True, timeout=600,
    )  # fmt: skip


@pytest.fixture
def github() -> Iterator[GitHub]:
    with serving() as one:
        yield one


class Job:
    """A job of the pull request 7 into `base`: what actions/checkout leaves of its merge commit with a depth of 2.

    Its origin asks for a password that no step has. `event` is the base that GitHub names, which may be an older one.
    """

    def __init__(self, folder: Path, origin: Path, base: str, github: GitHub, *, token: str = "bot", depth: int = 2,
                 paths: str = "specs\n", event: str = "") -> None:  # fmt: skip
        folder.mkdir()
        self.folder, self.temp, self.origin = folder / "clone", folder, origin
        self.head = git(origin, "rev-parse", "main")
        tree = git(origin, "merge-tree", "--write-tree", base, self.head)
        merge = git(origin, "commit-tree", tree, "-p", base, "-p", self.head, "-m", "merge")
        git(origin, "update-ref", "refs/pull/7/merge", merge)
        git(folder, "init", "-q", "clone")
        git(self.folder, "fetch", "-q", f"--depth={depth}", f"file://{origin}", "refs/pull/7/merge")
        git(self.folder, "checkout", "-q", "FETCH_HEAD")
        git(self.folder, "remote", "add", "origin", f"{github.address}/team/robots.git")
        self.given = {
            **github.environment(token), "PATHS": paths, "BASE": event or base, "HEAD": self.head, "PULL_REQUEST": "7",
            "ACTION": str(ROOT), "RESOLVE_IMAGE": "false", "ALLOW_POLICY_CHANGE": "false",
            "FILES": f"https://example.org/team/robots/raw/{self.head}", "RUNNER_TEMP": str(folder),
            "GITHUB_STEP_SUMMARY": str(folder / "summary.md"), "GITHUB_OUTPUT": str(folder / "output"),
        }  # fmt: skip
        self.said = self.find_base()

    def find_base(self) -> str:
        """Run the step that finds the base, for those after it; return what it prints."""
        (self.temp / "output").unlink(missing_ok=True)
        said = self.run("base")
        self.given["BASE"] = (self.temp / "output").read_text().removeprefix("base=").strip()
        return said

    def run(self, name: str, code: int = 0) -> str:
        ended = run_step(name, self.folder, **self.given)
        assert ended.returncode == code, ended
        return ended.stdout

    @property
    def summary(self) -> str:
        return (self.temp / "summary.md").read_text()

    @property
    def comment(self) -> str:
        """The summary as it is posted."""
        return self.summary.replace(MARK, mark_of(self.given["PATHS"]), 1)


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
    for since, resolve, allow in (("", "false", "false"), (base, "false", "true"), ("", "true", "false")):
        given = {"RESOLVE_IMAGE": resolve, "ALLOW_POLICY_CHANGE": allow}
        passed = run_step("check", repository.folder, PATHS="specs\n", BASE=since, **given)
        assert passed.returncode == 0, passed.stderr
    change(repository, "alpha: 0.5", "alpha: 5")
    wrong = run_step("validate", repository.folder, PATHS="specs\n")
    assert wrong.returncode == 1
    assert "::error file=specs/demo.yaml,line=" in wrong.stdout
    change(repository, "alpha: 5", "alpha: 0.25")
    stale = run_step("check", repository.folder, PATHS="specs", BASE=base, RESOLVE_IMAGE="false",
                     ALLOW_POLICY_CHANGE="false")  # fmt: skip
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
    assert [one.body for one in github.comments] == [job.comment]
    text = github.comments[0].body
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
    assert [one.body for one in github.comments] == [job.comment, "looks good", "coverage: 97%"]
    assert "| `spec.constraints.latency` | 10s | 9s |" in job.summary
    assert github.writes[-1] == ("PATCH", "/api/repos/team/robots/issues/comments/101")


def test_a_private_repository_is_compared_with_the_merge_commits_first_parent(
    repository: Shell, origin: Path, github: GitHub, tmp_path: Path
) -> None:
    """Also where others merged after the commit that the event names: their applications are no change of this one."""
    repository.write("specs/other/work.py", "print('work')\n")
    repository.write("specs/other/other.yaml", repository.read("specs/demo.yaml").replace("name: demo", "name: other"))
    pushed(repository, "two applications")
    event = cheaper(repository)
    git(repository.folder, "checkout", "-q", event)
    change(repository, "alpha: 0.5", "alpha: 0.4", "specs/other/other.yaml")
    base = commit(repository, "of another team")
    git(repository.folder, "push", "-q", "origin", "HEAD:refs/heads/target")
    job = Job(tmp_path / "job", origin, base, github, event=event)
    assert job.given["BASE"] == base
    job.run("review")
    assert job.run("comment") == "comment created\n"
    job.run("check")
    assert "**1 of 2 applications changed.**" in github.comments[0].body
    assert github.fetched == []


def test_a_checkout_without_the_base_fetches_it_or_says_what_to_set(
    repository: Shell, origin: Path, github: GitHub, tmp_path: Path
) -> None:
    base = cheaper(repository)
    job = Job(tmp_path / "job", origin, base, github, depth=1)
    assert github.fetched
    assert job.said.startswith("::error::")
    assert "fetch-depth: 2" in job.said
    job.run("review", 2)
    job.run("check", 2)
    git(job.folder, "remote", "set-url", "origin", f"file://{origin}")  # GitHub gives out any commit by its name
    assert job.find_base() == ""
    job.run("review")
    job.run("check")
    # Neither needs a base: what a push, or a merge queue, checks out.
    job.given["BASE"] = ""
    job.run("check")
    # The head of the pull request instead of the merge commit, and a head that is a merge itself.
    for ref in (
        job.head,
        git(origin, "commit-tree", f"{job.head}^{{tree}}", "-p", job.head, "-p", base, "-m", "merge"),
    ):
        git(origin, "update-ref", "refs/heads/main", ref)
        git(job.folder, "fetch", "-q", "--unshallow" if ref == job.head else "-q", "origin", "main")
        git(job.folder, "checkout", "-q", ref)
        job.given |= {"BASE": base, "HEAD": ref}
        job.find_base()
        assert job.given["BASE"] == base


@pytest.mark.parametrize("reachable", [True, False])
def test_the_head_of_a_branch_in_a_shallow_clone_is_deepened_until_it_meets_the_base(
    repository: Shell, origin: Path, github: GitHub, tmp_path: Path, reachable: bool
) -> None:
    """Where it may not fetch, comment and check say that others' changes are in them."""
    start = cheaper(repository)
    git(repository.folder, "checkout", "-q", start)
    repository.neighbour("other", repository.read("specs/demo.yaml").replace("name: demo", "name: other"))
    base = commit(repository, "of others")
    git(repository.folder, "push", "-q", "origin", "HEAD:refs/heads/target")
    job = Job(tmp_path / "job", origin, base, github, depth=1)
    for one in (job.head, base):
        git(job.folder, "fetch", "-q", "--depth=1", f"file://{origin}", one)
    git(job.folder, "checkout", "-q", job.head)
    if reachable:
        git(job.folder, "remote", "set-url", "origin", f"file://{origin}")
    job.given |= {"BASE": base}
    job.find_base()
    assert job.given["BASE"] == base
    job.run("review")
    assert ("Not only this change" in job.summary) != reachable
    assert "down" not in job.summary
    if reachable:
        assert "**1 of 1 application changed.**" in job.summary
        job.run("check")


def test_two_calls_in_one_pull_request_have_two_comments(
    repository: Shell, origin: Path, github: GitHub, tmp_path: Path
) -> None:
    base = cheaper(repository)
    first = Job(tmp_path / "first", origin, base, github)
    second = Job(tmp_path / "second", origin, base, github, paths="specs/demo.yaml")
    for done in ("created", "updated"):
        for job in (first, second):
            job.run("review")
            assert job.run("comment") == f"comment {done}\n"
    assert [one.body for one in github.comments] == [
        mark_of(paths) + one.summary.split(MARK)[-1] for paths, one in (("specs", first), ("specs/demo.yaml", second))
    ]


def test_a_comment_of_others_is_left_alone_whatever_it_begins_with(
    repository: Shell, origin: Path, github: GitHub, tmp_path: Path
) -> None:
    github.add("somebody", f"{mark_of('specs')}\nforged")
    github.add("bot", "from another action")
    github.add("bot", f"I quote: {mark_of('specs')}")
    before = [one.body for one in github.comments]
    job = Job(tmp_path / "job", origin, cheaper(repository), github)
    job.run("review")
    assert job.run("comment") == "comment created\n"
    assert [one.body for one in github.comments] == [*before, job.comment]


def test_of_two_jobs_that_begin_at_once_one_comment_stays(
    repository: Shell, origin: Path, github: GitHub, tmp_path: Path
) -> None:
    job = Job(tmp_path / "job", origin, cheaper(repository), github)
    job.run("review")
    github.meanwhile = lambda: github.add("bot", f"{mark_of('specs')}\nof the other job")
    assert job.run("comment") == "comment created\n"
    assert [one.body for one in github.comments] == [job.comment]


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
    earlier = github.add("bot", f"{mark_of('specs')}\nall is well")
    repository.write("offers.csv", repository.read("offers.csv").replace("0.40", "0.41"))
    pushed(repository, "another catalog than the lock's")
    job = Job(tmp_path / "job", origin, base, github)
    job.run("review")
    job.run("comment")
    assert (
        "**cannot be compiled**: demo: the catalog offers.csv is not the one that specs/demo.lock pins" in earlier.body
    )
    assert job.comment == earlier.body
    job.run("check", 3)
    job.given |= {"BASE": "0" * 40}
    job.run("review", 2)
    job.run("comment")
    assert "fogspec diff ended with exit code 2" in earlier.body
    job.run("check", 2)


def test_hostile_texts_stay_texts_on_the_way_to_the_api(github: GitHub, tmp_path: Path) -> None:
    text = MARK + "\n" + "\n".join(one.encode("utf-8", "replace").decode() for one in HOSTILE)
    (tmp_path / "review.md").write_text(text, newline="")
    given = {
        **github.environment(),
        "PATHS": "",
        "PULL_REQUEST": "7",
        "ACTION": str(ROOT),
        "RUNNER_TEMP": str(tmp_path),
    }
    assert run_step("comment", tmp_path, **given).returncode == 0
    assert github.comments[0].body == (tmp_path / "review.md").read_text().replace(MARK, mark_of(""), 1)
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
