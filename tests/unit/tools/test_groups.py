"""What `make test` leaves out is in a group of `make engines`, and each group is a job of the nightly workflow."""

import re
import subprocess

from ruamel.yaml import YAML

from tests.conftest import ROOT


def recipe(*words: str) -> str:
    """Return the commands that make would run, those of the makes that it starts too."""
    words = ("make", "--dry-run", "--always-make", "--old-file=.venv/dev.stamp", *words)
    return subprocess.run(words, cwd=ROOT, check=True, capture_output=True, text=True).stdout


def test_each_test_is_in_make_test_or_in_a_group() -> None:
    left_out = re.findall(r"--ignore=(\S+)", recipe("unit"))
    assert left_out
    assert [one for one in left_out if not (ROOT / one).exists()] == []
    tried = re.findall(r"-m pytest .*?(tests/\S+)", recipe("engines"))
    assert sorted(left_out) == sorted(one for one in tried if not one.startswith("tests/contract/"))
    assert any(one.startswith("tests/contract/") for one in tried)
    (one,) = re.findall(r"-m pytest .*?(tests/\S+)", recipe("engines", "GROUPS=slurm"))
    assert one == "tests/slurm"


def test_the_nightly_workflow_runs_each_group() -> None:
    workflow = YAML(typ="safe", pure=True).load(ROOT / ".github/workflows/engines.yml")
    groups = re.findall(r"--jobs=2 (.*)", recipe("engines"))[0].split()
    assert [f"{one}-test" for one in workflow["jobs"]["group"]["strategy"]["matrix"]["group"]] == groups
    assert workflow["jobs"]["group"]["steps"][-1]["run"] == '.ci/run "$GROUP"'
