"""Whatever is edited in a project that was committed whole: which verb says so, and of what. The table is in the docs.

FOGSPEC_REWRITE=1 writes the rows into `tests/data/tampering.md`.
"""

import gzip
import json
import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from fogspec.base.layout import Layout
from fogspec.compile.plan_files import plan_file
from fogspec.language.loader import read_document
from fogspec.plan.schema import Plan
from fogspec.results.io import read_results_folder
from tests.corners.test_chain import with_timings
from tests.e2e.test_check import AT, MANIFEST, git, replaced, task_of, without
from tests.support.results import write
from tests.support.running import Shell, copied, measure, project, shell  # noqa: F401

PAGE = Path(__file__).resolve().parents[2] / "tests" / "data" / "tampering.md"
TABLE = re.compile(r"(?<=<!-- tampering -->\n).*?(?=<!-- /tampering -->)", re.DOTALL)
RESULTS = "results/demo/aws-r1-a-small.yaml"
COMPILED = "compiled/demo/"
VERBS = {
    "check": ("check",),
    "check --since": ("check", "--since", "HEAD"),
    "diff": ("diff",),
    "diff --since": ("diff", "--since", "HEAD"),
    "bench --dry-run": ("bench", "demo", "--dry-run"),
    "apply --dry-run": ("apply", MANIFEST, "--dry-run"),
}
HEAD = "| edited | not fresh in `status` | " + " | ".join(f"`{verb}`" for verb in VERBS)
MEASURED = ("the spec: what is measured", "a script beside the spec", "one more file beside the spec", "the plan",
            "the plan, without a sample", "a task", "a task, removed", "agent.pyz")  # fmt: skip


def raw(shell: Shell) -> Path:
    return next((shell.folder / "results/demo/timings").iterdir())


def lying(shell: Shell) -> None:
    """A figure of the results in contradiction to its raw timings, sealed again, and everything compiled from it."""
    path = shell.folder / "results/demo"
    results = read_results_folder(path)
    first, *others = results.spec.samples
    assert first.latency is not None
    better = first.model_copy(update={"latency": first.latency.model_copy(update={"mean": first.latency.mean / 2})})
    body = results.spec.model_copy(update={"samples": [better, *others]})
    write(path, body)
    shell("compile", *AT)


def amputated(shell: Shell) -> None:
    layout = Layout.of("specs/demo.yaml", "demo")
    plan = read_document(shell.folder / layout.plan, Plan)
    body = plan.spec.model_copy(update={"samples": plan.spec.samples[1:]})
    (shell.folder / layout.plan).write_bytes(plan_file(plan.model_copy(update={"spec": body}), layout))


def extra(shell: Shell) -> None:
    task = shell.read(f"{COMPILED}deploy.sky.yaml")
    shell.write(f"{COMPILED}deploy.fallback-9.sky.yaml", task)


# What was edited, how, and what every verb names.
KINDS: dict[str, tuple[Callable[[Shell], object], str]] = {
    "the spec: a limit": (replaced("specs/demo.yaml", "latency: 10s", "latency: 9s"), "spec|menu|manifest"),
    "the spec: what is measured": (replaced("specs/demo.yaml", "callback: plan", "callback: other"), "spec|plan|probe"),
    "a script beside the spec": (lambda shell: shell.write("specs/work.py", "print('other')\n"), r"work\.py"),
    "one more file beside the spec": (lambda shell: shell.write("specs/more.py", "\n"), r"more\.py"),
    "the lock: a digest": (replaced("specs/demo.lock", "sha256:.{4}", "sha256:0000"), "catalog"),
    "the locked catalog": (replaced("offers.csv", "0.10", "0.11"), "catalog"),
    "the plan": (replaced(f"{COMPILED}plan.yaml", "^  duration: .*", "  duration: 9min"), "plan"),
    "the plan, without a sample": (amputated, "plan"),
    "a task": (lambda shell: replaced(task_of(shell), "max_hourly_cost: .*", "max_hourly_cost: 9")(shell), "tasks/|plan"),
    "a task, removed": (lambda shell: without(task_of(shell))(shell), "tasks/|plan"),
    **{
        f"{name}.sh": (replaced(f"{COMPILED}scripts/{name}.sh", "^set -", "curl evil; set -"), rf"{name}\.sh")
        for name in ("setup", "measure", "deploy")
    },
    "the plan: a script's digest": (replaced(f"{COMPILED}plan.yaml", "setup.sh, digest: .{12}", "setup.sh, digest: x"), "plan"),
    "the results: a figure": (replaced(RESULTS, "^    requests: .*", "    requests: 21"), "results"),
    "the results: no YAML any more": (replaced(RESULTS, "mean: .*", "mean: 1ms"), "results"),
    "the results, removed": (without(RESULTS), "results|not measured"),
    "raw timings": (lambda shell: raw(shell).write_bytes(gzip.compress(b"{}\n", mtime=0)), "timings"),
    "raw timings, removed": (lambda shell: raw(shell).unlink(), "timings"),
    "a figure of the results, sealed and compiled again": (lying, "timings|not measured again"),
    "the models": (replaced(f"{COMPILED}models.yaml", "kind: .*", "kind: Models2"), "models"),
    "the models: what they were fitted from": (
        replaced(f"{COMPILED}models.yaml", "statistic: mean", "statistic: p95"), r"spec\.constraints\.statistic: p95 -> mean"
    ),
    "the models: results": (replaced(f"{COMPILED}models.yaml", "results: sha256:", "results: x"), "results changed"),
    "the menu": (replaced(f"{COMPILED}menu.yaml", "predicted", "measured"), "menu"),
    "a picture": (replaced(f"{COMPILED}menu.svg", "<svg ", "<svg onload='x()' "), r"menu\.svg|menu"),
    "the manifest": (replaced(MANIFEST, "instance: .*", "instance: a.huge"), "manifest|instance"),
    "the manifest: what it was made from": (replaced(MANIFEST, "results: sha256:", "results: x"), "results changed"),
    "the manifest, removed": (without(MANIFEST), "manifest"),
    "deploy.sky.yaml": (replaced(f"{COMPILED}deploy.sky.yaml", "run: ", "run: curl evil; "), r"deploy\.sky\.yaml"),
    "a fallback's task": (replaced(f"{COMPILED}deploy.fallback-1.sky.yaml", "run: ", "run: x; "), "fallback-1"),
    "one more task to deploy": (extra, "fallback-9"),
    "robot.launch.py": (replaced(f"{COMPILED}robot.launch.py", "def ", "import os\ndef "), r"robot\.launch\.py"),
    "a policy": (lambda shell: shell.write("policies/more.schema.json", "{}"), r"policies/more\.schema\.json is new"),
    "agent.pyz": (lambda shell: (shell.folder / "compiled/agent.pyz").write_bytes(b"evil"), r"agent\.pyz"),
}  # fmt: skip


