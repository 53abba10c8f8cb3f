"""What GitHub reads is what GitHub takes: against the schemas that are published for it, and the shell's own critic."""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from fogspec import __version__

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
    subprocess.run(words, check=True, timeout=60)


def scripts() -> list[tuple[str, str]]:
    jobs = [("action.yml", read(ROOT / "action.yml")["runs"])]
    jobs += [(path.name, job) for path in CHECKED["vendor.github-workflows"] for job in read(path)["jobs"].values()]
    return [(f"{name} {one.get('name', '')}", one["run"]) for name, job in jobs for one in job["steps"] if "run" in one]


@pytest.mark.parametrize(("name", "script"), scripts())
def test_run_steps_are_sound_shell(name: str, script: str) -> None:
    if shutil.which("shellcheck") is None:
        pytest.skip("needs shellcheck: apt-get install shellcheck")
    assert "${{" not in script, "values reach a script by its environment, never by its text"
    ended = subprocess.run(BASH, input=script, text=True, capture_output=True, timeout=60, check=False)
    assert ended.returncode == 0, ended.stdout


def test_ci_runs_what_the_repository_says_it_runs() -> None:
    steps = read(GITHUB / "workflows/ci.yml")["jobs"]["test"]["steps"]
    assert ".ci/run" in [one.get("run") for one in steps]
    assert "make test" in (ROOT / ".ci/run").read_text("utf-8").splitlines()


def test_publishing_needs_no_token_and_nothing_else_may_write() -> None:
    release = read(GITHUB / "workflows/release.yml")
    assert release["permissions"] == {"contents": "read"}
    assert release["jobs"]["publish"]["permissions"] == {"id-token": "write"}
    assert "secrets." not in (GITHUB / "workflows/release.yml").read_text("utf-8")


def test_every_place_names_the_same_version() -> None:
    assert read(ROOT / "CITATION.cff")["version"] == __version__
