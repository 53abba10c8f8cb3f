"""A repository that lives for years: applications are renamed, removed, moved, merged, and go over their budget."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from fogspec.base.layout import Layout
from fogspec.results.io import read_results, read_results_folder
from tests.e2e.test_diff import change, commit, git, repository  # noqa: F401
from tests.support.deployed import Deployed, app, tiny  # noqa: F401
from tests.support.results import first, remove, text, write
from tests.support.running import Shell, measure, project, shell, spec  # noqa: F401

AT = ("--catalog", "offers.csv")
PARAMETERS = "# for fogspec's example\n/**:\n  ros__parameters:\n    max_depth: 3\n"
KUBERNETES = (
    "apiVersion: argoproj.io/v1alpha1\nkind: Application\nmetadata: {name: fogspec}\nspec: {project: default}\n"
)


def files(folder: Path) -> set[str]:
    return {
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file() and not {".git", ".fogspec"} & set(path.relative_to(folder).parts)
    }


RENAME = """
git mv specs/demo.yaml specs/my-arm.yaml
git mv specs/demo.lock specs/my-arm.lock
sed -i 's/name: demo/name: my-arm/' specs/my-arm.yaml
git mv results/demo results/my-arm
git mv compiled/demo compiled/my-arm
"""


def test_a_renamed_application_keeps_its_measurements_and_its_choice(repository: Shell) -> None:
    before = repository.read("compiled/demo/manifest.yaml")
    measured = text(repository.folder / "results/demo")
    subprocess.run(["sh", "-euc", RENAME], cwd=repository.folder, check=True)
    repository("lock", *AT)
    repository("compile", *AT)
    assert text(repository.folder / "results/my-arm") == measured
    after = repository.read("compiled/my-arm/manifest.yaml")
    assert re.findall(r"instance: (\S+)", after) == re.findall(r"instance: (\S+)", before)
    assert "demo" not in after
    repository("check")
    assert "0 of 4 samples to measure" in repository("bench", "my-arm", "--runner", "local", "--dry-run").err
    assert not [name for name in files(repository.folder) if "demo" in name]


def test_branches_that_measured_different_samples_are_merged_by_git(repository: Shell) -> None:
    folder, results = repository.folder, repository.folder / "results/demo"
    measured = read_results_folder(results).spec
    parts = {"one": measured.samples[:2], "two": measured.samples[2:]}
    remove(results)
    commit(repository, "nothing measured")
    for branch, samples in parts.items():
        git(folder, "checkout", "-q", "-b", branch, "main")
        write(results, measured.model_copy(update={"samples": samples}))
        commit(repository, branch)
    git(folder, "merge", "-q", "-m", "both", "one")
    assert read_results_folder(results).spec == measured
    repository("compile", *AT)
    assert json.loads(repository("status", "-o", "json").out)[0]["to_measure"] == 0
    # What both measured conflicts in its own file only.
    git(folder, "checkout", "-q", "one")
    edited = measured.samples[0].model_copy(update={"requests": 77})
    write(results, measured.model_copy(update={"samples": [edited, measured.samples[1]]}))
    commit(repository, "again")
    git(folder, "checkout", "-q", "two")
    (edited,) = [one.model_copy(update={"requests": 78}) for one in measured.samples[:1]]
    write(results, measured.model_copy(update={"samples": [edited, *measured.samples[1:]]}))
    commit(repository, "again there")
    with pytest.raises(subprocess.CalledProcessError):
        git(folder, "merge", "-q", "one")
    conflicting = git(folder, "diff", "--name-only", "--diff-filter=U")
    assert conflicting == f"results/demo/{edited.id}.yaml"
    said = repository("check", code=3).out
    assert f"{conflicting}:" in said
    git(folder, "checkout", "--ours", conflicting)
    assert read_results_folder(results).spec.samples[0].requests == 78


def test_leftovers_are_listed_and_removed(repository: Shell) -> None:
    repository.write("results/demo/notes.txt", "mine")
    repository.write("results/notes/notes.yaml", "mine: 1\n")
    repository.write("compiled/pictures/a.svg", "mine")
    repository.neighbour("other", spec("other"))
    repository("compile", "other", *AT)
    (repository.folder / "specs/demo.yaml").unlink()
    assert "what has no spec is removed by: fogspec compile --prune" in repository("check", code=3).err
    assert "name none" in repository("compile", "--prune", "other", code=2).err
    before = files(repository.folder)
    said = repository("compile", "--prune", *AT, code=5).err
    assert "without a spec: demo: " in said
    assert "4 files in results/demo: 4 samples, $0.0183" in said
    assert "confirmation required" in said
    assert files(repository.folder) == before
    repository("compile", "--prune", "--yes", *AT)
    after = files(repository.folder)
    assert {name for name in after if "demo" in name} == {"results/demo/notes.txt"}
    assert {"results/notes/notes.yaml", "compiled/pictures/a.svg", "specs/other/other.yaml"} <= after
    assert not (repository.folder / "specs/demo.lock").exists()
    # The last one, too.
    (repository.folder / "specs/other/other.yaml").unlink()
    repository("compile", "--prune", "--yes")
    assert not (repository.folder / "compiled/other").exists()
    repository("compile", "--prune", "--yes")


def test_an_application_that_runs_is_not_pruned(tiny: Deployed) -> None:
    tiny.apply()
    try:
        text = (tiny.folder / "specs/tiny.yaml").read_text()
        (tiny.folder / "specs/tiny.yaml").unlink()
        ended = tiny("compile", "--prune", "--yes", code=5)
        assert "tiny runs: " in ended.stderr
        assert (tiny.folder / "compiled/tiny/manifest.yaml").exists()
    finally:
        (tiny.folder / "specs/tiny.yaml").write_text(text)
        tiny("down", "tiny")


def test_one_over_budget_does_not_stop_the_others(repository: Shell) -> None:
    repository.neighbour("a-dear", spec("a-dear", benchmark="{budget: $0.01, ready_timeout: 1min}"))
    repository.neighbour("b-narrow", spec("b-narrow", hardware="{cpus: 1000..2000}"))
    repository.neighbour("z-fine", spec("z-fine"))
    ended = repository("compile", *AT, code=4)
    assert "the budget is $0.01" in ended.err
    assert "b-narrow" in ended.err
    assert "z-fine" in ended.out
    assert (repository.folder / "compiled/z-fine/plan.yaml").exists()
    assert not (repository.folder / "compiled/a-dear").exists()
    (repository.folder / "specs/b-narrow/b-narrow.yaml").unlink()
    repository("compile", *AT, code=5)
    path = first(repository.folder / "results/demo")
    path.write_text(path.read_text().replace("requests: 20", "requests: 21", 1))
    ended = repository("compile", *AT, code=1)
    assert "integrity" in ended.err
    assert "the budget is $0.01" in ended.err
    said = repository("check", code=3).out
    assert "ok    a-dear  not compiled: nothing to deploy" in said
    assert "ok    z-fine" in said
    assert "FAIL  demo" in said


def test_other_yaml_files_beside_specs(repository: Shell) -> None:
    """Parameters of nodes, resources of Kubernetes and notes pass the hook and ci, also if they mention fogspec."""
    repository.write("specs/arm/params.yaml", PARAMETERS)
    repository.write("specs/argo.yaml", KUBERNETES)
    repository.write("specs/notes.yml", "# fogspec: to do\n- measure\n")
    repository("validate", "specs")
    # As all files beside the spec they are sent to machines, so that the results do not count with them.
    repository("check", code=3)
    said = repository("status").out
    assert all(f"{name} is new" in said for name in ("argo.yaml", "arm/params.yaml", "notes.yml")), said
    # A spec with a mistake in its head is still one.
    for wrong in ("apiVersion: fogspec.dev/v2", "apiversion: fogspec.dev/v1alpha1", '"apiVersion": fogspecdev'):
        repository.write("specs/wrong.yaml", spec("wrong").replace("apiVersion: fogspec.dev/v1alpha1", wrong))
        assert "specs/wrong.yaml" in repository("validate", "specs", code=1).err


def test_a_spec_in_a_subfolder_has_the_root_of_the_repository(repository: Shell) -> None:
    folder = repository.folder / "specs/arm"
    folder.mkdir()
    shutil.move(repository.folder / "specs/demo.yaml", folder / "demo.yaml")
    shutil.move(repository.folder / "specs/work.py", folder / "work.py")
    shutil.move(repository.folder / "specs/demo.lock", folder / "demo.lock")
    layout = Layout.of(folder / "demo.yaml", "demo")
    assert layout.root == repository.folder
    repository("lock", *AT)
    repository("compile")
    assert "fogspec compile specs/arm/demo.yaml" in repository.read("compiled/demo/manifest.yaml").partition("\n")[0]
    assert not (folder / "compiled").exists()
    results = read_results(layout)
    assert results is not None
    repository("check")
    repository("apply", "demo", "--dry-run")
    assert "fresh" in repository("status", "demo").out
    # The same from inside the folder, and for a file that only lies in a folder beside specs.
    Shell(folder, repository.monkeypatch, repository.capsys)("check", "demo.yaml")
    repository.write("drafts/demo.yaml", spec("draft"))
    assert Layout.of(repository.folder / "drafts/demo.yaml", "draft").root == repository.folder / "drafts"


def test_the_nearest_specs_within_the_repository_counts(tmp_path: Path) -> None:
    inner = tmp_path / "specs/project"
    inner.mkdir(parents=True)
    subprocess.run(["git", "init", "-q", inner], check=True)
    assert Layout.of(inner / "demo.yaml", "demo").root == inner
    assert Layout.of(inner / "a/specs/b/c/demo.yaml", "demo").root == inner / "a"
