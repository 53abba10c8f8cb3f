"""The gate: green if and only if `apply` would deploy what is committed, and in agreement with the other verbs.

What is edited by hand: `test_tampering`.
"""

import dataclasses
import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.results import remove
from tests.support.running import Shell, copied, measure, project, shell  # noqa: F401

AT = ("--catalog", "offers.csv")
MANIFEST = "compiled/demo/manifest.yaml"


def git(shell: Shell, *words: str) -> None:
    who = ["-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false"]
    subprocess.run(["git", *who, *words], cwd=shell.folder, check=True, capture_output=True)


@pytest.fixture
def repo(shell: Shell) -> Shell:
    """A committed application with a lock, results and a manifest."""

    def fill(made: Shell) -> None:
        project(made)
        made("lock", *AT)
        made("compile", *AT)
        measure(made)
        made("compile", *AT)
        git(made, "init", "-q")
        git(made, "add", "-A")
        git(made, "commit", "-qm", "all")

    copied(shell, "a repository with lock and manifest", fill)
    return shell


def replaced(path: str, old: str, new: str) -> Callable[[Shell], None]:
    def change(shell: Shell) -> None:
        text = shell.read(path)
        changed = re.sub(old, new, text, count=1, flags=re.MULTILINE)
        assert changed != text, (path, old)
        shell.write(path, changed)

    return change


def without(path: str) -> Callable[[Shell], None]:
    return lambda shell: (shell.folder / path).unlink()


def task_of(shell: Shell) -> str:
    return next(str(one.relative_to(shell.folder)) for one in sorted(shell.folder.glob("compiled/demo/tasks/*")))


VERBS = {
    "check": ("check",),
    "since": ("check", "--since", "HEAD"),
    "diff": ("diff", "--since", "HEAD"),
    "apply": ("apply", MANIFEST, "--dry-run"),
}


def codes(shell: Shell) -> dict[str, int]:
    return {name: shell.judged(*words).code for name, words in VERBS.items()}


def test_what_is_committed_passes_all(repo: Shell) -> None:
    assert codes(repo) == dict.fromkeys(VERBS, 0)
    assert "ok    demo  manifest verified" in repo("check").out
    assert "--    demo  not judged" in repo("check", "--since", "HEAD").out


def test_a_manifest_that_a_change_takes_away_is_missed(repo: Shell) -> None:
    (repo.folder / MANIFEST).unlink()
    said = repo("check", code=3)
    assert f"{MANIFEST}: it is committed at the base and missing now" in said.out
    git(repo, "commit", "-qam", "taken away")
    assert "missing now" in repo("check", "--since", "HEAD~1", code=3).out


def test_what_no_spec_has_any_more_is_named(repo: Shell) -> None:
    (repo.folder / "specs/demo.yaml").rename(repo.folder / "demo.txt")
    repo.write("specs/other.yaml", (repo.folder / "demo.txt").read_text().replace("name: demo", "name: other"))
    said = repo("check", code=3).out
    assert "compiled/demo: no spec has an application of this name" in said
    assert "results/demo: no spec has an application of this name" in said
    assert "ok    other  not compiled: nothing to deploy" in said


def test_the_last_application_may_go(repo: Shell) -> None:
    git(repo, "rm", "-rq", "specs", "compiled", "results")
    said = repo("check")
    assert "fogspec down demo" in said.err


def write_invalid(repo: Shell) -> None:
    """Write a second spec, with a misspelled field."""
    invalid = repo.read("specs/demo.yaml").replace("name: demo", "name: bad").replace("alpha", "alfa")
    repo.neighbour("bad", invalid)


def test_an_invalid_spec_does_not_hide_the_others(repo: Shell) -> None:
    write_invalid(repo)
    said = repo("check", code=1)
    assert "ok    demo" in said.out
    assert "FAIL  specs/bad/bad.yaml: invalid" in said.out
    assert said.out.endswith("1 of 1 application was judged: none failed, 1 file is invalid\n")
    assert "specs/bad/bad.yaml:" in said.err
    said = json.loads(repo("check", "-o", "json", code=1).out)
    assert (said["passed"], said["invalid"]) == (False, ["specs/bad/bad.yaml"])


def test_specs_that_cannot_be_read_are_not_removed_ones(repo: Shell, tmp_path: Path) -> None:
    (repo.folder / "environments").symlink_to(tmp_path)
    for words in (("check",), ("check", "--since", "HEAD"), ("diff", "--since", "HEAD"), ("status",)):
        said = repo(*words, code=1)
        assert "environments: it is a link" in said.err
        assert "no longer deployed" not in said.out
        assert "--prune" not in said.err


