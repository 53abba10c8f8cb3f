"""Every command that a change passes on its way to a machine checks the team's policies."""

import json
import re
import subprocess

import pytest

from tests.support.running import Shell, chosen, shell  # noqa: F401

AT = ("--catalog", "offers.csv")
MANIFEST = "compiled/demo/manifest.yaml"


def about(kind: str, body: dict[str, object]) -> str:
    return json.dumps({"properties": {"kind": {"const": kind}, "spec": {"properties": body}}})


CHEAP = about(
    "DeploymentManifest", {"price": {"maximum": 0.01, "description": "a machine costs at most a cent per hour"}}
)
SMALL = about("Application", {"benchmark": {"properties": {"budget": {"maximum": 1, "description": "at most $1"}}}})


@pytest.fixture
def done(shell: Shell) -> Shell:
    chosen(shell)
    for words in (
        ["init", "-q"],
        ["add", "-A"],
        ["-c", "user.name=a", "-c", "user.email=a@b.c", "commit", "-qm", "first"],
    ):
        subprocess.run(["git", "-c", "commit.gpgsign=false", *words], cwd=shell.folder, check=True)
    return shell


COMMANDS = [
    ("compile", "specs/demo.yaml", *AT), ("diff", "--since", "HEAD"),
    ("apply", MANIFEST, "--dry-run"),
]  # fmt: skip


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
@pytest.mark.parametrize(("policy", "place"), [(CHEAP, MANIFEST), (SMALL, "specs/demo.yaml")], ids=["manifest", "spec"])
def test_a_policy_that_is_broken_stops_the_command(
    done: Shell, words: tuple[str, ...], policy: str, place: str
) -> None:
    done.write("policies/team.schema.json", policy)
    said = done(*words, code=1).err
    assert "error[FS601]: " in said
    assert f"--> {place}:" in said
    assert "(policies/team.schema.json)" in said


def test_a_policy_elsewhere_is_named(done: Shell) -> None:
    done.write("rules/small.json", SMALL)
    assert "(rules/small.json)" in done("validate", "--policy", "rules/small.json", code=1).err
    assert "valid: demo" in done("validate").out


def test_a_spec_that_breaks_a_policy_is_not_compiled(done: Shell) -> None:
    done.write("policies/team.schema.json", SMALL)
    before = done.read("compiled/demo/plan.yaml")
    done.write("specs/demo.yaml", done.read("specs/demo.yaml").replace("requests: 20", "requests: 30"))
    done("compile", "specs/demo.yaml", *AT, code=1)
    assert done.read("compiled/demo/plan.yaml") == before


def committed(shell: Shell, what: str) -> None:
    for words in (["add", "-A"], ["-c", "user.name=a", "-c", "user.email=a@b.c", "commit", "-qm", what]):
        subprocess.run(["git", "-c", "commit.gpgsign=false", *words], cwd=shell.folder, check=True)


@pytest.mark.parametrize("how", ["loosened", "removed", "broken"])
def test_a_change_is_judged_by_the_policies_that_it_edits(done: Shell, how: str) -> None:
    done.write("policies/team.schema.json", SMALL)
    committed(done, "a policy")
    if how == "removed":
        (done.folder / "policies/team.schema.json").unlink()
    else:
        done.write("policies/team.schema.json", SMALL.replace("1, ", "9, ") if how == "loosened" else "{")
    said = done("check", "--since", "HEAD", code=3)
    assert "FAIL  policies/team.schema.json: it judges this change, and changed with it" in said.out
    assert re.search(r"at most \$1 \([0-9a-f]{12}:policies/team.schema.json\)", said.out)
    github = done("check", "--since", "HEAD", "-o", "github", code=3).out
    assert "::error file=policies/team.schema.json," in github
    (found,) = json.loads(done("check", "--since", "HEAD", "-o", "json", code=3).out)["rules_changed"]
    assert found == "policies/team.schema.json"
    # What is approved is judged by both still: the change of the policy goes first, alone.
    said = done("check", "--since", "HEAD", "--allow-policy-change", code=3).out
    assert "it judges this change" not in said
    assert "at most $1" in said
    if how != "broken":
        committed(done, "the policy alone")
        done.write("README.md", "about\n")
        assert "0 of 1 application" in done("check", "--since", "HEAD").out


def test_a_change_of_the_place_of_live_state_needs_an_approval(done: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    done.write("fogspec.yaml", done_project("git+ssh://elsewhere.invalid/state"))
    monkeypatch.setattr("fogspec.deploy.running.without_spec", lambda *_: pytest.fail("the new place was looked at"))
    said = done("check", "--since", "HEAD", code=3).out
    assert "FAIL  fogspec.yaml: it judges this change, and changed with it" in said
    monkeypatch.setattr("fogspec.deploy.running.without_spec", lambda *_: [])
    done("check", "--since", "HEAD", "--allow-policy-change")


def done_project(state: str) -> str:
    return f"apiVersion: fogspec.dev/v1alpha1\nkind: Project\nspec: {{state: '{state}'}}\n"
