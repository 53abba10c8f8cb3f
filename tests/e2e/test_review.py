"""The review of a change in a real git repository, and the steps of the GitHub Action, run as they are written."""

import dataclasses
import json
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from fogspec.audit.comment import LONGEST, markdown
from fogspec.audit.freshness import status
from fogspec.audit.git import Repository
from fogspec.audit.review import Base, Review, Whole, review
from fogspec.compile.compiler import try_compile
from fogspec.compile.inputs import Inputs
from fogspec.spec.rules.policies import Policies
from tests.support.deployed import Deployed, app, tiny  # noqa: F401
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


def test_what_was_never_compiled_and_did_not_change_is_not_called_changed(repository: Shell) -> None:
    repository.write("specs/other.yaml", repository.read("specs/demo.yaml").replace("name: demo", "name: other"))
    said = repository("review", "HEAD").out
    assert "- **1 of 2 applications changed.**" in said, "it is new"
    assert "### other: no manifest" in said
    commit(repository, "a spec")
    said = repository("review", "HEAD").out
    assert "- **No application changes.**" in said
    assert "- No benchmark needed." in said
    assert "Unchanged, without a manifest: other." in said
    change(repository, "alpha: 0.5", "alpha: 0.4", "specs/other.yaml")
    assert "### other: no manifest" in repository("review", "HEAD").out


def test_another_machine_with_its_price_and_why(repository: Shell) -> None:
    base = git(repository.folder, "rev-parse", "HEAD")
    change(repository, "alpha: 0.5", "alpha: 0")
    repository("compile", "specs/demo.yaml")
    commit(repository, "cheaper")
    said = repository("review", f"{base}..HEAD", "--picture-base", "https://example.org/raw/abc", "--exit-code").out
    assert "### demo: a.large in aws/r1 -\\> a.small in aws/r1" in said
    assert "| machine | $0.40/h | $0.10/h | -75% |" in said
    assert "| `spec.objective.alpha` | 0\\.5 | 0\\.0 |" in said.partition("<details>")[0]
    assert "**1 of 1 application changed.** All machines: $292/month before, $73.00/month after (-75%)." in said
    assert "`apply` starts a new machine, and ends the old one once the new one answers" in said
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
    assert "- runs on a.large in aws/r1, $0.40/h, $292/month" in said
    assert "`fogspec down demo` ends it" in said
    assert "Unchanged, without a manifest: other." in said
    git(repository.folder, "rm", "-q", "-r", "specs")
    assert "### demo: no longer deployed" in repository("review", base).out


def test_warnings_are_new_or_folded_away(repository: Shell) -> None:
    change(repository, "alpha: 0.5", "alpha: 0")
    change(repository, "latency: 10s", "latency: 1s")
    repository("compile", "specs/demo.yaml")
    said = repository("review", "HEAD").out
    new, _, old = said.partition(", as before</summary>")
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


def test_a_machine_that_stays_and_one_that_is_replaced(repository: Shell) -> None:
    change(repository, "latency: 10s", "latency: 9s")
    repository("compile", "specs/demo.yaml")
    said = repository("review", "HEAD").out
    assert "On `apply`: 1 stays in place." in said
    assert "`apply` keeps the machine: it is given nothing new." in said
    # Another limit is nothing new for the machine, the node's own code is.
    repository.write("specs/work.py", "print('other work')\n")
    repository("lock", *AT)
    repository("compile", "specs/demo.yaml", code=None)
    said = repository("review", "HEAD").out
    assert re.search(r"\| `specs/work\.py` \| sha256:[0-9a-f]{12} \| sha256:[0-9a-f]{12} \|", said), said
    assert "On `apply`: 1 replaces the machine." in said
    assert "### demo: a.large in aws/r1 is replaced by another one" in said


