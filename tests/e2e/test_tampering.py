"""Whatever is edited in a project that was committed whole: which verb says so, and of what. The table is in the docs.

FOGSPEC_REWRITE=1 writes the rows into `docs/explanation/reliability.md`.
"""

import gzip
import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from fogspec.results.schema import Results, with_checksum
from fogspec.spec.loader import read_document
from tests.e2e.test_chain import with_timings
from tests.e2e.test_ci import AT, MANIFEST, git, replaced, task_of, without
from tests.support.files import write_yaml
from tests.support.running import Shell, measure, project, shell  # noqa: F401

PAGE = Path(__file__).resolve().parents[2] / "docs" / "explanation" / "reliability.md"
TABLE = re.compile(r"(?<=<!-- tampering -->\n).*?(?=<!-- /tampering -->)", re.DOTALL)
RESULTS = "results/demo.yaml"
COMPILED = "compiled/demo/"
VERBS = {
    "verify": ("verify", MANIFEST),
    "ci": ("ci",),
    "status": ("status", "--exit-code"),
    "compile --check": ("compile", "--check"),
    "diff": ("diff", "--exit-code"),
    "review": ("review", "HEAD", "--exit-code"),
    "apply --dry-run": ("apply", MANIFEST, "--dry-run"),
}
HEAD = "| edited | `verify` breaks at | not fresh in `status` | " + " | ".join(f"`{verb}`" for verb in list(VERBS)[1:])
WHOLE: list[Path] = []


def raw(shell: Shell) -> Path:
    return next((shell.folder / "results/demo/timings").iterdir())


def lying(shell: Shell) -> None:
    """A figure of the results in contradiction to its raw timings, sealed again, and everything compiled from it."""
    path = shell.folder / RESULTS
    results = read_document(path, Results)
    first, *others = results.spec.samples
    assert first.latency is not None
    better = first.model_copy(update={"latency": first.latency.model_copy(update={"mean": first.latency.mean / 2})})
    body = results.spec.model_copy(update={"samples": [better, *others]})
    write_yaml(path, with_checksum(results.metadata, body).model_dump(mode="json", exclude_none=True), "a test")
    shell("compile", *AT)


def extra(shell: Shell) -> None:
    task = shell.read(f"{COMPILED}deploy.sky.yaml")
    shell.write(f"{COMPILED}deploy.fallback-9.sky.yaml", task)


# What was edited, how, and what every verb names.
KINDS: dict[str, tuple[Callable[[Shell], object], str]] = {
    "the spec: a limit": (replaced("specs/demo.yaml", "latency: 10s", "latency: 9s"), "spec|menu|manifest"),
    "the spec: what is measured": (replaced("specs/demo.yaml", "callback: plan", "callback: other"), "spec|plan|probe"),
    "a script beside the spec": (lambda shell: shell.write("specs/work.py", "print('other')\n"), r"work\.py"),
    "one more file beside the spec": (lambda shell: shell.write("specs/more.py", "\n"), r"more\.py"),
    "the lock: a digest": (replaced("fogspec.lock", "work.py: sha256:.", "work.py: sha256:x"), r"work\.py"),
    "the locked catalog": (replaced("offers.csv", "0.10", "0.11"), "catalog"),
    "the plan": (replaced(f"{COMPILED}plan.yaml", "^  duration: .*", "  duration: 9min"), "plan"),
    "a task": (lambda shell: replaced(task_of(shell), "max_hourly_cost: .*", "max_hourly_cost: 9")(shell), "tasks/|plan"),
    "a task, removed": (lambda shell: without(task_of(shell))(shell), "tasks/|plan"),
    "the results: a figure": (replaced(RESULTS, "requests: 20", "requests: 21"), "results"),
    "the results: no YAML any more": (replaced(RESULTS, "mean: .*", "mean: 1ms"), "results"),
    "the results, removed": (without(RESULTS), "results|not measured"),
    "raw timings": (lambda shell: raw(shell).write_bytes(gzip.compress(b"{}\n", mtime=0)), "timings"),
    "raw timings, removed": (lambda shell: raw(shell).unlink(), "timings"),
    "a figure of the results, sealed and compiled again": (lying, "timings"),
    "the models": (replaced(f"{COMPILED}models.yaml", "kind: .*", "kind: Models2"), "models"),
    "the menu": (replaced(f"{COMPILED}menu.yaml", "predicted", "measured"), "menu"),
    "a picture": (replaced(f"{COMPILED}menu.svg", "<svg ", "<svg onload='x()' "), r"menu\.svg|menu"),
    "the manifest": (replaced(MANIFEST, "instance: .*", "instance: a.huge"), "manifest|instance"),
    "the manifest, removed": (without(MANIFEST), "manifest"),
    "deploy.sky.yaml": (replaced(f"{COMPILED}deploy.sky.yaml", "run: ", "run: curl evil; "), r"deploy\.sky\.yaml"),
    "a fallback's task": (replaced(f"{COMPILED}deploy.fallback-1.sky.yaml", "run: ", "run: x; "), "fallback-1"),
    "one more task to deploy": (extra, "fallback-9"),
    "robot.launch.py": (replaced(f"{COMPILED}robot.launch.py", "def ", "import os\ndef "), r"robot\.launch\.py"),
    "agent.pyz": (lambda shell: (shell.folder / "compiled/agent.pyz").write_bytes(b"evil"), r"agent\.pyz"),
}  # fmt: skip


