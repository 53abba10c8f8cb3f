"""Another version of fogspec: one reason, said once, and no reason to replace what runs or to measure again."""

import json
from collections.abc import Callable, Iterator

import pytest

from fogspec.cli.options import open_manifest
from fogspec.compile import agent_archive, decision
from fogspec.deploy.preflight import check_fresh, launch_plan
from tests.e2e.test_diff import AT, commit, repository  # noqa: F401
from tests.support.deployed import Deployed, app, tiny  # noqa: F401
from tests.support.running import Shell, measure, shell  # noqa: F401

REASON = f"made by fogspec {decision.__version__}, this is 9.0.0"


@pytest.fixture
def upgrade(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], None]]:
    """Installs a later version, whose agent has other bytes and the same protocol."""

    def install() -> None:
        monkeypatch.setattr(decision, "__version__", "9.0.0")
        monkeypatch.setattr(agent_archive, "MAIN", agent_archive.MAIN + b"# of a later version\n")
        agent_archive.agent_archive.cache_clear()

    yield install
    monkeypatch.undo()
    agent_archive.agent_archive.cache_clear()


def started(name: str) -> tuple[str, bytes]:
    """What `apply --dry-run` would start, as the digest by which `apply` decides whether what runs stays; its manifest."""
    opened = open_manifest(name)
    check_fresh(opened)
    plan = launch_plan(opened, opened.inputs.catalog, None, False, str)
    return plan.candidates[0].runs, plan.content


@pytest.mark.parametrize("applications", [4, pytest.param(300, marks=[pytest.mark.rare, pytest.mark.timeout(7200)])])
def test_an_upgrade_is_one_reason_and_replaces_nothing(
    repository: Shell, upgrade: Callable[[], None], monkeypatch: pytest.MonkeyPatch, applications: int
) -> None:
    monkeypatch.chdir(repository.folder)
    text = repository.read("specs/demo.yaml")
    names = ["demo", *(f"demo-{number}" for number in range(1, applications))]
    for name in names[1:]:
        repository.neighbour(name, text.replace("name: demo", f"name: {name}"))
    repository("compile", *AT)
    for name in names[1:]:
        measure(repository, name=name)
    repository("compile", *AT)
    base = commit(repository, "many")
    repository("check", "-j", "1")
    before = {name: started(f"compiled/{name}/manifest.yaml") for name in names}
    upgrade()
    found = json.loads(repository("check", "-j", "1", "-o", "json", code=3).out)["applications"]
    assert {one["name"]: one["problems"] for one in found} == {
        name: [f"plan and manifest are stale: {REASON}"] for name in names
    }
    repository("compile", *AT)
    repository("check", "-j", "1")
    changed = json.loads(repository("diff", "--since", base, "-o", "json").out)["applications"]
    assert {one["name"]: (one["rollout"], one["to_measure"]) for one in changed} == {
        name: ("in_place", []) for name in names
    }
    for name in names:
        runs, content = started(f"compiled/{name}/manifest.yaml")
        assert runs == before[name][0], "the machine stays"
        assert content != before[name][1], "under another manifest"


def test_what_runs_is_kept_through_an_upgrade(tiny: Deployed, upgrade: Callable[[], None]) -> None:
    tiny.apply()
    (first,) = tiny.names()
    upgrade()
    tiny("compile")
    tiny.apply("--dry-run")
    tiny("watch", "tiny", "--once", code=None)
    assert tiny.names() == [first]
    assert "the machine stays, under the new manifest" in tiny.apply().stdout
    assert tiny.names() == [first]
    tiny("down", "tiny")


@pytest.mark.parametrize(
    ("name", "below"),
    [
        ("compiled/demo/plan.yaml", "spec:"),
        ("results/demo/aws-r1-a-small.yaml", "spec:"),
        ("compiled/demo/manifest.yaml", "pins:"),
    ],
)
def test_a_field_of_a_newer_version_is_no_reason_to_measure_again(
    repository: Shell,
    name: str,
    below: str,
) -> None:
    text = repository.read(name)
    repository.write(name, text.replace(f"\n{below}\n", f"\n{below}\n  provisioning_zone: a\n"))
    for verb in ("status", "check", "diff"):
        said = repository(verb, code=None)
        assert f"{below}provisioning_zone".replace(":", ".") + " is written by a newer fogspec" in said.out
        assert "fogspec bench" not in said.out + said.err
        assert "again" not in said.out + said.err
    refusing = ("apply", name, "--dry-run") if below == "pins:" else ("bench", "specs/demo.yaml")
    assert "upgrade fogspec: pip install --upgrade fogspec" in repository(*refusing, code=1).err