def test_what_must_be_measured_first_and_what_that_costs(repository: Shell) -> None:
    change(repository, "cmd: [python3, work.py]", "cmd: [python3, work.py, fast]")
    repository("compile", "specs/demo.yaml", code=None)
    said = repository("review", "HEAD").out
    found = re.search(r"\*\*To measure first\*\*: (\d+) samples, at most (\$[\d.]+)\.", said)
    assert found, said
    assert f"- **to measure first**: {found[1]} samples, at most {found[2]}: `fogspec bench specs/demo.yaml" in said
    assert "- **Not fresh**, so that `apply` refuses it: demo." in said
    data = json.loads(repository("review", "HEAD", "-o", "json").out)
    assert data["total"]["to_measure"] == int(found[1])
    assert f"${data['total']['measuring_usd_at_most']:.4f}".startswith(found[2])


def test_values_for_policy_engines(repository: Shell) -> None:
    base = git(repository.folder, "rev-parse", "HEAD")
    change(repository, "alpha: 0.5", "alpha: 0")
    repository("compile", "specs/demo.yaml")
    data = json.loads(repository("review", base, "-o", "json").out)
    assert data["base"] == base
    assert data["total"] == {
        "before_usd_per_month": 292.0, "after_usd_per_month": 73.0, "to_measure": 0, "measuring_usd_at_most": 0.0,
        "policies_broken": 0,
    }  # fmt: skip
    (one,) = data["applications"]
    assert (one["name"], one["changed"], one["fresh"], one["rollout"]) == ("demo", True, True, "replace")
    assert one["before"]["instance"] == "a.large"
    assert one["after"]["usd_per_1000_requests"] > 0
    assert one["after"]["latency"]["limit_s"] == 10
    assert {"field": "spec.objective.alpha", "before": 0.5, "after": 0.0} in one["inputs"]
    documented = (ROOT / "docs/howto/editor-and-ci.md").read_text("utf-8")
    keys = {*data, *data["total"], *one, *one["after"], *one["after"]["latency"], *one["policies"], *one["warnings"]}
    assert not {key for key in keys if f"`{key}`" not in documented}


def many(reviewed: Review, number: int) -> list[Review]:
    """As many reviews as there may be in a large repository, under names of their own."""
    found = []
    for count in range(number):
        layout = dataclasses.replace(reviewed.difference.layout, name=f"application-{count:03}")
        found.append(dataclasses.replace(reviewed, difference=dataclasses.replace(reviewed.difference, layout=layout)))
    return found


