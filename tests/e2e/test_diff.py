"""The difference of a change to a commit of a real git repository, as text, Markdown and JSON, and the hooks."""

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

from fogspec.base.text import markdown as md
from fogspec.base.units import shown_duration
from fogspec.compile.inputs import Inputs
from fogspec.language.rules.policies import Policies
from fogspec.language.warned import sentence
from fogspec.results.io import read_results_folder
from fogspec.results.schema import LatencySummary
from fogspec.review.comment import LONGEST, MARK, markdown
from fogspec.review.deployed import Deployed as Manifest
from fogspec.review.diff import Difference, Whole, difference
from fogspec.review.git import Base
from fogspec.review.github_comment import mark_of
from tests.support.deployed import Deployed, app, tiny  # noqa: F401
from tests.support.results import remove, write
from tests.support.running import CATALOG, Shell, copied, measure, project, shell  # noqa: F401

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

    def fill(made: Shell) -> None:
        project(made)
        made("lock", *AT)
        made("compile", "specs/demo.yaml")
        measure(made)
        made("compile", "specs/demo.yaml")
        git(made.folder, "init", "-q")
        commit(made, "first")

    copied(shell, "a repository with a lock", fill)
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
    assert "Not affected: demo." in repository("diff", "--markdown", "--since", "HEAD").out


def test_what_was_never_compiled_and_did_not_change_is_not_called_changed(repository: Shell) -> None:
    repository.neighbour("other", repository.read("specs/demo.yaml").replace("name: demo", "name: other"))
    said = repository("diff", "--markdown", "--since", "HEAD").out
    assert "- **1 of 2 applications changed.**" in said, "it is new"
    assert "### other: no manifest" in said
    commit(repository, "a spec")
    said = repository("diff", "--markdown", "--since", "HEAD").out
    assert "- **No application changes.**" in said
    assert "- No benchmark needed." in said
    assert "Not affected: demo, other." in said
    repository.write("notes.txt", "which is no application's own, so that all are compared")
    said = repository("diff", "--markdown", "--since", "HEAD").out
    assert "Unchanged and fresh: demo." in said
    assert "Unchanged, without a manifest: other." in said
    change(repository, "alpha: 0.5", "alpha: 0.4", "specs/other/other.yaml")
    assert "### other: no manifest" in repository("diff", "--markdown", "--since", "HEAD").out


def test_another_machine_with_its_price_and_why(repository: Shell) -> None:
    base = git(repository.folder, "rev-parse", "HEAD")
    change(repository, "alpha: 0.5", "alpha: 0")
    repository("compile", "specs/demo.yaml")
    commit(repository, "cheaper")
    said = repository(
        "diff", "--markdown", "--since", f"{base}..HEAD", "--picture-base", "https://example.org/raw/abc"
    ).out
    assert "### demo: a.large in aws/r1 -\\> a.small in aws/r1" in said
    assert "| machine | $0.40/h | $0.10/h | -75% |" in said
    assert "| `spec.objective.alpha` | 0\\.5 | 0\\.0 |" in said.partition("<details>")[0]
    assert "**1 of 1 application changed.** All machines: $332/month before, $113/month after (-66%)." in said
    assert "`apply` starts a new machine, and ends the old one once the new one answers" in said
    assert "![menu of demo](https://example.org/raw/abc/compiled/demo/menu.svg)" in said
    assert "everything is fresh; no benchmark needed" in said


def test_what_is_not_fresh_is_said(repository: Shell) -> None:
    change(repository, "alpha: 0.5", "alpha: 0")
    commit(repository, "forgot to compile")
    ended = repository("diff", "--markdown", "--since", "HEAD~1")
    assert "### demo: the manifest is not fresh" in ended.out
    assert "**menu and manifest are stale**: spec.objective.alpha: 0" in ended.out
    assert "**to do**: `fogspec compile specs/demo.yaml`, and commit what it writes" in ended.out