def test_an_invalid_spec_does_not_hide_the_others_in_status(repo: Shell) -> None:
    write_invalid(repo)
    said = repo("status", code=1)
    assert "demo\n  plan      fresh" in said.out
    assert "specs/bad/bad.yaml:" in said.err
    assert json.loads(repo("status", "-o", "json", code=1).out)[0]["name"] == "demo"


def test_only_what_changed_since_the_base_is_judged(repo: Shell) -> None:
    both = ("specs", "other/specs")
    repo.write("other/specs/second.yaml", repo.read("specs/demo.yaml").replace("name: demo", "name: second"))
    repo.write("other/specs/work.py", "print('work')\n")
    said = json.loads(repo("check", *both, "--since", "HEAD", "-o", "json").out)
    assert [one["name"] for one in said["applications"]] == ["second"]
    assert said["not_judged"] == ["demo"]
    said = repo("check", *both, "--since", "HEAD").out
    assert "--    demo    not judged: nothing that concerns it changed since HEAD" in said
    assert said.endswith("1 of 2 applications was judged: none failed\n")
    repo.write("specs/work.py", "print('other')\n")
    said = repo("check", "--since", "HEAD", code=3)
    assert "work.py changed" in said.out, "a file that machines are sent"


@pytest.mark.parametrize("name", ["offers.csv", "specs/demo.lock", "tools.py", "policies/mine.schema.json"])
def test_what_belongs_to_no_application_alone_concerns_all(repo: Shell, name: str) -> None:
    before = repo.read(name) if (repo.folder / name).exists() else "{}"
    repo.write(name, before + "\n")
    said = json.loads(repo("check", "--since", "HEAD", "-o", "json", code=None).out)
    assert [one["name"] for one in said["applications"]] == ["demo"]


def test_a_page_concerns_no_application(repo: Shell) -> None:
    repo.write("README.md", "More words.\n")
    said = json.loads(repo("check", "--since", "HEAD", "-o", "json").out)
    assert (said["applications"], said["not_judged"]) == ([], ["demo"])


def test_a_changed_price_list_fails_it_since_the_base_too(repo: Shell) -> None:
    repo.write("offers.csv", repo.read("offers.csv").replace("0.10", "0.11"))
    git(repo, "commit", "-qam", "prices")
    said = repo("check", "--since", "HEAD~1", code=3).out
    assert "the catalog offers.csv is not the one that specs/demo.lock pins" in said
    assert "fix: fogspec lock specs/demo.yaml --upgrade catalog" in said


def test_annotations_name_the_spec_and_the_fix(repo: Shell) -> None:
    replaced(MANIFEST, "instance: .*", "instance: a.huge")(repo)
    said = repo("check", "-o", "github", code=3).out
    assert "FAIL  demo" in said
    (line,) = [line for line in said.splitlines() if line.startswith("::error ")]
    assert line.startswith("::error file=specs/demo.yaml,line=1,")
    assert line.endswith("fogspec compile specs/demo.yaml")


def test_a_base_that_is_not_in_the_clone_is_said(repo: Shell) -> None:
    said = repo("check", "--since", "f" * 40, code=2)
    assert "git fetch origin" in said.err


HOOK = """#!/bin/sh
exec {python} -m fogspec check --since HEAD > "{said}" 2>&1
"""


def test_half_a_commit_is_said_also_in_a_linked_worktree(repo: Shell) -> None:
    """In git's own hook, of `commit`, `commit -a` and `commit PATH`, which have an index of their own each."""
    said = repo.folder.parent / "said"
    hook = repo.write(".git/hooks/pre-commit", HOOK.format(python=sys.executable, said=said))
    hook.chmod(0o755)
    tree = dataclasses.replace(repo, folder=repo.folder.with_name("linked"))
    git(repo, "worktree", "add", "-q", str(tree.folder), "-b", "linked")
    for limit_s, one in ((20, repo), (30, tree)):
        for words, left in ((("specs",), True), (("-a",), False)):
            replaced("specs/demo.yaml", "latency: [0-9]+s", f"latency: {limit_s + left}s")(one)
            one("compile")
            git(one, "commit", "-qm", "half or whole", *words)
            assert ("apply deploys what is committed\n" in said.read_text()) != left
            assert (
                "apply deploys what is here; not part of the commit yet: compiled/demo/" in said.read_text()
            ) == left
            git(one, "commit", "-qam", "the rest", "--allow-empty")
    git(repo, "worktree", "remove", "--force", str(tree.folder))


