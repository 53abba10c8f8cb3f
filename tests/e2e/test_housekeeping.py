"""A repository that lives for years: applications are renamed and removed, moved into folders, and go over their budget."""

import shutil
import subprocess
from pathlib import Path

import pytest

from fogspec.audit.verify import verify
from fogspec.base.layout import Layout
from fogspec.compile.bundle import open_bundle
from fogspec.results.io import read_results
from tests.e2e.test_review import change, commit, git, repository  # noqa: F401
from tests.support.deployed import Deployed, app, tiny  # noqa: F401
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


def test_a_renamed_application_keeps_its_measurements_and_its_choice(
    repository: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    timings = repository.write("results/demo/timings/a.jsonl.gz", "of no record")
    repository.write("compiled/demo/notes.md", "ours")
    before = files(repository.folder)
    said = repository("mv", "demo", "my-arm")
    assert "demo is my-arm now, in specs/my-arm.yaml" in said.out
    assert "compiled/demo/notes.md: not fogspec's, left there" in said.err
    after = files(repository.folder)
    assert after == {name if name.endswith("notes.md") else name.replace("/demo", "/my-arm") for name in before}
    assert not timings.exists()
    assert "name: my-arm" in repository.read("specs/my-arm.yaml")
    assert "demo" not in repository.read("compiled/my-arm/manifest.yaml")
    monkeypatch.chdir(repository.folder)
    opened = open_bundle("compiled/my-arm/manifest.yaml")
    assert [link for link in verify(opened) if link.breaks] == []
    repository("ci")
    repository("compile", "--check")
    repository("lock", "--check")
    assert "a.large in aws/r1" in repository("review", "HEAD").out
    # And back again: the same bytes.
    shutil.rmtree(repository.folder / "compiled/demo")
    repository("mv", "specs/my-arm.yaml", "demo")
    shutil.rmtree(repository.folder / "results/demo")
    assert git(repository.folder, "status", "--porcelain") == ""


@pytest.mark.parametrize("name", ["Demo", "a/b", "../x", "-x", "", "x" * 64, "a b", "$(id)", "demo", "other"])
def test_a_name_that_cannot_be(repository: Shell, name: str) -> None:
    repository.write("specs/other.yaml", spec("other"))
    before = files(repository.folder)
    ended = repository("mv", "--", "demo", name, code=2)
    assert ended.err.count("\n") <= 3
    assert files(repository.folder) == before
    assert git(repository.folder, "status", "--porcelain") == "?? specs/other.yaml"


def test_what_is_there_already_is_not_written_over(repository: Shell) -> None:
    for name in ("results/new.yaml", "compiled/new/x", "specs/new.yaml"):
        path = repository.write(name, "x: 1\n")
        assert f"{name.removesuffix('/x')} is there already" in repository("mv", "demo", "new", code=2).err
        path.unlink()
        for folder in (path.parent, path.parent.parent):
            if not any(folder.iterdir()) and folder != repository.folder:
                folder.rmdir()
    repository("mv", "demo", "new")


def test_a_name_that_yaml_would_read_as_something_else(shell: Shell) -> None:
    project(shell)
    shell.write("specs/demo.yaml", spec().replace("{name: demo}", "{name: 'demo'}  # the arm"))
    for name in ("no", "123", "1e3"):
        shell("mv", "demo", name, *AT)
        assert f'name: "{name}"}}  # the arm' in shell.read(f"specs/{name}.yaml")
        shell("validate", "specs")
        shell("mv", name, "demo", *AT)


def test_damaged_results_and_two_applications_in_a_file(shell: Shell) -> None:
    project(shell)
    measure(shell)
    before = shell.read("results/demo.yaml")
    shell.write("results/demo.yaml", before.replace("requests: 20", "requests: 21", 1))
    assert "integrity" in shell("mv", "demo", "new", code=1).err
    assert not (shell.folder / "specs/new.yaml").exists()
    shell.write("results/demo.yaml", before)
    shell.write("specs/both.yaml", f"{spec('one')}---\n{spec('two')}")
    assert "has several applications: one, two" in shell("mv", "specs/both.yaml", "new", code=2).err
    shell("compile", "two", *AT)
    assert "no machine in aws/r1" in shell("mv", "two", "three", code=4).err, (
        "without the catalog it cannot be compiled"
    )
    assert "{name: two}" in shell.read("specs/both.yaml")
    shell("mv", "two", "three", *AT)
    assert (shell.folder / "compiled/three/plan.yaml").exists()
    assert not (shell.folder / "compiled/two").exists()
    assert "{name: one}" in shell.read("specs/both.yaml")
    assert "{name: three}" in shell.read("specs/both.yaml")


def test_a_stale_manifest_is_not_lost(repository: Shell) -> None:
    change(repository, "cmd: [python3, work.py]", "cmd: [python3, work.py, fast]")
    repository("compile", "specs/demo.yaml", code=None)
    assert "is stale" in repository("mv", "demo", "new", code=3).err
    assert (repository.folder / "compiled/demo/manifest.yaml").exists()


def test_a_partial_manifest_stays_partial(shell: Shell) -> None:
    project(shell)
    measure(shell, only=2)
    shell("compile", *AT, "--partial")
    shell("lock", *AT)
    shell("compile", "--partial")
    shell("mv", "demo", "new")
    assert "partial" in shell.read("compiled/new/manifest.yaml")
    shell("compile", "--check")


def test_what_runs_is_not_renamed(tiny: Deployed) -> None:
    tiny.apply()
    try:
        ended = tiny("mv", "tiny", "small", code=5)
        assert "tiny runs: fogspec-" in ended.stderr
        assert "end it: fogspec down tiny" in ended.stderr
        assert (tiny.folder / "specs/tiny.yaml").exists()
    finally:
        tiny("down", "tiny")
    tiny("mv", "tiny", "small")
    tiny("apply", "small", "--dry-run")


def test_leftovers_are_listed_and_removed(repository: Shell) -> None:
    shutil.copy(repository.folder / "results/demo.yaml", repository.folder / "results/demo.yaml.bak")
    repository.write("results/notes.yaml", "mine: 1\n")
    repository.write("compiled/pictures/a.svg", "mine")
    repository.write("specs/other.yaml", spec("other"))
    repository("compile", "other", *AT)
    (repository.folder / "specs/demo.yaml").unlink()
    assert "what has no spec is removed by: fogspec compile --prune" in repository("ci", *AT, code=3).err
    assert "name none" in repository("compile", "--prune", "other", code=2).err
    before = files(repository.folder)
    said = repository("compile", "--prune", *AT, code=5).err
    assert "without a spec: demo: " in said
    assert "results/demo.yaml: 4 samples, $0.0183" in said
    assert "confirmation required" in said
    repository("compile", "--prune", "--check", *AT, code=3)
    assert files(repository.folder) == before
    repository("compile", "--prune", "--yes", *AT)
    after = files(repository.folder)
    assert {name for name in after if "demo" in name} == {"results/demo.yaml.bak"}
    assert {"results/notes.yaml", "compiled/pictures/a.svg", "specs/other.yaml"} <= after
    assert "demo" not in repository.read("fogspec.lock")
    # The last one, too.
    (repository.folder / "specs/other.yaml").unlink()
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
    repository.write("specs/a-dear.yaml", spec("a-dear", benchmark="{budget: $0.01, setup_timeout: 1min}"))
    repository.write("specs/b-narrow.yaml", spec("b-narrow", hardware="{cpus: 1000..2000}"))
    repository.write("specs/z-fine.yaml", spec("z-fine"))
    ended = repository("compile", *AT, code=4)
    assert "the budget is $0.01" in ended.err
    assert "b-narrow" in ended.err
    assert "z-fine" in ended.out
    assert (repository.folder / "compiled/z-fine/plan.yaml").exists()
    assert not (repository.folder / "compiled/a-dear").exists()
    (repository.folder / "specs/b-narrow.yaml").unlink()
    repository("compile", *AT, code=5)
    repository.write(
        "results/demo.yaml", repository.read("results/demo.yaml").replace("requests: 20", "requests: 21", 1)
    )
    ended = repository("compile", *AT, code=1)
    assert "integrity" in ended.err
    assert "the budget is $0.01" in ended.err
    said = repository("ci", *AT, code=3).out
    assert "FAIL  a-dear" in said
    assert "ok    z-fine" in said
    assert "FAIL  demo" in said


def test_other_yaml_files_beside_specs(repository: Shell) -> None:
    """Parameters of nodes, resources of Kubernetes and notes pass the hook and ci, also if they mention fogspec."""
    repository.write("specs/arm/params.yaml", PARAMETERS)
    repository.write("specs/argo.yaml", KUBERNETES)
    repository.write("specs/notes.yml", "# fogspec: to do\n- measure\n")
    repository("validate", "specs")
    # As all files beside the spec they are sent to machines, so that the lock knows them.
    assert "1 application: 1 failed" in repository("ci", code=3).out
    repository("lock")
    repository("lock", "--check")
    # A spec with a mistake in its head is still one.
    for wrong in ("apiVersion: fogspec.dev/v2", "apiversion: fogspec.dev/v1alpha1", '"apiVersion": fogspecdev'):
        repository.write("specs/wrong.yaml", spec("wrong").replace("apiVersion: fogspec.dev/v1alpha1", wrong))
        assert "specs/wrong.yaml" in repository("validate", "specs", code=1).err


def test_a_spec_in_a_subfolder_has_the_root_of_the_repository(repository: Shell) -> None:
    folder = repository.folder / "specs/arm"
    folder.mkdir()
    shutil.move(repository.folder / "specs/demo.yaml", folder / "demo.yaml")
    shutil.move(repository.folder / "specs/work.py", folder / "work.py")
    layout = Layout.of(folder / "demo.yaml", "demo")
    assert layout.root == repository.folder
    repository("lock", *AT)
    repository("compile")
    assert "from specs/arm/demo.yaml" in repository.read("compiled/demo/manifest.yaml").partition("\n")[0]
    assert not (folder / "compiled").exists()
    results = read_results(layout)
    assert results is not None
    repository("ci")
    repository("apply", "demo", "--dry-run")
    assert "fresh" in repository("status", "demo").out
    # The same from inside the folder, and for a file that only lies in a folder beside specs.
    Shell(folder, repository.monkeypatch, repository.capsys)("compile", "demo.yaml", "--check")
    repository.write("drafts/demo.yaml", spec("draft"))
    assert Layout.of(repository.folder / "drafts/demo.yaml", "draft").root == repository.folder / "drafts"


def test_the_nearest_specs_within_the_repository_counts(tmp_path: Path) -> None:
    inner = tmp_path / "specs/project"
    inner.mkdir(parents=True)
    subprocess.run(["git", "init", "-q", inner], check=True)
    assert Layout.of(inner / "demo.yaml", "demo").root == inner
    assert Layout.of(inner / "a/specs/b/c/demo.yaml", "demo").root == inner / "a"