def test_an_application_that_is_gone_and_one_that_stays(repository: Shell) -> None:
    other = repository.read("specs/demo.yaml").replace("name: demo", "name: other")
    repository.neighbour("other", other)
    base = commit(repository, "two")
    git(repository.folder, "rm", "-q", "-r", "specs/demo.yaml", "compiled/demo")
    said = repository("diff", "--markdown", "--since", base).out
    assert "### demo: no longer deployed" in said
    assert "- runs on a.large in aws/r1, $0.40/h, $332/month with disk and address" in said
    assert "`fogspec down demo` ends it" in said
    assert "Not affected: other." in said
    assert "demo: no longer deployed; a.large in aws/r1 keeps running" in repository("diff", "--since", base).out
    git(repository.folder, "rm", "-q", "-r", "specs")
    assert "### demo: no longer deployed" in repository("diff", "--markdown", "--since", base).out


def test_warnings_are_new_or_folded_away(repository: Shell) -> None:
    change(repository, "alpha: 0.5", "alpha: 0")
    change(repository, "latency: 10s", "latency: 10s, confidence: none")
    repository("compile", "specs/demo.yaml")
    said = repository("diff", "--markdown", "--since", "HEAD").out
    new, _, old = said.partition(", as before</summary>")
    assert "- **warning**: constraints.confidence: none: the probability that " in new
    assert "- curve of latency: " in old


def test_outside_of_a_repository_it_says_what_to_do(shell: Shell) -> None:
    said = shell("diff", "--markdown", "--since", "main", code=2).err
    assert said.startswith(f"error: {shell.folder} is in no git repository")
    assert "fogspec diff compares without git" in said
    git(shell.folder, "init", "-q")
    assert (
        shell("diff", "--markdown", "--since", "HEAD", code=2).err
        == "error: there is no commit HEAD here\n  commit something first\n"
    )


def test_a_new_application_and_one_that_is_not_measured(repository: Shell) -> None:
    repository.neighbour("other", repository.read("specs/demo.yaml").replace("name: demo", "name: other"))
    repository("lock", *AT)
    said = repository("diff", "--markdown", "--since", "HEAD").out
    assert "### other: no manifest" in said
    assert "**compiled/other/plan.yaml**: plan is missing" in said
    (repository.folder / "specs/other/other.yaml").unlink()
    manifest = repository.folder / "compiled/demo/manifest.yaml"
    content = manifest.read_bytes()
    manifest.unlink()
    commit(repository, "without a manifest")
    manifest.write_bytes(content)
    assert "### demo: a new manifest" in repository("diff", "--markdown", "--since", "HEAD").out


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
    said = repository("diff", "--markdown", "--since", "main..HEAD").out
    assert "a.large in aws/r1 stays" in said
    assert "| `expected.latency.limit` | 10s | 9s |" in said


def test_wrong_commits_and_no_repository(repository: Shell) -> None:
    commit(repository, "again") if git(repository.folder, "status", "--porcelain") else None
    assert "no commit" in repository("diff", "--markdown", "--since", "nowhere", code=2).err
    repository("diff", "--markdown", "--since=-x", code=2)
    first = git(repository.folder, "rev-parse", "HEAD")
    change(repository, "latency: 10s", "latency: 9s")
    commit(repository, "later")
    assert "is not what is checked out" in repository("diff", "--markdown", "--since", f"{first}..{first}", code=2).err


def test_a_machine_that_stays_and_one_that_is_replaced(repository: Shell) -> None:
    change(repository, "latency: 10s", "latency: 9s")
    repository("compile", "specs/demo.yaml")
    said = repository("diff", "--markdown", "--since", "HEAD").out
    assert "On `apply`: 1 stays in place." in said
    assert "`apply` keeps the machine: it is given nothing new." in said
    # Another limit is nothing new for the machine, the node's own code is.
    repository.write("specs/work.py", "print('other work')\n")
    repository("lock", *AT)
    repository("compile", "specs/demo.yaml", code=None)
    said = repository("diff", "--markdown", "--since", "HEAD").out
    assert re.search(r"\| `specs/work\.py` \| sha256:[0-9a-f]{12} \| sha256:[0-9a-f]{12} \|", said), said
    assert "On `apply`: 1 replaces the machine." in said
    assert "### demo: a.large in aws/r1 is replaced by another one" in said


