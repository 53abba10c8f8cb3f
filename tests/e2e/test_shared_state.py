"""The live state in refs of the repository: two clones of it, a bare remote, and what runs on this host."""

import json
import os
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from fogspec.backends import registry
from fogspec.backends.local.backend import LocalDeployments
from fogspec.deploy import git_store, shared_state
from fogspec.deploy.git_store import GitStore
from tests.support.deployed import Deployed, app  # noqa: F401
from tests.support.fake_sky import Cloud, beside
from tests.support.forking import forked
from tests.support.scenes import until

PROJECT = "apiVersion: fogspec.dev/v1alpha1\nkind: Project\nspec: {state: git}\n"
REF = "refs/fogspec/state/"


def git(*words: str, folder: Path) -> str:
    who = ("-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false")
    done = subprocess.run(["git", *who, *words], cwd=folder, check=True, capture_output=True, text=True)
    return done.stdout.strip()


@dataclass
class Team:
    """The remote, and clones of it: `first` is where the application was made."""

    remote: Path
    first: Deployed
    clones: list[Deployed]

    def clone(self) -> Deployed:
        folder = self.remote.parent / f"clone-{len(self.clones)}"
        git("clone", "-q", str(self.remote), str(folder), folder=self.remote.parent)
        self.clones.append(Deployed(folder))
        return self.clones[-1]

    def refs(self) -> list[str]:
        return git("for-each-ref", "--format=%(refname)", REF, folder=self.remote).split()

    def record(self) -> str:
        (ref,) = self.refs()
        return git("show", f"{ref}:state.yaml", folder=self.remote)

    def alive(self) -> int:
        return sum(len(one.alive()) > 0 for one in (self.first, *self.clones))

    def put(self, content: str, ref: str | None = None) -> None:
        """Write a record as somebody with another program would."""
        blob = subprocess.run(
            ["git", "hash-object", "-w", "--stdin"],
            cwd=self.remote,
            input=content,
            check=True,
            capture_output=True,
            text=True,
        ).stdout.strip()
        tree = subprocess.run(
            ["git", "mktree"], cwd=self.remote, input=f"100644 blob {blob}\tstate.yaml\n", check=True, capture_output=True,
            text=True,
        ).stdout.strip()  # fmt: skip
        commit = git("commit-tree", tree, "-m", "by hand", folder=self.remote)
        git("update-ref", ref or self.refs()[0], commit, folder=self.remote)


@pytest.fixture
def team(app: Callable[..., Deployed], tmp_path: Path) -> Iterator[Team]:
    first, remote = app(), tmp_path / "remote.git"
    git("init", "-q", "--bare", str(remote), folder=tmp_path)
    (first.folder / "fogspec.yaml").write_text(PROJECT)
    (first.folder / ".gitignore").write_text(".fogspec/\n")
    for words in (["init", "-q"], ["add", "."], ["commit", "-qm", "all"], ["remote", "add", "origin", str(remote)],
                  ["push", "-q", "origin", "HEAD:master"]):  # fmt: skip
        git(*words, folder=first.folder)
    git("symbolic-ref", "HEAD", "refs/heads/master", folder=remote)
    made = Team(remote, first, [])
    yield made
    for one in made.clones:
        one.kill()


def test_a_fresh_clone_sees_updates_and_ends_what_another_started(team: Team) -> None:
    team.first.apply()
    assert not (team.first.state / "deployment.yaml").exists()
    assert "lease: null" in team.record()
    other = team.clone()
    live = other.status()
    assert (live["sync"], live["health"]) == ("Synced", "Healthy")
    (name,) = [one["name"] for one in live["machines"]]
    assert name in other("ps", "-o", "json").stdout
    assert "no changes" in other.apply().stdout
    other.change("latency: 1s", "latency: 2s")
    other("compile", "specs/tiny.yaml")
    assert "the machine stays, under the new manifest" in other.apply().stdout
    assert team.first.status()["sync"] == "OutOfSync", "the first clone has the manifest of before"
    assert team.first.alive(), "without downtime"
    down = other("down", "tiny")
    assert "1 ended" in down.stdout
    assert (team.refs(), team.alive()) == ([], 0)
    assert team.first.status() is None


