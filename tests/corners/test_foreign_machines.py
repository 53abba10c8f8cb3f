"""Machines are touched by the application that started them, by no other: neither a copied record nor a fork leads to them."""

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from fogspec.backends.naming import OWNER_LABEL
from tests.support import deployed
from tests.support.deployed import Deployed, app  # noqa: F401
from tests.support.deployed_cloud import MANIFEST
from tests.support.deployed_cloud import cloud as plain  # noqa: F401
from tests.support.fake_sky import Cloud
from tests.support.running import Shell, shell  # noqa: F401

ORIGIN = "https://forge.test/lab/robots.git"


def journal(one: Deployed, name: str) -> bytes:
    """A journal in which a bench has just started a machine of this name."""
    machine = {"infra": "local", "instance": "1cpu-1gib", "cpus": 1, "memory": "1GiB", "price": "$0.02/h"}
    sample = {"id": "local-1cpu-1gib", "reason": "", "machine": machine}
    entry = {"do": "start", "name": name, "runner": "local", "application": "x", "sample": sample, "at_s": 0.0,
             "price_usd_per_hour": 0.02, "lifetime_s": 60.0, "paid_s": 90.0, "at_unix_s": 1.0, "boot": "b"}  # fmt: skip
    one.state.mkdir(parents=True, exist_ok=True)
    (one.state / "journal.jsonl").write_text(json.dumps(entry) + "\n")
    return (one.state / "journal.jsonl").read_bytes()


def test_a_copied_record_leads_no_command_to_anothers_processes(app: Callable[..., Deployed]) -> None:
    theirs, mine = app(), app()
    theirs.apply()
    (name,), running = theirs.names(), theirs.alive()
    assert running
    shutil.copytree(theirs.state, mine.state)
    record = (mine.state / "deployment.yaml").read_bytes()
    for words in (["status"], ["apply", deployed.MANIFEST, "--yes"], ["down", "tiny"], ["down", "specs/tiny.yaml"]):
        ended = mine(*words, code=5)
        assert f"{name}, which is not a machine of tiny of file://" in ended.stderr, words
        assert (mine.state / "deployment.yaml").read_bytes() == record, words
        assert theirs.alive() == running, words
    (mine.state / "deployment.yaml").unlink()
    before = journal(mine, name)
    ended = mine("bench", "specs/tiny.yaml", "--runner", "local", "--only", "local-1cpu-1gib", code=5)
    assert name in ended.stderr
    assert (mine.state / "journal.jsonl").read_bytes() == before
    assert theirs.alive() == running
    theirs("down", "tiny")
    assert theirs.alive() == []


def test_what_is_the_applications_is_ended_beside_a_foreign_record(app: Callable[..., Deployed]) -> None:
    theirs, mine = app(), app()
    theirs.apply()
    mine.apply()
    (name,), running = theirs.names(), theirs.alive()
    path = mine.state / "deployment.yaml"
    entry = (theirs.state / "deployment.yaml").read_text().partition("machines:\n")[2].partition("  spent:")[0]
    path.write_text(path.read_text().replace("machines:\n", f"machines:\n{entry}"))
    assert len(mine.names()) == 2
    assert name in mine("down", "tiny", code=5).stderr
    assert mine.alive() == []
    assert mine.names() == [name], "the record that is not ours is kept"
    assert theirs.alive() == running


@pytest.fixture
def cloud(shell: Shell, plain: Cloud) -> Cloud:
    subprocess.run(["git", "init", "-q"], cwd=shell.folder, check=True)
    subprocess.run(["git", "remote", "add", "origin", ORIGIN], cwd=shell.folder, check=True)
    return plain


def clone(shell: Shell, name: str, origin: str) -> Shell:
    folder = shell.folder.parent / name
    shutil.copytree(shell.folder, folder, ignore=shutil.ignore_patterns(".fogspec"))
    subprocess.run(["git", "remote", "set-url", "origin", origin], cwd=folder, check=True)
    return Shell(folder, shell.monkeypatch, shell.capsys)


def test_a_fresh_clone_finds_what_runs_and_a_fork_does_not(shell: Shell, cloud: Cloud) -> None:
    shell("apply", MANIFEST, "--yes")
    (name,) = cloud.machines
    assert cloud.machines[name].labels["fogspec-application"] == "demo"
    assert len(cloud.machines[name].labels[OWNER_LABEL]) == 52
    fork = clone(shell, "fork", "https://forge.test/fork/robots.git")
    assert "nothing runs" in fork("down", "demo").out
    shutil.copytree(shell.folder / ".fogspec", fork.folder / ".fogspec")
    assert name in fork("down", "demo", code=5).err
    assert list(cloud.machines) == [name]
    again = clone(shell, "again", "git@forge.test:lab/robots")
    assert name in again("apply", MANIFEST, "--yes", code=5).err
    assert "1 ended" in again("down", "demo").out
    assert cloud.machines == {}


def test_a_name_with_anothers_label_is_left_alone(shell: Shell, cloud: Cloud) -> None:
    shell("apply", MANIFEST, "--yes")
    (name,) = cloud.machines
    cloud.machines[name].labels = {**cloud.machines[name].labels, OWNER_LABEL: "a" * 52}
    assert "nothing runs" in clone(shell, "again", ORIGIN)("down", "demo").out
    assert list(cloud.machines) == [name]


def test_a_committed_file_does_not_forge_an_origin(shell: Shell, cloud: Cloud) -> None:
    shell("apply", MANIFEST, "--yes")
    fork = clone(shell, "fork", "https://forge.test/fork/robots.git")
    for place in (".gitconfig", "specs/config", "config", ".gitmodules"):
        fork.write(place, f'[remote "origin"]\n\turl = {ORIGIN}\n')
    os.environ["GIT_DIR"] = str(Path(shell.folder) / ".git")
    try:
        assert "nothing runs" in fork("down", "demo").out
    finally:
        del os.environ["GIT_DIR"]
    assert len(cloud.machines) == 1
