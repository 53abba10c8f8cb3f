"""Every command that a change passes on its way to a machine checks the team's policies."""

import json
import subprocess

import pytest

from tests.support.running import Shell, measure, project, shell  # noqa: F401

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
    project(shell)
    measure(shell)
    shell("compile", "specs/demo.yaml", *AT)
    for words in (
        ["init", "-q"],
        ["add", "-A"],
        ["-c", "user.name=a", "-c", "user.email=a@b.c", "commit", "-qm", "first"],
    ):
        subprocess.run(["git", "-c", "commit.gpgsign=false", *words], cwd=shell.folder, check=True)
    return shell


COMMANDS = [
    ("compile", "specs/demo.yaml", *AT), ("compile", "--check", "specs/demo.yaml", *AT), ("review", "HEAD", *AT),
    ("verify", MANIFEST, *AT), ("apply", MANIFEST, "--dry-run", *AT),
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