def test_a_replaced_machine_of_another_clone_ends_after_the_new_one_answers(team: Team) -> None:
    team.first.apply()
    other = team.clone()
    (old,) = [one["name"] for one in other.status()["machines"]]
    team.first.kill()
    until(lambda: not team.first.alive())
    assert other.status()["health"] == "Missing"
    assert f"{old}: gone" in other.apply().stderr
    assert other.status()["health"] == "Healthy"
    assert (bool(team.first.alive()), bool(other.alive())) == (False, True)
    assert "nothing is left" in team.first("down", "tiny").stdout
    assert team.alive() == 0


def test_what_runs_without_a_spec_is_in_status_and_in_the_gate(team: Team) -> None:
    team.first.apply()
    other = team.clone()
    for name in ("specs/tiny.yaml", "specs/work.py"):
        (other.folder / name).unlink()
    shutil.rmtree(other.folder / "compiled/tiny")
    shutil.rmtree(other.folder / "results")
    (other.folder / "specs/another.yaml").write_text(
        (team.first.folder / "specs/tiny.yaml").read_text().replace("name: tiny", "name: another")
    )
    shutil.copy(team.first.folder / "specs/work.py", other.folder / "specs/work.py")
    other("lock", "--catalog", "hosts.csv")
    other("compile")
    said = other("status").stdout
    assert "tiny: no spec has an application of this name, and fogspec-" in said
    assert "tiny" in other("status", "--exit-code", code=3).stderr
    assert "FAIL  tiny: no spec has an application of this name" in other("ci", code=3).stdout
    assert [one["has_spec"] for one in json.loads(other("ps", "-o", "json").stdout)] == [False]
    assert "1 ended" in other("down", "tiny").stdout
    assert "tiny" not in other("ci", code=None).stdout


def test_two_at_once_start_one_machine(team: Team) -> None:
    both = [team.first, team.clone()]
    begun = [one.begin("apply", "compiled/tiny/manifest.yaml", "--yes") for one in both]
    ended = [(one.communicate()[1], one.returncode) for one in begun]
    codes = sorted(code for _, code in ended)
    assert codes in ([0, 0], [0, 8]), ended
    if codes == [0, 8]:
        (refused,) = [said for said, code in ended if code == 8]
        assert "apply of tiny must wait: apply of tiny on" in refused
    assert team.alive() == 1
    assert len(team.clones[0].status()["machines"]) == 1
    team.first("down", "tiny")
    assert (team.alive(), team.refs()) == (0, [])


def steps() -> tuple[tuple[object, str], ...]:
    """What an apply does in order, before and after which it may be killed."""
    return ((GitStore, "write"), (LocalDeployments, "start"), (LocalDeployments, "stop"))


@pytest.mark.slow
@pytest.mark.parametrize("before", [True, False])
@pytest.mark.parametrize("at", range(1, 7))
def test_killed_between_two_steps(team: Team, at: int, before: bool) -> None:
    """Whatever was done, another clone goes on: one machine, and after down none."""

    def put() -> None:
        count = iter(range(1, 1000))

        def wrapped(step: Callable[..., object]) -> Callable[..., object]:
            def call(*words: object, **named: object) -> object:
                mine = next(count) == at
                if mine and before:
                    os.kill(os.getpid(), signal.SIGKILL)
                value = step(*words, **named)
                if mine:
                    os.kill(os.getpid(), signal.SIGKILL)
                return value

            return call

        for kind, name in steps():
            setattr(kind, name, wrapped(getattr(kind, name)))

    forked(team.first.folder, ["apply", "compiled/tiny/manifest.yaml", "--yes"], first=put)
    other = team.clone()
    other.apply()
    assert other.status()["health"] == "Healthy"
    assert len(other.status()["machines"]) == 1
    other("down", "tiny")
    assert (team.alive(), team.refs()) == (0, [])


def test_a_store_away_starts_nothing_and_loses_nothing(team: Team) -> None:
    away = team.remote.with_name("away.git")
    team.remote.rename(away)
    said = team.first.apply(code=6).stderr
    assert "no contact: fatal:" in said
    assert "FOGSPEC_STATE=folder" in said
    assert team.alive() == 0
    away.rename(team.remote)
    team.first.apply()
    team.remote.rename(away)
    status = team.first("status", code=6)
    assert "manifest  fresh" in status.stdout, "what is known without it is printed"
    assert "no contact" in status.stderr
    assert "next:" not in status.stdout, "it may run"
    found = team.first("diff", code=6)
    assert "tiny: the manifest is what compile would write" in found.stdout
    assert "no contact" in found.stderr
    assert "what runs is not known; restarted" in team.first("watch", "--once", "--yes", code=6).stderr
    team.first("ps", code=6)
    team.first("down", "tiny", code=6)
    assert team.alive() == 1
    assert "apply deploys what is committed" in team.first("ci").stderr
    assert "1 ended" in team.first("down", "tiny", env={"FOGSPEC_STATE": "folder"}).stdout
    away.rename(team.remote)
    assert team.first.status()["health"] == "Missing"
    assert "next: fogspec apply compiled/tiny/manifest.yaml" in team.first("status").stdout
    team.first("down", "tiny")
    assert team.refs() == []


