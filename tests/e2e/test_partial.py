"""A plan that was not carried out, a change that is not measured yet, and samples of which none counts: what verbs say."""

import re

import pytest

from fogspec.plan.schema import PlanMetadata
from fogspec.results.schema import Results, with_checksum
from fogspec.spec.loader import read_document
from tests.e2e.test_ci import git
from tests.support.files import write_yaml
from tests.support.running import Shell, measure, project, shell  # noqa: F401

AT = ("--catalog", "offers.csv")
MANIFEST = "compiled/demo/manifest.yaml"
VERBS = {
    "ci": ("ci",),
    "verify": ("verify", MANIFEST),
    "status": ("status", "--exit-code"),
    "check": ("compile", "--check"),
    "diff": ("diff", "--exit-code"),
    "apply": ("apply", MANIFEST, "--dry-run"),
}


def codes(shell: Shell) -> dict[str, int]:
    return {name: shell(*words, *AT, code=None).code for name, words in VERBS.items()}


@pytest.fixture
def some(shell: Shell) -> Shell:
    """An application with one of four planned samples."""
    project(shell)
    measure(shell, only=1)
    return shell


def test_a_part_of_the_plan_makes_no_manifest(some: Shell) -> None:
    said = some("compile", *AT, code=7)
    assert "1 of 4 planned samples count" in said.out
    assert "demo: 1 of 4 planned samples are measured: no manifest" in said.err
    assert "fogspec compile specs/demo.yaml --partial" in said.out
    assert not (some.folder / MANIFEST).exists()
    assert "partial: 1 of 4 planned samples are measured; to measure: aws-" in some.read("compiled/demo/menu.yaml")
    some("verify", MANIFEST, *AT, code=1)
    assert some("ci", *AT, code=3).out.count("manifest is missing: results are partial") == 1
    assert "manifest  missing" in some("status", *AT, "--exit-code", code=3).out
    assert "chosen" in some("explain", "specs/demo.yaml", *AT).out


def test_a_manifest_of_a_part_of_the_plan_says_so_everywhere(some: Shell) -> None:
    some("compile", *AT, "--partial")
    words = "partial: 1 of 4 planned samples are measured"
    assert codes(some) == dict.fromkeys(VERBS, 0)
    assert re.search(r"partial:\n +measured: 1\n +planned: 4\n +missing:\n", some.read(MANIFEST))
    assert words in some.read("compiled/demo/menu.yaml")
    assert words in some("menu", "specs/demo.yaml", *AT).out
    assert words.replace("partial: ", "") in some("status", *AT).out
    assert "manifest verified: partial, 1 of 4 planned samples are measured" in some("ci", *AT).out
    assert "partial   1 of 4 planned samples" in some("apply", MANIFEST, "--dry-run", *AT).err
    git(some, "init", "-q")
    git(some, "commit", "-q", "--allow-empty", "-m", "nothing yet")
    assert f"- {words}" in some("review", "HEAD", *AT).out


def test_what_was_accepted_holds_for_that_plan_and_no_less(some: Shell) -> None:
    measure(some, only=2)
    some("compile", *AT, "--partial")
    some("compile", *AT)
    measure(some, only=3)
    some("compile", *AT)
    assert "planned: 4" in some.read(MANIFEST)
    assert "measured: 3" in some.read(MANIFEST)
    measure(some, only=1)
    some("compile", *AT, code=7)
    assert set(codes(some).values()) == {3}
    measure(some)
    some("compile", *AT)
    assert "partial" not in some.read(MANIFEST)
    assert codes(some) == dict.fromkeys(VERBS, 0)


def test_an_unmeasured_change_keeps_the_manifest_and_apply_refuses_it(shell: Shell) -> None:
    project(shell)
    measure(shell)
    shell("compile", *AT)
    before = {path.name: path.read_bytes() for path in (shell.folder / "compiled/demo").glob("*.*")}
    shell.write("specs/demo.yaml", shell.read("specs/demo.yaml").replace("callback: plan", "callback: other"))
    said = shell("compile", *AT)
    assert "stale: it stays, and apply refuses it, until there is a new one" in said.out
    assert "removed" not in said.err
    after = {path.name: path.read_bytes() for path in (shell.folder / "compiled/demo").glob("*.*")}
    assert {name for name in before if before[name] != after.get(name)} == {"plan.yaml"}
    assert set(codes(shell).values()) == {3}
    measure(shell)
    shell("compile", *AT)
    assert codes(shell) == dict.fromkeys(VERBS, 0)


def test_limits_that_nothing_meets_keep_the_manifest_too(shell: Shell) -> None:
    project(shell)
    measure(shell)
    shell("compile", *AT)
    shell.write("specs/demo.yaml", shell.read("specs/demo.yaml").replace("latency: 10s", "latency: 1ms"))
    said = shell("compile", *AT, code=4)
    assert "no machine meets the limits" in said.err
    assert (shell.folder / MANIFEST).exists()
    assert set(codes(shell).values()) == {3}


def failed(shell: Shell) -> None:
    """Make every sample one that failed for good."""
    path = shell.folder / "results/demo.yaml"
    found = read_document(path, Results).spec
    gone = {"state": "failed", "reason": "crash", "latency": None, "requests": 0}
    body = found.model_copy(update={"samples": [one.model_copy(update=gone) for one in found.samples]})
    results = with_checksum(PlanMetadata(name="demo"), body)
    write_yaml(path, results.model_dump(mode="json", exclude_none=True), "a test")


def test_nothing_measured_is_not_no_machine(shell: Shell) -> None:
    project(shell)
    assert "was not measured yet" in shell("menu", "specs/demo.yaml", *AT, code=7).err
    measure(shell)
    failed(shell)
    said = shell("compile", *AT, code=7)
    assert "nothing is measured: no sample counts, or each admissible machine failed" in said.err
    assert "0 of 4 samples count" in said.out
    assert "no machine meets" not in said.out + said.err
    assert "nothing is measured" in shell("menu", "specs/demo.yaml", *AT, code=7).err
    assert "nothing is measured" in shell("diff", *AT).out