@pytest.mark.parametrize(("before", "after"), [("budget: $25", "budget: $30"), ("until: 24h", "until: 30h")])
def test_a_machine_that_is_to_end_otherwise_is_replaced(repository: Shell, before: str, after: str) -> None:
    change(repository, "spec:\n", f"spec:\n  deployment: {{{before}}}\n")
    repository("compile", "specs/demo.yaml")
    commit(repository, "an end")
    change(repository, before, after)
    repository("compile", "specs/demo.yaml")
    assert "On `apply`: 1 replaces the machine." in repository("diff", "--markdown", "--since", "HEAD").out


def test_what_must_be_measured_first_and_what_that_costs(repository: Shell) -> None:
    change(repository, "cmd: [python3, work.py]", "cmd: [python3, work.py, fast]")
    repository("compile", "specs/demo.yaml", code=None)
    said = repository("diff", "--markdown", "--since", "HEAD").out
    found = re.search(r"\*\*To measure first\*\*: (\d+) samples, at most (\$[\d.]+)\.", said)
    assert found, said
    assert f"- **to measure first**: {found[1]} samples, at most {found[2]}: `fogspec bench specs/demo.yaml" in said
    assert "- **Not fresh**, so that `apply` refuses it: demo." in said
    data = json.loads(repository("diff", "--since", "HEAD", "-o", "json").out)
    assert data["total"]["to_measure"] == int(found[1])
    assert f"${data['total']['measuring_usd_at_most']:.4f}".startswith(found[2])