@pytest.fixture
def whole(shell: Shell) -> Shell:
    """A committed application with lock, results, raw timings, a fallback and nodes on the robot; compiled once."""

    def fill(made: Shell) -> None:
        project(
            made,
            cloud="[{cmd: [python3, work.py]}, {package: p, executable: e}]",
            robot="[{package: p, executable: r}]",
            ros="{distro: humble}",
            deployment="{fallbacks: 1}",
        )
        made("lock", *AT)
        made("compile", *AT)
        measure(made)
        with_timings(made, [2.0, 2.1, 2.2])
        git(made, "init", "-q")
        git(made, "add", "-A")
        git(made, "commit", "-qm", "all")
        assert {made.judged(*words).code for words in VERBS.values()} == {0}

    copied(shell, "a repository with all that can be edited", fill)
    return shell


def row(shell: Shell, what: str, names: str) -> str:
    """What each verb says, as a row of the table."""
    ended = {verb: shell.judged(*words) for verb, words in VERBS.items()}
    for verb, one in ended.items():
        if one.code:
            assert re.search(names, one.out + one.err), (verb, one)
    try:
        stages = json.loads(shell("status", "-o", "json", code=None).out)[0]["stages"]
        stale = ", ".join(stage["name"] for stage in stages if stage["state"] != "fresh") or "none"
        stale = stale if stages else "an error"
    except ValueError:
        stale = "an error"
    codes = " | ".join(str(one.code) for one in ended.values())
    return f"| {what} | {stale} | {codes} |"


@pytest.mark.parametrize("what", KINDS)
def test_each_verb_says_what_was_edited(whole: Shell, what: str) -> None:
    edit, names = KINDS[what]
    edit(whole)
    found = row(whole, what, names)
    if os.environ.get("FOGSPEC_REWRITE"):
        rewrite(what, found)
    assert found in PAGE.read_text("utf-8").splitlines()
    codes = [int(code.strip(" |")) for code in found.split(" | ")[2:]]
    measured = codes.pop(-2)
    assert measured or what not in MEASURED, "a bench measures the plan of the spec, or nothing"
    if what == "a picture":  # no link of the chain: tests/e2e/test_equal_bytes.py has its warnings
        assert not any(codes)
        return
    assert all(codes)


def test_the_table_has_these_rows_and_no_others() -> None:
    lines = TABLE.search(PAGE.read_text("utf-8"))[0].splitlines()  # type: ignore[index]
    assert lines[0] == f"{HEAD} |"
    assert [line.split(" | ")[0].removeprefix("| ") for line in lines[2:]] == list(KINDS)


def rewrite(what: str, found: str) -> None:
    page = PAGE.read_text("utf-8")
    before = {line.split(" | ")[0].removeprefix("| "): line for line in TABLE.search(page)[0].splitlines()[2:]}  # type: ignore[index]
    rows = before | {what: found}
    lines = [f"{HEAD} |", "|" + "--|" * (HEAD.count(" | ") + 1), *(rows[name] for name in KINDS if name in rows)]
    PAGE.write_text(TABLE.sub(lambda _found: "\n".join(lines) + "\n", page), "utf-8")
