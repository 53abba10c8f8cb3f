"""What GitHub reads is what GitHub takes: against the schemas that are published for it, and the shell's own critic."""

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from fogspec import __version__
from tests.docs.blocks import blocks, pages

ROOT = Path(__file__).resolve().parents[2]
GITHUB = ROOT / ".github"
CHECKED = {
    "vendor.github-workflows": sorted((GITHUB / "workflows").glob("*.yml")),
    "vendor.github-actions": [ROOT / "action.yml"],
    "vendor.github-issue-forms": [GITHUB / "ISSUE_TEMPLATE/bug.yml", GITHUB / "ISSUE_TEMPLATE/idea.yml"],
    "vendor.github-issue-config": [GITHUB / "ISSUE_TEMPLATE/config.yml"],
    "vendor.citation-file-format": [ROOT / "CITATION.cff"],
}
BASH = ("shellcheck", "--shell=bash", "--severity=style", "--exclude=SC2153", "-")  # capitals come from the environment


def read(path: Path) -> Any:
    return YAML(typ="safe", pure=True).load(path)


@pytest.mark.parametrize("schema", CHECKED)
def test_files_for_github_follow_their_schemas(schema: str) -> None:
    assert CHECKED[schema]
    words = [sys.executable, "-m", "check_jsonschema", "--quiet", "--builtin-schema", schema, *CHECKED[schema]]
    subprocess.run(words, check=True, timeout=600)


def scripts() -> list[tuple[str, str]]:
    jobs = [("action.yml", read(ROOT / "action.yml")["runs"])]
    jobs += [(path.name, job) for path in CHECKED["vendor.github-workflows"] for job in read(path)["jobs"].values()]
    return [(f"{name} {one.get('name', '')}", one["run"]) for name, job in jobs for one in job["steps"] if "run" in one]


@pytest.mark.parametrize(("name", "script"), scripts())
def test_run_steps_are_sound_shell(name: str, script: str) -> None:
    if shutil.which("shellcheck") is None:
        pytest.skip("needs shellcheck: apt-get install shellcheck")
    assert "${{" not in script, "values reach a script by its environment, never by its text"
    ended = subprocess.run(BASH, input=script, text=True, capture_output=True, timeout=600, check=False)
    assert ended.returncode == 0, ended.stdout


# In a checkout, an interpreter that is not isolated imports what lies there: `venv.py`, `json.py`.
NOT_ISOLATED = re.compile(r"(?<![\w.-])python[\d.]*[\"']?(?=[\s;&|)]|$)(?!\s+-I\b)", re.MULTILINE)
DOCUMENTED = [
    (f"{block.page.name}:{block.line}", YAML(typ="safe", pure=True).load(block.text))
    for page in pages()
    for block in blocks(page)
    if block.language == "yaml" and "steps:" in block.text
]


def values(data: Any, key: str) -> list[str]:
    """What the key has, anywhere in a document."""
    inside = data.values() if isinstance(data, dict) else data if isinstance(data, list) else []
    own = [data[key]] if isinstance(data, dict) and isinstance(data.get(key), str) else []
    return own + [found for one in inside for found in values(one, key)]


def test_no_step_or_hook_starts_an_interpreter_that_imports_from_the_checkout() -> None:
    found = [*scripts(), *((name, one) for name, data in DOCUMENTED for one in values(data, "run"))]
    found += [(".pre-commit-hooks.yaml", one) for one in values(read(ROOT / ".pre-commit-hooks.yaml"), "entry")]
    assert sum("python" in text for _, text in found) >= 2
    assert [name for name, text in found if NOT_ISOLATED.search(text)] == []
    for text in (
        'python -m venv "$RUNNER_TEMP/fogspec"',
        '"$A/bin/python" -m pip',
        "cd x; python3.11 a.py",
        "a | python",
    ):
        assert NOT_ISOLATED.search(text), text


def test_the_documented_workflow_has_the_checkout_that_the_action_needs() -> None:
    (ours,) = {one for one in values(read(GITHUB / "workflows/ci.yml"), "uses") if one.startswith("actions/checkout@")}
    workflows = [data for _, data in DOCUMENTED if isinstance(data, dict) and "jobs" in data]
    assert workflows
    for workflow in workflows:
        assert "pull_request_target" not in str(workflow["on"])
        steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
        (checkout,) = (step for step in steps if step.get("uses", "").startswith("actions/checkout@"))
        assert checkout == {"uses": ours, "with": {"persist-credentials": False, "fetch-depth": 2}}


def test_ci_runs_what_the_repository_says_it_runs() -> None:
    steps = read(GITHUB / "workflows/ci.yml")["jobs"]["test"]["steps"]
    assert ".ci/run" in [one.get("run") for one in steps]
    assert "make test" in (ROOT / ".ci/run").read_text("utf-8").splitlines()