def test_values_for_policy_engines(repository: Shell) -> None:
    base = git(repository.folder, "rev-parse", "HEAD")
    change(repository, "alpha: 0.5", "alpha: 0")
    repository("compile", "specs/demo.yaml")
    data = json.loads(repository("diff", "--since", base, "-o", "json").out)
    assert data["base"] == base
    assert data["total"] == {
        "before_usd_per_month": 332.22, "after_usd_per_month": 113.22, "to_measure": 0, "measuring_usd_at_most": 0.0,
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
    now = json.loads(repository("diff", "-o", "json").out)
    assert (now.keys(), now["total"].keys(), now["base"]) == (data.keys(), data["total"].keys(), None)
    assert now["applications"][0].keys() == one.keys()


def many(one: Difference, number: int) -> list[Difference]:
    """As many differences as there may be in a large repository, under names of their own."""
    layouts = (dataclasses.replace(one.layout, name=f"application-{count:03}") for count in range(number))
    return [dataclasses.replace(one, layout=layout) for layout in layouts]


@pytest.fixture
def cheaper(repository: Shell, monkeypatch: pytest.MonkeyPatch) -> tuple[str, Difference]:
    """A commit, and the difference of an application whose machine is replaced since."""
    change(repository, "alpha: 0.5", "alpha: 0")
    monkeypatch.chdir(repository.folder)
    repository("compile", "specs/demo.yaml")
    base = Base.of("HEAD")
    (inputs,) = Inputs.load(["specs/demo.yaml"], audit=True)
    return base.commit, difference(inputs, base, Policies())


def test_a_comment_is_as_long_as_github_takes_it(cheaper: tuple[str, Difference]) -> None:
    base, one = cheaper
    stale = dataclasses.replace(one, fresh=False, refused="over the budget " * 20)
    for number in (1, 30, 90, 300, 3000):
        found = many(one, number)
        found[-1] = dataclasses.replace(stale, layout=found[-1].layout)
        text = markdown(Whole(base, found))
        assert len(mark_of("specs") + text.removeprefix(MARK)) <= LONGEST
        shown = text.count("\n### application-")
        left_out = re.search(
            r"^([\d,]+) applications? more (?:is|are) left out for length: `fogspec diff --since", text, re.MULTILINE
        )
        assert shown + (int(left_out[1].replace(",", "")) if left_out else 0) == number
        assert (left_out is None) == (number <= 30)
        # What stops the merge is not what is left out.
        assert f"\n### application-{number - 1:03}: " in text
        assert f"**{number:,} of {number:,} application" in text
        assert text.count("<details>") == text.count("</details>")
    tiny = markdown(Whole(base, many(one, 300)), longest=3000)
    assert len(tiny) <= 3000
    assert "| and " in tiny


def test_every_replaced_machine_of_three_hundred_is_named(cheaper: tuple[str, Difference]) -> None:
    base, one = cheaper
    for replaced, longest in (
        (54, ""),
        (300, ""),
        (300, "-of-the-longest-name-that-there-may-be-at-all-in-a-spec@production"),
    ):
        found = [
            dataclasses.replace(other, layout=dataclasses.replace(other.layout, name=f"{other.name}{longest}"))
            for other in many(one, 300)
        ]
        kept = [dataclasses.replace(other, rollout="in place") for other in found[: 300 - replaced]]
        text = markdown(Whole(base, [*kept, *found[300 - replaced :]]))
        assert len(text) <= LONGEST
        assert f"{replaced} replaces the machine" in text
        for other in found[300 - replaced :]:
            assert other.name in text.replace("\\", "")


def test_rows_and_sections_have_one_order_by_weight(cheaper: tuple[str, Difference]) -> None:
    base, one = cheaper
    before = one.before
    assert before is not None
    dearer = Manifest({**before.values, "expected": {**before.part("expected"), "cost": {"month": "$9,999/month"}}})
    found = many(one, 4)
    found[0] = dataclasses.replace(found[0], rollout="in place")
    found[2] = dataclasses.replace(found[2], after=dearer)
    found[3] = dataclasses.replace(found[3], fresh=False)
    text = markdown(Whole(base, found))
    by_weight = ["application-003", "application-002", "application-001", "application-000"]
    for start in ("| ", "### "):
        assert re.findall(rf"^{re.escape(start)}(application-\d+)", text, re.MULTILINE) == by_weight


def test_equal_changes_and_warnings_are_shown_once(cheaper: tuple[str, Difference]) -> None:
    base, one = cheaper
    text = markdown(Whole(base, many(one, 3)))
    names = "application-000, application-001, application-002"
    assert f"| `spec.objective.alpha` | 0\\.5 | 0\\.0 | 3: {names} |" in text
    assert text.count("spec.objective.alpha") == 1
    assert one.after is not None
    assert one.after.warnings
    for warning in one.after.warnings:
        assert text.count(md(sentence(warning))) == 1
    for section in text.split("\n### ")[1:]:
        assert section.split("\n", 2)[2].startswith("<details>"), "nothing stops it: all of it is folded"


def test_the_hooks_run_what_they_say(repository: Shell) -> None:
    hooks = {hook["id"]: hook for hook in YAML(typ="safe", pure=True).load(ROOT / ".pre-commit-hooks.yaml")}
    assert hooks.keys() == {"fogspec-validate", "fogspec-check"}
    for hook in hooks.values():
        words = hook["entry"].split()[1:]
        names = [] if hook.get("pass_filenames") is False else ["specs/demo.yaml"]
        repository(*words, *names)
    # A commit of one application is judged by that application alone; without a commit yet, all are judged.
    repository.neighbour("other", repository.read("specs/demo.yaml").replace("name: demo", "name: other"))
    commit(repository, "another one")
    change(repository, "alpha: 0.5", "alpha: 0.6", "specs/other/other.yaml")
    words = hooks["fogspec-check"]["entry"].split()[1:]
    assert "1 of 2 applications was judged" in repository(*words).out
    change(repository, "alpha: 0.5", "alpha: 0.6")
    repository(*words, code=3)
    shutil.rmtree(repository.folder / ".git")
    git(repository.folder, "init", "-q")
    assert "2 applications were judged: 1 failed" in repository(*words, code=3).out
    for name in ("specs/demo.yaml", "compiled/demo/manifest.yaml", "results/demo", "specs/demo.lock"):
        assert re.search(hooks["fogspec-check"]["files"], name)


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
    assert "On `apply`: 1 stays in place." in tiny("diff", "--markdown", "--since", "HEAD").stdout
    assert "the machine stays, under the new manifest" in tiny.apply().stdout
    assert tiny.names() == [first]
    commit_all()
    assert "Not affected: tiny." in tiny("diff", "--markdown", "--since", "HEAD").stdout
    assert "no changes" in tiny.apply().stdout
    tiny.change("cpus: 1..2", "cpus: 2..2")
    tiny("compile")
    assert "On `apply`: 1 replaces the machine." in tiny("diff", "--markdown", "--since", "HEAD").stdout
    tiny.apply()
    assert len(tiny.names()) == 1
    assert tiny.names() != [first]
    tiny("down", "tiny")


def test_a_deleted_spec_is_no_longer_deployed_though_its_compiled_files_are_left(repository: Shell) -> None:
    repository.neighbour("other", repository.read("specs/demo.yaml").replace("name: demo", "name: other"))
    base = commit(repository, "two")
    git(repository.folder, "rm", "-q", "specs/demo.yaml")
    said = repository("diff", "--markdown", "--since", base).out
    assert "### demo: no longer deployed" in said
    assert "All machines: $332/month before, $0/month after" in said
    assert "no longer deployed" not in repository("diff", "--markdown", "--since", base, "specs/other/other.yaml").out
    after = commit(repository, "deleted")
    assert "no longer deployed" not in repository("diff", "--markdown", "--since", after).out


def test_a_damaged_manifest_is_neither_gone_nor_replaces_a_machine(repository: Shell) -> None:
    change(
        repository, "kind: DeploymentManifest", "<<<<<<< HEAD\nkind: DeploymentManifest", "compiled/demo/manifest.yaml"
    )
    said = repository("diff", "--markdown", "--since", "HEAD").out
    assert "### demo: the manifest is damaged" in said
    assert "All machines: $332/month before, $332/month after" in said
    assert "replace" not in said
    assert "- **manifest is stale**" in said
    assert "| none" not in said
    assert "demo: damaged -> a.large in aws/r1" in repository("diff").out
    assert "FAIL  demo  manifest not verified" in repository("check", code=3).out


def test_stages_agree_with_their_verb(repository: Shell) -> None:
    change(repository, "requests: 20", "requests: 30")
    change(repository, "work.py", "./work.py")
    said = repository("diff", "--markdown", "--since", "HEAD").out
    assert "- **plan and results are stale**: spec.cloud" in said
    assert "- **models, menu and manifest are stale**: results are stale" in said


@pytest.mark.parametrize("damage", [lambda text: text[:400], lambda text: text.replace("0.", "1.", 1), lambda _: "\0"])
def test_damaged_results_hide_no_other_application(repository: Shell, damage: Callable[[str], str]) -> None:
    repository.neighbour("other", repository.read("specs/demo.yaml").replace("name: demo", "name: other"))
    repository("lock", *AT)
    repository("compile")
    base = commit(repository, "two")[:12]
    path = "results/demo/aws-r1-a-small.yaml"
    repository.write(path, damage(repository.read(path)))
    for restore in ("HEAD", base):  # damaged on disk, then damaged in the commit
        command = f"git checkout {restore} -- {path}"
        said = repository("diff", "--markdown", "--since", base, code=1).out
        assert f"- **{path}:" in said
        assert command in said
        assert "other" in said
        assert "No benchmark needed" not in said
        data = json.loads(repository("diff", "--since", base, "-o", "json", code=1).out)
        assert [(one["name"], one["fresh"]) for one in data["applications"]] == [("demo", False)]
        assert [one["stages"][0]["state"] for one in data["applications"]] == ["damaged"]
        assert data["not_affected"] == ["other"]
        said = repository("status", "-v", code=1).out
        assert "results   damaged  results/demo" in said
        assert "  spent     unknown" in said
        assert "other\n  plan      fresh" in said
        said = repository("diff", code=1).out
        assert f"demo: cannot be compiled to a manifest now: {path} is damaged" in said
        assert "no benchmark needed" not in said
        assert "other: cannot be compiled to a manifest now: nothing is measured yet" in said
        said = repository("check", "--since", base, code=3).out
        assert command in said
        assert "FAIL  demo" in said
        assert command in repository("check", "--since", base, "-j", "2", code=3).out
        if restore == "HEAD":
            commit(repository, "damaged")
    # Without a base, the commit before the damage has them.
    for verb, code in (("status", 1), ("menu", 1), ("check", 3), ("compile", 1)):
        said = repository(verb, "demo", code=code)
        assert f"~1' -- {path}" in said.out + said.err
    subprocess.run(shlex.split(command), cwd=repository.folder, check=True, capture_output=True)
    assert "ok    demo" in repository("check").out


def test_a_damaged_lock_is_said_of_each_application(repository: Shell) -> None:
    whole = repository.read("specs/demo.lock")
    repository.write("specs/demo.lock", f"<<<<<<< HEAD\n{whole}")
    restore = "git checkout HEAD -- specs/demo.lock"
    said = repository("diff", "--markdown", "--since", "HEAD", code=1).out
    assert "- **specs/demo.lock:" in said
    assert restore in said
    assert "All machines: $332/month before, $332/month after" in said
    assert restore in repository("status", "-v", code=1).out
    assert restore in repository("diff", code=1).out
    assert restore in repository("check", code=3).out
    for words in (["apply", "demo", "--dry-run"], ["compile", "demo"], ["bench", "demo"]):
        assert "specs/demo.lock" in repository(*words, code=1).err


def test_a_catalog_that_is_not_the_locked_one_is_said_of_its_application(repository: Shell) -> None:
    repository.write("offers.csv", repository.read("offers.csv").replace("0.4", "0.5", 1))
    refused = "cannot be compiled: demo: the catalog offers.csv is not the one that specs/demo.lock pins"
    assert refused.partition(": ")[2] in repository("diff", "--markdown", "--since", "HEAD").out
    assert refused in repository("status", "-v").out
    assert refused in repository("check", code=3).out
    assert "upgrade catalog" in repository("compile", "demo", code=3).err


def test_an_edited_sample_is_shown_as_a_sample(repository: Shell) -> None:
    path = repository.folder / "results/demo"
    results = read_results_folder(path)
    edited, *others, last = results.spec.samples
    assert edited.latency is not None
    fast = edited.model_copy(update={"latency": LatencySummary(mean=0.0115)})
    again = last.model_copy(update={"duration": last.duration + 1, "latency": LatencySummary(mean=9.0)})
    body = results.spec.model_copy(update={"samples": [fast, *others, again]})
    write(path, body)
    repository("compile", "specs/demo.yaml")
    text = f"{edited.machine.instance} {shown_duration(edited.latency.mean)} -> 11.5 ms, same id, not measured again"
    said = repository("diff", "--since", "HEAD").out
    assert f"  sample: {text}\n  sample: {last.machine.instance} " in said
    assert "-> 9 s, another run\n" in said
    said = repository("diff", "--since", "HEAD", "--markdown").out
    assert "- **Samples changed without a new measurement**: demo." in said
    assert f"- **sample**: {md(text)}\n" in said
    (one,) = json.loads(repository("diff", "--since", "HEAD", "-o", "json").out)["applications"]
    assert [found["how"] for found in one["samples"]] == ["edited", "another run"]
    commit(repository, "edited")
    repository("diff", "--since", "HEAD~1")
    remove(path)
    assert f"{edited.machine.instance} 11.5 ms, removed" in repository("diff", "--since", "HEAD").out


def test_waivers_are_counted_with_their_age_apart_from_measurements(repository: Shell) -> None:
    waiver = "{change: 'spec.cloud[0].env.LOG', old: null, new: debug, reason: it only prints}"
    change(repository, "cmd: [python3, work.py]", "cmd: [python3, work.py], env: {LOG: debug}")
    change(repository, "benchmark: {", f"benchmark: {{waivers: [{waiver}], ")
    repository("compile", "specs/demo.yaml")
    what = "- Changes since the measurement, declared harmless by a waiver: 1"
    assert f"{what} (1 new)." in repository("diff", "--since", "HEAD", "--markdown").out
    commit(repository, "a waiver")
    change(repository, "alpha: 0.5", "alpha: 0")
    repository("compile", "specs/demo.yaml")
    day = git(repository.folder, "log", "-1", "--format=%cs")
    assert f"{what} (0 new, the oldest of {day})." in repository("diff", "--since", "HEAD", "--markdown").out
    (one,) = json.loads(repository("diff", "--since", "HEAD", "-o", "json").out)["applications"]
    assert one["carried"] == [{"what": "spec.cloud[0].env.LOG", "measured": False, "since": day}]


def test_a_price_list_in_anothers_folder_concerns_all_that_it_is_locked_for(repository: Shell) -> None:
    for name in ("other", "third"):
        repository.neighbour(name, repository.read("specs/demo.yaml").replace("name: demo", f"name: {name}"))
    shutil.move(repository.folder / "offers.csv", repository.folder / "specs/other/offers.csv")
    repository("lock", "--catalog", "specs/other/offers.csv")
    repository("compile")
    commit(repository, "a list in a folder")
    repository.write("specs/other/notes.txt", "of the other one")
    assert "Not affected: third." in repository("diff", "--since", "HEAD", "--markdown").out
    change(repository, "0.4", "0.5", "specs/other/offers.csv")
    said = repository("diff", "--since", "HEAD", "--markdown").out
    assert "### demo: the manifest is not fresh" in said
    assert "Unchanged, without a manifest: third." in said


@pytest.fixture
def stale(repository: Shell) -> dict[str, str]:
    """A branch `pr`, a `main` to which others added an application meanwhile, and the commit that merges them; their hashes."""
    made = {"start": git(repository.folder, "rev-parse", "HEAD")}
    main = git(repository.folder, "branch", "--show-current")
    git(repository.folder, "checkout", "-q", "-b", "pr")
    change(repository, "alpha: 0.5", "alpha: 0")
    repository("compile", "specs/demo.yaml")
    made["pr"] = commit(repository, "cheaper")
    git(repository.folder, "checkout", "-q", main)
    repository.neighbour("other", repository.read("specs/demo.yaml").replace("name: demo", "name: other"))
    repository.write("compiled/other/manifest.yaml", repository.read("compiled/demo/manifest.yaml"))
    made["main"] = commit(repository, "of others")
    git(repository.folder, "merge", "-q", "--no-ff", "-m", "merge", "pr")
    made["merge"] = git(repository.folder, "rev-parse", "HEAD")
    git(repository.folder, "config", "uploadpack.allowAnySHA1InWant", "true")
    return made


def shallow(shell: Shell, head: str, base: str) -> Shell:
    """A clone that has two commits and nothing between them, with `head` checked out."""
    folder = shell.folder.with_name("clone")
    git(shell.folder.parent, "init", "-q", "clone")
    for one in (head, base):
        git(folder, "fetch", "-q", "--depth=1", f"file://{shell.folder}", one)
    git(folder, "checkout", "-q", head)
    return dataclasses.replace(shell, folder=folder)


def test_a_merge_commit_names_its_base_in_a_shallow_clone_too(repository: Shell, stale: dict[str, str]) -> None:
    clone = shallow(repository, stale["merge"], stale["main"])
    text = clone("diff", "--since", stale["main"], "--markdown").out
    assert "**1 of 2 applications changed.**" in text
    assert "Not only this change" not in text
    assert "is in it, too" not in clone("check", "--since", stale["main"]).err


@pytest.mark.parametrize(("head", "base"), [("merge", "start"), ("pr", "main")])
def test_where_the_base_cannot_be_known_that_is_said_first_and_nothing_is_to_be_ended(
    repository: Shell, stale: dict[str, str], head: str, base: str
) -> None:
    clone = shallow(repository, stale[head], stale[base])
    says = f"what others merged since {stale[base][:12]} is in it, too"
    text = clone("diff", "--since", stale[base], "--markdown", code=None).out
    assert "Not only this change" in text.split("\n- ")[1]
    checked, told = (
        clone("check", "--since", stale[base], code=None),
        clone("diff", "--since", stale[base], code=None).out,
    )
    assert checked.err.startswith("warning: where this change starts is not in this clone: ")
    assert told.startswith("warning: where this change starts is not in this clone: ")
    assert says in json.loads(clone("diff", "--since", stale[base], "-o", "json", code=None).out)["warning"]
    for found in (text, told, checked.out, checked.err):
        assert "down" not in found
    git(clone.folder, "fetch", "-q", "--unshallow", f"file://{repository.folder}", stale["merge"])
    assert "Not only" not in clone("diff", "--since", stale[base], "--markdown", code=None).out
