"""Environments: overlays beside the specs, each with a manifest of its own, from one measurement."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from tests.e2e.test_check import AT, git, replaced
from tests.support.deployed import Deployed, app, tiny  # noqa: F401
from tests.support.running import Shell, copied, measure, project, shell  # noqa: F401

PROD = "spec:\n  objective: {alpha: 1}\n  constraints: {cost: $0.9/request}\n"
STAGING = "metadata: {name: demo}\nspec: {objective: {alpha: 0}, hardware: {cpus: 2..32}}\n"
OWN = ("compiled/demo@prod", "compiled/demo@staging")


def files(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and (path.suffix == ".lock" or path.relative_to(folder).parts[0] in ("compiled", "results"))
    }


def manifest(shell: Shell, name: str) -> dict[str, object]:
    return YAML(typ="safe", pure=True).load(shell.folder / "compiled" / name / "manifest.yaml")


@pytest.fixture
def repo(shell: Shell) -> Shell:
    """A committed application that is measured, with two environments."""

    def fill(made: Shell) -> None:
        project(made)
        made("lock", *AT)
        made("compile", *AT)
        measure(made)
        made("compile", *AT)
        made.write("environments/prod.yaml", PROD)
        made.write("environments/staging.yaml", STAGING)
        made("compile", *AT)
        git(made, "init", "-q")
        git(made, "add", "-A")
        git(made, "commit", "-qm", "all")

    copied(shell, "a repository with two environments", fill)
    return shell


def test_each_environment_has_a_manifest_and_all_have_one_measurement(repo: Shell) -> None:
    found = files(repo.folder)
    assert {name for name in found if name.endswith("plan.yaml")} == {"compiled/demo/plan.yaml"}
    assert {name for name in found if name.startswith("results/")} == {
        f"results/demo/{one.name}" for one in (repo.folder / "results/demo").iterdir()
    }
    assert {name for name in found if name.startswith(OWN) and name.endswith("plan.yaml")} == set()
    for folder in ("compiled/demo", *OWN):
        assert {f"{folder}/{name}" for name in ("models.yaml", "manifest.yaml", "menu.yaml", "deploy.sky.yaml")} <= set(
            found
        )
    prod, staging = manifest(repo, "demo@prod"), manifest(repo, "demo@staging")
    assert prod["metadata"] == {"name": "demo@prod"}
    assert prod["spec"]["instance"] != staging["spec"]["instance"], "latency alone and cost alone"
    every = (prod, staging, manifest(repo, "demo"))
    assert len({one["pins"]["plan"] for one in every}) == 1
    assert len({one["evidence"]["inputs"]["results"] for one in every}) == 1
    task = YAML(typ="safe", pure=True).load(repo.folder / "compiled/demo@prod/deploy.sky.yaml")
    assert task["resources"]["labels"] == {"fogspec-application": "demo", "fogspec-environment": "prod"}


def test_an_environment_changes_nothing_of_the_application(repo: Shell) -> None:
    before = files(repo.folder)
    for name in ("prod", "staging"):
        (repo.folder / f"environments/{name}.yaml").unlink()
    repo("compile", *AT)
    now = files(repo.folder)
    assert {name: one for name, one in now.items() if not name.startswith(OWN)} == {
        name: one for name, one in before.items() if not name.startswith(OWN)
    }
    said = repo("check", code=3)
    assert "compiled/demo@prod: no spec has an application of this name" in said.out


def test_compiling_again_and_one_alone_gives_the_same_bytes(repo: Shell) -> None:
    before = files(repo.folder)
    repo("compile", *AT)
    assert files(repo.folder) == before
    for name in [name for name in before if name.startswith("compiled/")]:
        (repo.folder / name).unlink()
    said = repo("compile", "demo@prod", *AT)
    assert said.out.startswith("demo@prod\n")
    assert files(repo.folder) == {
        name: one
        for name, one in before.items()
        if not name.startswith(("compiled/demo/", "compiled/demo@staging/"))
        or name == "compiled/demo/plan.yaml"
        or name.startswith(("compiled/demo/tasks/", "compiled/demo/scripts/measure"))
    }


VERBS = {
    "check": ("check",),
    "check one": ("check", "demo@prod"),
    "diff": ("diff", "--since", "HEAD", "demo@prod"),
    "apply": ("apply", "demo@prod", "--dry-run"),
}
TAMPERED: dict[str, Callable[[Shell], None]] = {
    "overlay": replaced("environments/prod.yaml", "alpha: 1", "alpha: 0.4"),
    "spec": replaced("specs/demo.yaml", "latency: 10s", "latency: 9s"),
    "plan": replaced("compiled/demo/plan.yaml", "^  duration: .*", "  duration: 9min"),
    "results": replaced("results/demo/aws-r1-a-small.yaml", "mean: .*", "mean: 1ms"),
    "models": replaced("compiled/demo@prod/models.yaml", "kind: .*", "kind: Models2"),
    "menu": replaced("compiled/demo@prod/menu.yaml", "predicted", "measured"),
    "manifest": replaced("compiled/demo@prod/manifest.yaml", "instance: .*", "instance: a.huge"),
    "deployment": replaced("compiled/demo@prod/deploy.sky.yaml", "run: ", "run: curl evil; "),
}


def codes(shell: Shell) -> dict[str, int]:
    return {name: shell.judged(*words).code for name, words in VERBS.items()}


def test_what_is_committed_passes_all(repo: Shell) -> None:
    assert codes(repo) == dict.fromkeys(VERBS, 0)
    said = repo("check").out
    assert [line.split()[:2] for line in said.splitlines()[:3]] == [
        ["ok", "demo"],
        ["ok", "demo@prod"],
        ["ok", "demo@staging"],
    ]
    assert repo("check", "-j", "2").out == said


@pytest.mark.parametrize("what", TAMPERED)
def test_what_was_tampered_with_passes_none(repo: Shell, what: str) -> None:
    TAMPERED[what](repo)
    assert {name for name, code in codes(repo).items() if not code} == set()


def test_only_the_environment_that_changed_is_judged(repo: Shell) -> None:
    replaced("environments/prod.yaml", "alpha: 1", "alpha: 0.4")(repo)
    said = json.loads(repo("check", "--since", "HEAD", "-o", "json", code=3).out)
    assert [one["name"] for one in said["applications"]] == ["demo@prod"]
    assert said["not_judged"] == ["demo", "demo@staging"]
    said = repo("diff", "--since", "HEAD", "--markdown").out
    assert "### demo@prod: the manifest is not fresh" in said
    assert "Not affected: demo, demo@staging." in said


def test_another_statistic_is_no_other_measurement(repo: Shell) -> None:
    before = files(repo.folder)["compiled/demo/models.yaml"]
    repo.write("environments/prod.yaml", PROD.replace("cost:", "statistic: p50, cost:"))
    said = repo("compile", "demo@prod", "-v", *AT, code=None)
    assert "compiled/demo@prod/models.yaml" in said.out
    assert files(repo.folder)["compiled/demo/models.yaml"] == before
    repo.write("environments/prod.yaml", PROD)
    repo("compile", *AT)
    assert repo("check").code == 0


def test_verbs_on_one_mean_the_default_environment_unless_named(repo: Shell) -> None:
    menus = {
        what: json.loads(repo("menu", what, "-o", "json").out) for what in ("demo", "specs/demo.yaml", "demo@prod")
    }
    assert [one["name"] for one in menus["demo"]] == ["demo"]
    assert menus["specs/demo.yaml"] == menus["demo"]
    assert [one["name"] for one in menus["demo@prod"]] == ["demo@prod"]
    by_name = repo("menu", "specs/demo.yaml", "--name", "demo@prod", "-o", "json").out
    assert json.loads(by_name) == menus["demo@prod"]
    assert "demo@prod" in repo("explain", "demo@prod").out
    assert "compiled/demo@prod/report.html" in repo("report", "demo@prod").out
    assert "alpha: 1.0" in repo("validate", "demo@prod", "-o", "yaml").out
    assert "alpha: 0.5" in repo("validate", "demo", "-o", "yaml").out
    assert repo("validate", "demo@prod", "-o", "yaml").out.count("environments/prod.yaml:2") == 1
    assert "3 applications in 1 file valid: demo, demo@prod, demo@staging" in repo("validate").out
    resources = json.loads(repo("check", "demo@prod", "-o", "statement").out)["predicate"]["buildDefinition"][
        "resolvedDependencies"
    ]
    assert [one["uri"] for one in resources if one["name"] == "overlay"] == ["environments/prod.yaml"]


def test_a_bench_of_an_environment_names_the_one_that_serves_it(repo: Shell) -> None:
    said = repo("bench", "demo@prod", "--dry-run", code=2)
    assert "what is measured of demo serves all of its environments" in said.err
    assert "fogspec bench demo" in said.err


def test_unknown_environments_are_answered_with_a_near_one(repo: Shell) -> None:
    for verb in ("compile", "menu", "apply", "check", "down", "logs"):
        assert "did you mean demo@prod?" in repo(verb, "demo@prdo", code=2).err, verb
    assert "looked for .fogspec/zzz" in repo("down", "zzz", code=2).err


def test_a_field_that_all_share_is_refused_where_it_stands(repo: Shell) -> None:
    for text, field, line in (
        ("spec: {benchmark: {budget: $9}}\n", "spec.benchmark.budget", 1),
        ("spec:\n  secrets: [TOKEN]\n", "spec.secrets", 2),
        ("spec:\n  files: [work.py]\n", "spec.files", 2),
        ("spec:\n  cloud: [{cmd: [python3, work.py, fast]}]\n", "spec.cloud", 2),
        ("spec:\n  probe: {callback: plan, timeout: 3s}\n", "spec.probe.timeout", 2),
        ("spec:\n  benchmark: {sampler: adaptive}\n", "spec.benchmark.sampler", 2),
    ):
        before = files(repo.folder)
        repo.write("environments/prod.yaml", text)
        said = repo("compile", *AT, code=1).err
        assert f"error[FS553]: {field} of environment prod differs" in said, said
        assert f"environments/prod.yaml:{line}:" in said
        assert files(repo.folder) == before
    repo.write("environments/prod.yaml", "spec: {benchmark: {budget: $5}}\n")
    repo("validate")


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("metadata: {name: domo}\nspec: {objective: {alpha: 1}}\n", "FS551"),
        ("metadata: {name: [demo]}\nspec: {objective: {alpha: 1}}\n", "FS551"),
        ("", "FS114"),
        ("# nothing\n", "FS114"),
        ("spec: {objective: {alfa: 1}}\n", "FS301"),
        ("spec: {constraints: {latency: 2}}\n", "FS20"),
        ("- a list\n", "FS"),
        ("spec: [\n", "FS1"),
        ("spec: {objective: {metric: length}}\n", "FS5"),
        ("spec: {infra: []}\n", "FS"),
    ],
)
def test_a_wrong_overlay_is_one_located_error_and_nothing_is_written(repo: Shell, text: str, code: str) -> None:
    before = files(repo.folder)
    repo.write("environments/prod.yaml", text)
    for words in (("validate",), ("compile", *AT), ("check",), ("status",)):
        said = repo(*words, code=1).err
        assert f"error[{code}" in said, said
        assert "environments/prod.yaml:" in said, said
    assert files(repo.folder) == before


def test_what_an_overlay_makes_wrong_elsewhere_names_the_environment(repo: Shell) -> None:
    repo.write("specs/demo.yaml", repo.read("specs/demo.yaml").replace("cpus: 2..8", "cpus: 2..8, gpus: [none]"))
    repo.write("environments/prod.yaml", "spec: {hardware: {cpus: 9..2}}\n")
    assert "environments/prod.yaml:1" in repo("validate", code=1).err


def test_an_overlay_for_another_spec_is_found_also_if_one_is_read(repo: Shell) -> None:
    repo.neighbour("other", repo.read("specs/demo.yaml").replace("name: demo", 'name: "oth\\x65r"'))
    repo.write("environments/prod.yaml", "metadata: {name: other}\nspec: {objective: {alpha: 1}}\n")
    assert "2 applications in 1 file valid: demo, demo@staging" in repo("validate", "specs/demo.yaml").out
    assert "other@prod" in repo("validate").out


def test_environments_that_are_links_are_not_followed(repo: Shell, tmp_path: Path) -> None:
    (tmp_path / "outside.yaml").write_text(PROD)
    (repo.folder / "environments/away.yaml").symlink_to(tmp_path / "outside.yaml")
    assert "environments/away.yaml: it is a link" in repo("validate", code=1).err


def test_a_single_spec_has_no_environments(repo: Shell) -> None:
    repo.write("one/demo.yaml", repo.read("specs/demo.yaml"))
    repo.write("one/work.py", "print('work')\n")
    repo.write("one/environments/kitchen.yaml", "walls: [1, 2]\n")
    assert "1 application in 1 file valid: demo" in repo("validate", "one/demo.yaml").out


def test_two_environments_run_beside_one_another(tiny: Deployed) -> None:
    (tiny.folder / "environments").mkdir()
    (tiny.folder / "environments/prod.yaml").write_text("spec: {objective: {alpha: 1}}\n")
    tiny("compile")
    tiny.apply()
    said = tiny("apply", "tiny@prod", "--yes").stdout
    assert "next: fogspec status tiny@prod" in said
    found = json.loads(tiny("status", "-o", "json").stdout)
    assert [(one["name"], one["has_spec"]) for one in found] == [("tiny", True), ("tiny@prod", True)]
    first, second = (one["deployment"]["machines"][0]["name"] for one in found)
    assert first.split("-")[1] != second.split("-")[1], "another owner"
    assert "-tiny-prod-" in second
    tiny("logs", "tiny@prod")
    assert "1 ended" in tiny("down", "tiny").stdout
    live = json.loads(tiny("status", "-o", "json").stdout)
    assert [one["deployment"] is not None for one in live] == [False, True]
    assert "no changes" in tiny("apply", "tiny@prod", "--yes").stdout
    (tiny.folder / "environments/prod.yaml").unlink()
    assert "tiny@prod (no spec)" in tiny("status").stdout
    assert "1 ended" in tiny("down", "tiny@prod").stdout
    assert "running" not in tiny("status").stdout


def test_a_renamed_application_keeps_its_environments(repo: Shell) -> None:
    before = files(repo.folder)
    for folder in ("results", "compiled", "specs"):
        for path in (repo.folder / folder).glob("demo*"):
            path.rename(path.with_name(path.name.replace("demo", "arm")))
    for name in ("specs/arm.yaml", "environments/staging.yaml"):
        repo.write(name, repo.read(name).replace("name: demo", "name: arm"))
    repo("compile", *AT)
    assert repo.read("environments/prod.yaml") == PROD
    assert set(files(repo.folder)) == {name.replace("/demo", "/arm") for name in before}
    assert repo("check").out.count("manifest verified") == 3


def test_pruning_an_environment_leaves_what_is_shared(repo: Shell) -> None:
    before = files(repo.folder)
    (repo.folder / "environments/prod.yaml").unlink()
    said = repo("compile", *AT, "--prune", "--yes")
    assert "without a spec: demo@prod: " in said.err
    after = files(repo.folder)
    assert after == {name: one for name, one in before.items() if not name.startswith("compiled/demo@prod/")}
    assert repo("check").code == 0