def test_a_comment_is_as_long_as_github_takes_it(repository: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    change(repository, "alpha: 0.5", "alpha: 0")
    monkeypatch.chdir(repository.folder)
    repository("compile", "specs/demo.yaml")
    base = Base.of(Repository(), git(repository.folder, "rev-parse", "HEAD"))
    (inputs,) = Inputs.load(["specs/demo.yaml"], audit=True)
    one = review(status(inputs, try_compile(inputs)), base, Policies())
    stale = dataclasses.replace(one, fresh=False, refused="over the budget " * 20)
    for number in (1, 20, 30, 300, 3000):
        reviews = many(one, number)
        reviews[-1] = dataclasses.replace(
            stale, difference=dataclasses.replace(stale.difference, layout=reviews[-1].difference.layout)
        )
        text = markdown(Whole(base.commit, reviews))
        assert len(text) <= LONGEST
        shown = text.count("\n### application-")
        left_out = re.search(
            r"^([\d,]+) applications? more (?:is|are) left out for length: `fogspec review", text, re.MULTILINE
        )
        assert shown + (int(left_out[1].replace(",", "")) if left_out else 0) == number
        assert (left_out is None) == (number <= 20)
        # What stops the merge is not what is left out.
        assert f"\n### application-{number - 1:03}: " in text
        assert f"**{number} of {number:,} application" in text
        assert text.count("<details>") == text.count("</details>")
    tiny = markdown(Whole(base.commit, many(one, 300)), longest=3000)
    assert len(tiny) <= 3000
    assert "| and " in tiny


def test_the_hooks_run_what_they_say(repository: Shell) -> None:
    hooks = {hook["id"]: hook for hook in YAML(typ="safe", pure=True).load(ROOT / ".pre-commit-hooks.yaml")}
    assert hooks.keys() == {"fogspec-validate", "fogspec-ci"}
    for hook in hooks.values():
        words = hook["entry"].split()[1:]
        names = [] if hook.get("pass_filenames") is False else ["specs/demo.yaml"]
        repository(*words, *names)
    # A commit of one application is judged by that application alone; without a commit yet, all are judged.
    repository.write("specs/other.yaml", repository.read("specs/demo.yaml").replace("name: demo", "name: other"))
    commit(repository, "another one")
    change(repository, "alpha: 0.5", "alpha: 0.6", "specs/other.yaml")
    words = hooks["fogspec-ci"]["entry"].split()[1:]
    assert "1 not changed since HEAD" in repository(*words, *AT).out
    change(repository, "alpha: 0.5", "alpha: 0.6")
    repository(*words, *AT, code=3)
    shutil.rmtree(repository.folder / ".git")
    git(repository.folder, "init", "-q")
    assert "2 applications: 1 failed" in repository(*words, *AT, code=3).out
    for name in ("specs/demo.yaml", "compiled/demo/manifest.yaml", "results/demo.yaml", "fogspec.lock"):
        assert re.search(hooks["fogspec-ci"]["files"], name)


def test_what_is_said_of_the_machine_is_what_apply_does(tiny: Deployed) -> None:
    (tiny.folder / ".gitignore").write_text(".fogspec/\n")
    git(tiny.folder, "init", "-q")

    def commit_all() -> None:
        git(tiny.folder, "add", "-A")
        git(tiny.folder, "commit", "-q", "-m", "deployed")

    commit_all()
    tiny.apply()
    (first,) = tiny.names()
    tiny.change("latency: 1s", "latency: 500ms")
    tiny("compile")
    assert "On `apply`: 1 stays in place." in tiny("review").stdout
    assert "the machine stays, under the new manifest" in tiny.apply().stdout
    assert tiny.names() == [first]
    commit_all()
    assert "Unchanged and fresh: tiny." in tiny("review").stdout
    assert "no changes" in tiny.apply().stdout
    tiny.change("cpus: 1..2", "cpus: 2..2")
    tiny("compile")
    assert "On `apply`: 1 replaces the machine." in tiny("review").stdout
    tiny.apply()
    assert len(tiny.names()) == 1
    assert tiny.names() != [first]
    tiny("down", "tiny")


def test_a_deleted_spec_is_no_longer_deployed_though_its_compiled_files_are_left(repository: Shell) -> None:
    repository.write("specs/other.yaml", repository.read("specs/demo.yaml").replace("name: demo", "name: other"))
    base = commit(repository, "two")
    git(repository.folder, "rm", "-q", "specs/demo.yaml")
    said = repository("review", base, *AT).out
    assert "### demo: no longer deployed" in said
    assert "All machines: $292/month before, $0/month after" in said
    assert "no longer deployed" not in repository("review", base, "specs/other.yaml", *AT).out
    after = commit(repository, "deleted")
    assert "no longer deployed" not in repository("review", after, *AT).out


def test_a_damaged_manifest_is_neither_gone_nor_replaces_a_machine(repository: Shell) -> None:
    change(
        repository, "kind: DeploymentManifest", "<<<<<<< HEAD\nkind: DeploymentManifest", "compiled/demo/manifest.yaml"
    )
    said = repository("review", "HEAD").out
    assert "### demo: the manifest is damaged" in said
    assert "All machines: $292/month before, $292/month after" in said
    assert "replace" not in said
    assert "- **manifest is stale**" in said
    assert "| none" not in said
    assert "why: the manifest is damaged" in repository("diff").out
    assert "FAIL  demo  manifest not verified" in repository("ci", code=3).out


def test_stages_agree_with_their_verb(repository: Shell) -> None:
    change(repository, "requests: 20", "requests: 30")
    change(repository, "work.py", "./work.py")
    said = repository("review", "HEAD").out
    assert "- **results are stale**" in said
    assert "- **models are stale**" in said


@pytest.mark.parametrize("damage", [lambda text: text[:900], lambda text: text.replace("0.", "1.", 1), lambda _: "\0"])
def test_damaged_results_hide_no_other_application(repository: Shell, damage: Callable[[str], str]) -> None:
    repository.write("specs/other.yaml", repository.read("specs/demo.yaml").replace("name: demo", "name: other"))
    repository("lock", *AT)
    repository("compile")
    base = commit(repository, "two")[:12]
    repository.write("results/demo.yaml", damage(repository.read("results/demo.yaml")))
    for restore in ("HEAD", base):  # damaged on disk, then damaged in the commit
        command = f"git checkout {restore} -- results/demo.yaml"
        said = repository("review", base, code=1).out
        assert "- **results are damaged**: results/demo.yaml:" in said
        assert command in said
        assert "other" in said
        assert "No benchmark needed" not in said
        data = json.loads(repository("review", base, "-o", "json", code=1).out)["applications"]
        assert [(one["name"], one["fresh"]) for one in data] == [("demo", False), ("other", False)]
        assert [one["stages"][0]["state"] for one in data] == ["damaged", "fresh"]
        said = repository("status", code=1).out
        assert "results   damaged  results/demo.yaml" in said
        assert "  spent     unknown" in said
        assert "other\n  plan      fresh" in said
        said = repository("diff", code=1).out
        assert "demo: cannot be compiled to a manifest now: results/demo.yaml is damaged" in said
        assert "no benchmark needed" not in said
        assert "other: cannot be compiled to a manifest now: nothing is measured yet" in said
        said = repository("ci", "--since", base, code=3).out
        assert command in said
        assert "FAIL  demo" in said
        assert command in repository("ci", "--since", base, "-j", "2", code=3).out
        if restore == "HEAD":
            commit(repository, "damaged")
    # Without a base, the commit before the damage has them.
    for verb, code in (("status", 1), ("menu", 1), ("verify", 3), ("compile", 1)):
        assert "~1' -- results/demo.yaml" in repository(verb, "demo", code=code).err
    subprocess.run(shlex.split(command), cwd=repository.folder, check=True, capture_output=True)
    assert "ok    demo" in repository("ci").out


def test_a_damaged_lock_is_said_of_each_application(repository: Shell) -> None:
    whole = repository.read("fogspec.lock")
    repository.write("fogspec.lock", f"<<<<<<< HEAD\n{whole}")
    restore = "git checkout HEAD -- fogspec.lock"
    said = repository("review", "HEAD", code=1).out
    assert "- **lock is damaged**: fogspec.lock:" in said
    assert restore in said
    assert "All machines: $292/month before, $292/month after" in said
    assert restore in repository("status", code=1).out
    assert restore in repository("diff", code=1).out
    assert restore in repository("ci", code=3).out
    for words in (["verify", "demo"], ["apply", "demo", "--dry-run"], ["compile", "demo"], ["bench", "demo"]):
        assert "fogspec.lock" in repository(*words, code=1).err


def test_a_catalog_that_is_not_the_locked_one_is_said_of_its_application(repository: Shell) -> None:
    repository.write("offers.csv", repository.read("offers.csv").replace("0.4", "0.5", 1))
    refused = "cannot be compiled: demo: the catalog offers.csv is not the one that fogspec.lock pins"
    assert refused.partition(": ")[2] in repository("review", "HEAD").out
    assert refused in repository("status").out
    assert refused in repository("ci", code=3).out
    assert "upgrade catalog" in repository("compile", "demo", code=3).err