def test_policies_and_committed_live_state_fail_it(repo: Shell) -> None:
    policy = {"properties": {"spec": {"properties": {"infra": {"const": ["gcp/r1"]}}}}}
    repo.write("policies/place.application.schema.json", json.dumps(policy))
    found = repo("check", code=None)
    assert found.code != 0
    (repo.folder / "policies/place.application.schema.json").unlink()
    repo.write(".fogspec/demo/deployment.yaml", "machines: []\n")
    git(repo, "add", "-f", ".fogspec")
    assert "git tracks live state" in repo("check", code=3).out


def test_what_git_could_not_merge_is_said(repo: Shell) -> None:
    text = repo.read("results/demo/aws-r1-a-small.yaml")
    line = next(one for one in text.splitlines() if one.startswith("  spent"))
    damaged = text.replace(line, f"<<<<<<< HEAD\n{line}\n=======\n{line}1\n>>>>>>> other")
    repo.write("results/demo/aws-r1-a-small.yaml", damaged)
    assert "a merge conflict must be resolved" in repo("check", code=3).out


def test_parameter_files_beside_specs_are_no_specs(repo: Shell) -> None:
    repo.write("specs/planner.params.yaml", "planner:\n  ros__parameters: {rate: 10}\n")
    repo("validate", "specs")


def test_init_tells_git_what_is_generated_and_overwrites_nothing(shell: Shell) -> None:
    shell("init", "first")
    assert not (shell.folder / ".gitignore").exists(), "no repository"
    git(shell, "init", "-q")
    shell.write(".gitignore", "build/\n")
    said = shell("init", "second").out
    assert shell.read(".gitignore") == "build/\n"
    assert ".gitignore: is there already, and lacks: .fogspec/" in said
    assert "compiled/** -text linguist-generated -merge" in shell.read(".gitattributes")
    assert "linguist" not in shell("init", "third").out


def test_an_image_that_is_not_pinned_fails_it_as_apply_refuses_it(repo: Shell) -> None:
    def with_image(image: str) -> None:
        replaced("specs/demo.yaml", "  probe:", f"  ros: {{distro: jazzy, image: {image}}}\n  probe:")(repo)
        remove(repo.folder / "results/demo")
        repo("compile", *AT)
        measure(repo)
        repo("compile", *AT)

    with_image("ros:jazzy")
    said = repo("check", code=3).out
    assert "FAIL  demo  manifest verified" in said
    assert "image ros:jazzy is not pinned, so that apply refuses it: fogspec lock specs/demo.yaml, then fogspec" in said
    assert "is not pinned" in repo("apply", MANIFEST, "--dry-run", code=5).err
    assert "**Image not pinned**, so that `apply` refuses it: demo" in repo("diff", "--since", "HEAD", "--markdown").out
    git(repo, "add", "-A")
    assert "apply --resolve-image deploys what is committed" in repo("check", "--resolve-image").err
    assert '{code: image_unpinned, image: "ros:jazzy"}' in repo.read("compiled/demo/plan.yaml")
    replaced("specs/demo.yaml", "  ros: {distro: jazzy, image: ros:jazzy}\n", "")(repo)
    with_image(f"ros@sha256:{'0' * 64}")
    git(repo, "add", "-A")
    assert "apply deploys what is committed" in repo("check").err
    assert "not pinned" not in repo("diff", "--since", "HEAD", "--markdown").out
    assert "is not pinned" not in repo.read("compiled/demo/plan.yaml")


POINTER = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'4d' * 32}\nsize 734003200\n"


@pytest.mark.parametrize("what", ["results/demo/*.yaml", "offers.csv", "specs/work.py"])
def test_what_git_lfs_has_not_fetched_is_never_to_be_measured_again(repo: Shell, what: str) -> None:
    sorted(repo.folder.glob(what))[0].write_text(POINTER)
    for words in (
        ("compile", *AT),
        ("check",),
        ("status",),
        ("bench", "demo", "--dry-run"),
        ("apply", "demo", "--dry-run"),
    ):
        ended = repo(*words, code=None)
        said = ended.out + ended.err
        assert "again" not in said, said
        assert "run 'git lfs pull'" in said, said
        if words == ("status",):
            files = {"specs/work.py": "files     damaged  specs/work.py", "results/demo/*.yaml": "results   damaged"}
            assert files.get(what, "") in said, said