@pytest.fixture
def whole(shell: Shell) -> Shell:
    """A committed application with lock, results, raw timings, a fallback and nodes on the robot; compiled once."""
    if not WHOLE:
        project(
            shell,
            cloud="[{cmd: [python3, work.py]}, {package: p, executable: e}]",
            robot="[{package: p, executable: r}]",
            ros="{distro: jazzy}",
            deployment="{fallbacks: 1}",
        )
        shell("lock", *AT)
        shell("compile", *AT)
        measure(shell)
        with_timings(shell, [2.0, 2.1, 2.2])
        git(shell, "init", "-q")
        git(shell, "add", "-A")
        git(shell, "commit", "-qm", "all")
        assert {shell(*words, *AT, code=None).code for words in VERBS.values()} == {0}
        WHOLE.append(shell.folder.with_name("whole"))
        shutil.copytree(shell.folder, WHOLE[0])
    else:
        shutil.copytree(WHOLE[0], shell.folder, dirs_exist_ok=True)
    return shell


def row(shell: Shell, what: str, names: str) -> str:
    """What each verb says, as a row of the table."""
    ended = {verb: shell(*words, *AT, code=None) for verb, words in VERBS.items()}
    for verb, one in ended.items():
        if one.code:
            assert re.search(names, one.out + one.err), (verb, one)
    try:
        links = json.loads(shell("verify", MANIFEST, *AT, "-o", "json", code=None).out)["links"]
        broken = next((link["name"] for link in links if link["breaks"]), "none")
    except ValueError:
        broken = "an error"
    try:
        stages = json.loads(shell("status", *AT, "-o", "json", code=None).out)[0]["stages"]
        stale = ", ".join(stage["name"] for stage in stages if stage["state"] != "fresh") or "none"
    except ValueError:
        stale = "an error"
    codes = " | ".join(str(ended[verb].code) for verb in list(VERBS)[1:])
    return f"| {what} | {broken} | {stale} | {codes} |"


@pytest.mark.parametrize("what", KINDS)
def test_each_verb_says_what_was_edited(whole: Shell, what: str) -> None:
    edit, names = KINDS[what]
    edit(whole)
    found = row(whole, what, names)
    if os.environ.get("FOGSPEC_REWRITE"):
        rewrite(what, found)
    assert found in PAGE.read_text("utf-8").splitlines()
    codes = [int(code) for code in found.split(" | ")[3:9] for code in [code.strip(" |")]]
    assert codes[0], "no gate takes it"
    assert codes[-1], "nothing deploys it"
    assert all(codes) or what == "a figure of the results, sealed and compiled again"


def test_the_table_has_these_rows_and_no_others() -> None:
    lines = TABLE.search(PAGE.read_text("utf-8"))[0].splitlines()  # type: ignore[index]
    assert [line.split(" | ")[0].removeprefix("| ") for line in lines[2:]] == list(KINDS)


def rewrite(what: str, found: str) -> None:
    page = PAGE.read_text("utf-8")
    before = {line.split(" | ")[0].removeprefix("| "): line for line in TABLE.search(page)[0].splitlines()[2:]}  # type: ignore[index]
    rows = before | {what: found}
    lines = [f"{HEAD} |", "|" + "--|" * (HEAD.count(" | ") + 1), *(rows[name] for name in KINDS if name in rows)]
    PAGE.write_text(TABLE.sub(lambda _found: "\n".join(lines) + "\n", page), "utf-8")