def test_publishing_needs_no_token_and_nothing_else_may_write() -> None:
    release = read(GITHUB / "workflows/release.yml")
    assert release["permissions"] == {"contents": "read"}
    assert release["jobs"]["publish"]["permissions"] == {"id-token": "write"}
    assert (release["jobs"]["publish"]["needs"], release["jobs"]["try"]["needs"]) == ("try", "build")
    assert "secrets." not in (GITHUB / "workflows/release.yml").read_text("utf-8")


def test_every_place_names_the_same_version() -> None:
    assert read(ROOT / "CITATION.cff")["version"] == __version__
    text = (ROOT / "pyproject.toml").read_text("utf-8")
    pythons = read(GITHUB / "workflows/release.yml")["jobs"]["try"]["strategy"]["matrix"]["python"]
    assert pythons == re.findall(r"Python :: (3\.\d+)", text)
    low, above = (int(minor) for minor in re.findall(r"3\.(\d+)", tomllib.loads(text)["project"]["requires-python"]))
    assert pythons == [f"3.{minor}" for minor in range(low, above)]
    lab = tomllib.loads((ROOT / "lab/pyproject.toml").read_text("utf-8"))["project"]
    assert lab["requires-python"] == tomllib.loads(text)["project"]["requires-python"]


PINNED = re.compile(r"[\w.-]+/[\w./-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+")
INSTALLS = re.compile(r"pip['\"]? install|\bpip --|npm (ci|install)|uv pip install|uv build|curl |wget ")


def test_every_action_is_pinned_by_the_digest_of_a_commit_with_its_version_in_a_comment() -> None:
    files = [ROOT / "action.yml", *CHECKED["vendor.github-workflows"]]
    uses = [
        line.strip().removeprefix("- ")
        for file in files
        for line in file.read_text("utf-8").splitlines()
        if "uses:" in line
    ]
    wrong = [one for one in uses if not PINNED.fullmatch(one.removeprefix("uses:").strip())]
    assert len(uses) >= 7
    assert not wrong, "write OWNER/NAME@COMMIT # vX.Y.Z"


PAGES = {"pages": "write", "id-token": "write"}


def test_every_workflow_says_what_it_may_do() -> None:
    for file in CHECKED["vendor.github-workflows"]:
        workflow = read(file)
        assert workflow["permissions"] == {"contents": "read"}, file
        for name, job in workflow["jobs"].items():
            assert job.get("permissions", {}) in ({}, {"id-token": "write"}, PAGES), f"{file}: {name}"
            for step in job["steps"]:
                if step.get("uses", "").startswith("actions/checkout@"):
                    assert step["with"]["persist-credentials"] is False, f"{file}: the token stays on the disk"


def test_what_ci_and_the_action_install_is_what_the_lock_files_hash() -> None:
    action = [step["run"] for step in read(ROOT / "action.yml")["runs"]["steps"] if "run" in step]
    places = [*action, *((ROOT / name).read_text("utf-8").replace("\\\n", "") for name in (".ci/run", "Makefile"))]
    lines = [
        line.strip() for text in places for line in text.splitlines() if INSTALLS.search(line) and "pip()" not in line
    ]
    assert lines
    for line in lines:
        own = "--no-deps" in line and "--no-build-isolation" in line
        assert own or "--require-hashes" in line or "npm ci" in line or "pip compile" in line, line
    assert not [line for line in lines if "--no-build-isolation" in line and "--no-deps" not in line]


def test_what_builds_the_wheel_is_pinned_where_it_is_hashed() -> None:
    requires = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["build-system"]["requires"]
    hashed = (ROOT / "requirements/build.txt").read_text("utf-8")
    assert all(f"{one} \\\n    --hash=sha256:" in hashed for one in requires), requires


def test_rules_that_make_runs_beside_each_other_do_not_write_to_one_environment() -> None:
    """Two installations in one environment at once break each other: its pip was replaced while it ran."""
    listed = subprocess.run(
        ("make", "-C", str(ROOT), "-pqrR"), text=True, capture_output=True, timeout=600, check=False
    ).stdout
    rules = re.findall(r"^([^\s#:=]\S*):(?!=)([^=\n]*)\n((?:#.*\n|\t.*\n)*)", listed, re.MULTILINE)
    needs = {name: set(prerequisites.replace("|", " ").split()) for name, prerequisites, _ in rules}
    writers = {
        name for name, _, recipe in rules if re.search(r"\$\(BIN\)/python -m pip |--python \$\(BIN\)/python ", recipe)
    }
    assert writers == {".venv/run.stamp", ".venv/dev.stamp"}

    def reached(name: str) -> set[str]:
        return {name}.union(*(reached(one) for one in needs.get(name, ())))

    trial = ("make", "-C", str(ROOT), "--dry-run", "--old-file=.venv/dev.stamp", "engines")
    tried = subprocess.run(trial, text=True, capture_output=True, timeout=600, check=True).stdout
    beside = [line.split() for line in tried.splitlines() if "--jobs" in line]
    assert beside
    for words in [*beside, *(["make", name] for name in needs if name not in ("demo", ".PHONY"))]:
        goals = [word for word in words[1:] if not word.startswith("-")]
        assert len(set().union(*map(reached, goals)) & writers) <= 1, words