def test_a_store_that_goes_away_in_the_middle(team: Team) -> None:
    """The machine was recorded before: the next apply finds and keeps it."""

    def put() -> None:
        start = LocalDeployments.start

        def cut(self: LocalDeployments, job: object) -> None:
            start(self, job)  # type: ignore[arg-type]
            team.remote.rename(team.remote.with_name("away.git"))

        LocalDeployments.start = cut  # type: ignore[assignment, method-assign]
        shared_state.TRIES = 1

    ended = forked(team.first.folder, ["apply", "compiled/tiny/manifest.yaml", "--yes"], first=put)
    assert ended.returncode == 6, ended
    assert "no contact" in ended.stderr
    team.remote.with_name("away.git").rename(team.remote)
    assert team.alive() == 1
    other = team.clone()
    assert "answered after" in other.apply().stdout
    assert (bool(team.first.alive()), bool(other.alive())) == (True, False)
    other("down", "tiny")
    assert team.alive() == 0


def test_a_damaged_record_is_said_kept_and_no_machine_is_lost(
    team: Team, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # What cannot be read may have named a cloud: SkyPilot is asked too, and has no machine.
    cloud = Cloud(tmp_path / "cloud")
    monkeypatch.setattr(registry, "deployment_backend", beside(registry.deployment_backend, cloud))
    team.first.apply()
    whole = team.record()
    team.put(whole[: len(whole) // 2])
    for words in (["status"], ["apply", "tiny", "--yes"], ["ps"], ["ps", "-o", "json"]):
        said = team.first(*words, code=1)
        assert REF in said.stderr + said.stdout, said
        assert "nothing runs" not in said.stderr + said.stdout
    assert "  running   unknown\n" in team.first("status", code=1).stdout
    assert 'fogspec_deployment{application="tiny"}' not in team.first("status", "-o", "openmetrics", code=1).stdout
    assert team.alive() == 1
    adopted = team.first("adopt", "tiny")
    assert "taken over, 1cpu-1gib in local" in adopted.stdout
    assert "apply has nothing to do" in adopted.stdout
    (kept,) = team.first.state.glob("deployment.yaml.unreadable-*")
    assert kept.read_text() == whole[: len(whole) // 2]
    assert "no changes" in team.first.apply().stdout
    team.put(whole[: len(whole) // 2])
    team.first("down", "tiny")
    assert (team.alive(), team.refs()) == (0, [])


def test_a_record_of_another_repository_is_refused(team: Team) -> None:
    team.first.apply()
    team.put(team.record().replace("repository: ", "repository: other").replace("owner: ", "owner: a"))
    for words in (["apply", "tiny", "--yes"], ["down", "tiny"], ["adopt", "tiny"]):
        said = team.first(*words, code=5).stderr
        assert "is the state of tiny of other" in said, said
    assert team.alive() == 1
    git("update-ref", "-d", team.refs()[0], folder=team.remote)
    team.first("adopt")
    assert team.first.status()["health"] == "Healthy"
    team.first("down", "tiny")
    assert team.alive() == 0


def test_adopt_takes_over_what_is_on_no_record(team: Team) -> None:
    team.first.apply()
    git("update-ref", "-d", team.refs()[0], folder=team.remote)
    said = team.first.apply(code=5).stderr
    assert "fogspec adopt tiny takes it over" in said
    team.first("adopt", "tiny")
    live = team.clone().status()
    assert (live["sync"], live["health"]) == ("Synced", "Healthy")
    assert "nothing runs that is not in its live state" in team.first("adopt", "tiny").stdout
    (only,) = json.loads(team.first("adopt", "-o", "json").stdout)
    assert (only["name"], only["adopted"], only["left"]) == ("tiny", [], [])


def test_adopt_finds_the_manifest_that_was_committed_before(team: Team) -> None:
    team.first.apply()
    git("update-ref", "-d", team.refs()[0], folder=team.remote)
    team.first.change("latency: 1s", "latency: 2s")
    team.first("compile", "specs/tiny.yaml")
    git("commit", "-qam", "other limit", folder=team.first.folder)
    assert "apply has nothing to do" in team.first("adopt", "tiny").stdout
    assert team.first.status()["sync"] == "OutOfSync"
    assert "the machine stays, under the new manifest" in team.first.apply().stdout
    git("update-ref", "-d", team.refs()[0], folder=team.remote)
    shutil.rmtree(team.first.folder / ".git")
    git("init", "-q", folder=team.first.folder)


def test_adopt_refuses_what_does_not_answer(team: Team) -> None:
    team.first.apply()
    git("update-ref", "-d", team.refs()[0], folder=team.remote)
    (state,) = team.first.state.glob("deployed/*/out/state.json")
    for pid in team.first.alive():
        os.kill(pid, signal.SIGSTOP)
    state.write_text('{"state": "starting"}')
    said = team.first("adopt", "tiny", code=5).stderr
    assert "1 machine was not taken over" in said
    assert "its nodes do not answer, it is starting" in said
    for pid in team.first.alive():
        os.kill(pid, signal.SIGCONT)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (PROJECT.replace("git}", "git+https://user:secret@example.org/a.git}"), "fogspec.yaml:3:"),
        (PROJECT.replace("git}", "git+file:///tmp/a.git}"), "fogspec.yaml:3:"),
        (PROJECT.replace("git}", "s3}"), "fogspec.yaml:3:"),
        (PROJECT.replace("git}", "'file:///tmp/a'}"), "fogspec.yaml:3:"),
        (PROJECT.replace("git}", "'s3://user:secret@bucket/a'}"), "fogspec.yaml:3:"),
        (PROJECT.replace("git}", "'simplecache::s3://bucket/a'}"), "fogspec.yaml:3:"),
        (PROJECT.replace("git}", "'s3://bucket/../other'}"), "fogspec.yaml:3:"),
        (PROJECT.replace("git}", "'az://bucket@account.example.org/a'}"), "fogspec.yaml:3:"),
        (PROJECT.replace("state:", "stat:"), "fogspec.yaml:3:"),
        ("{", "fogspec.yaml:1:"),
        ("", "fogspec.yaml"),
    ],
)
def test_a_wrong_setting_is_located(team: Team, text: str, said: str) -> None:
    (team.first.folder / "fogspec.yaml").write_text(text)
    for words in (["apply", "tiny", "--yes"], ["status"], ["down", "tiny"], ["ps"], ["adopt"], ["ci"]):
        ended = team.first(*words, code=1)
        assert said in ended.stderr, ended
    assert team.alive() == 0


def test_git_without_origin_says_what_to_do(team: Team) -> None:
    git("remote", "remove", "origin", folder=team.first.folder)
    assert "git remote add origin URL" in team.first.apply(code=1).stderr
    assert (
        "write folder, git, git+URL, or s3://BUCKET/PREFIX"
        in team.first.apply(code=1, env={"FOGSPEC_STATE": "s3:"}).stderr
    )


def test_another_repository_has_the_state(team: Team, tmp_path: Path) -> None:
    git("init", "-q", "--bare", str(tmp_path / "fleet.git"), folder=tmp_path)
    env = {"FOGSPEC_STATE": f"git+file://{tmp_path}/fleet.git"}
    team.first.apply(env=env)
    assert team.refs() == []
    assert team.first.status() is None
    assert "1 ended" in team.clone()("down", "tiny", env=env).stdout


def test_hooks_and_programs_of_a_prepared_remote_do_not_run(team: Team, tmp_path: Path) -> None:
    mark = tmp_path / "ran"
    for name in ("pre-receive", "update", "post-receive", "post-update", "reference-transaction", "proc-receive"):
        hook = team.remote / "hooks" / name
        hook.write_text(f"#!/bin/sh\ntouch {mark}-{name}\n")
        hook.chmod(0o755)
    for name in ("core.sshCommand", "core.fsmonitor", "core.alternateRefsCommand", "uploadpack.packObjectsHook"):
        for folder in (team.remote, team.first.folder):
            git("config", name, f"touch {mark}-{name}; false", folder=folder)
    team.first.apply()
    team.first.status()
    team.first("down", "tiny")
    assert list(tmp_path.glob("ran*")) == []


def test_the_module_names_what_the_refs_are() -> None:
    assert git_store.REFS == REF
