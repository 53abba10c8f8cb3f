"""A plan that was not carried out, a change that is not measured yet, and samples of which none counts: what verbs say."""

import pytest

from fogspec.results.io import read_results_folder
from fogspec.results.schema import results_of
from tests.e2e.test_check import git
from tests.support.results import write
from tests.support.running import Shell, measure, project, shell  # noqa: F401

AT = ("--catalog", "offers.csv")
MANIFEST = "compiled/demo/manifest.yaml"
VERBS = {
    "check": ("check",),
    "diff": ("diff",),
    "apply": ("apply", MANIFEST, "--dry-run"),
}


def codes(shell: Shell) -> dict[str, int]:
    return {name: shell.judged(*words).code for name, words in VERBS.items()}


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
    assert "1 of 4 planned samples are measured; to measure: aws-" in some("menu", "specs/demo.yaml").out
    assert "{code: partial, measured: 1, planned: 4, missing: [aws-" in some.read("compiled/demo/menu.yaml")
    said = some("check", code=3).out
    assert said.count("are missing: results are partial") + said.count("is missing: results are partial") == 1
    assert "manifest  missing" in some("status").out
    assert "choice" in some("explain", "specs/demo.yaml").out


def test_a_manifest_of_a_part_of_the_plan_says_so_everywhere(some: Shell) -> None:
    some("compile", *AT, "--partial")
    words = "1 of 4 planned samples are measured"
    assert codes(some) == dict.fromkeys(VERBS, 0)
    assert "{code: partial, measured: 1, planned: 4, missing: [aws-" in some.read(MANIFEST)
    assert words in some("menu", "specs/demo.yaml").out
    assert words in some("status").out
    assert "manifest verified: partial, 1 of 4 planned samples are measured" in some("check").out
    assert "partial   1 of 4 planned samples" in some("apply", MANIFEST, "--dry-run").err
    git(some, "init", "-q")
    git(some, "commit", "-q", "--allow-empty", "-m", "nothing yet")
    assert f"- **warning**: {words}" in some("diff", "--since", "HEAD", "--markdown").out


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
    path = shell.folder / "results/demo"
    found = read_results_folder(path).spec
    gone = {"state": "failed", "reason": "crash", "latency": None, "requests": 0}
    body = found.model_copy(update={"samples": [one.model_copy(update=gone) for one in found.samples]})
    results = results_of(body)
    write(path, results.spec)


def test_nothing_measured_is_not_no_machine(shell: Shell) -> None:
    project(shell)
    assert "was not measured yet" in shell("menu", "specs/demo.yaml", code=7).err
    measure(shell)
    failed(shell)
    said = shell("compile", *AT, code=7)
    assert "nothing is measured: no sample counts, or each admissible machine failed" in said.err
    assert "0 of 4 samples count" in said.out
    assert "no machine meets" not in said.out + said.err
    assert "nothing is measured" in shell("menu", "specs/demo.yaml", code=7).err
    assert "nothing is measured" in shell("diff").out
    again = "fogspec bench specs/demo.yaml --only aws-r1-a-small,aws-r1-b-small,aws-r1-a-large,aws-r1-b-large"
    check = shell("check", code=3)
    assert "FAIL  demo  measured, no manifest: nothing to deploy" in check.out
    assert "results/demo: results are unusable: sample aws-r1-a-small does not count: crash; " in check.out
    assert f"fix: {again}" in check.out
    assert "deploys what is committed" not in check.err
    assert f"next: {again}" in shell("status").out


def test_limits_that_nothing_meets_are_an_answer_that_deploys_nothing(shell: Shell) -> None:
    project(shell, constraints="{latency: 1ms}")
    measure(shell)
    shell("compile", *AT, code=4)
    check = shell("check")
    assert "ok    demo  measured, no machine meets the limits: nothing to deploy" in check.out
    assert "deploys what is committed" not in check.err
