"""The live state in refs of the repository: two clones of it, a bare remote, and what runs on this host."""

import json
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from fogspec.backends import registry
from fogspec.backends.local.backend import LocalDeployments
from fogspec.base.errors import NotInstalled
from fogspec.deploy import git_store, shared_state
from fogspec.deploy.git_store import GitStore
from tests.support.deployed import Deployed, app  # noqa: F401
from tests.support.fake_sky import Cloud, beside
from tests.support.forking import forked
from tests.support.scenes import tell, until

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

    def clone(self, *options: str) -> Deployed:
        folder = self.remote.parent / f"clone-{len(self.clones)}"
        git("clone", "-q", *options, f"file://{self.remote}", str(folder), folder=self.remote.parent)
        git("config", "user.name", "a", folder=folder)
        self.clones.append(Deployed(folder))
        return self.clones[-1]

    def merge(self, limit: str) -> str:
        """Commit and push another limit from the first clone; return the commit."""
        spec = self.first.folder / "specs/tiny.yaml"
        spec.write_text(re.sub(r"latency: \w+", f"latency: {limit}", spec.read_text()))
        self.first("compile", "specs/tiny.yaml")
        git("commit", "-qam", limit, folder=self.first.folder)
        git("push", "-q", "origin", "HEAD:master", folder=self.first.folder)
        return git("rev-parse", "HEAD", folder=self.first.folder)

    def refs(self) -> list[str]:
        return git("for-each-ref", "--format=%(refname)", REF, folder=self.remote).split()

    def held(self) -> list[str]:
        """Those of a record that names a machine, or that a command holds; what has only a history is of what is over."""
        texts = {ref: git("show", f"{ref}:state.yaml", folder=self.remote) for ref in self.refs()}
        return [ref for ref, text in texts.items() if not ("  machines: []" in text and "  lease: null" in text)]

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
    for words in (["init", "-q"], ["config", "user.name", "a"], ["add", "."], ["commit", "-qm", "all"],
                  ["remote", "add", "origin", str(remote)], ["push", "-q", "origin", "HEAD:master"]):  # fmt: skip
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
    live = other.judged()
    assert (live["sync"], live["health"]) == ("Synced", "Healthy")
    assert len(live["machines"]) == 1
    assert "no changes" in other.apply().stdout
    other.change("latency: 1s", "latency: 2s")
    other("compile", "specs/tiny.yaml")
    assert "the machine stays, under the new manifest" in other.apply().stdout
    assert team.first.status()["sync"] == "OutOfSync", "the first clone has the manifest of before"
    assert team.first.alive(), "without downtime"
    down = other("down", "tiny")
    assert "1 ended" in down.stdout
    assert (team.held(), team.alive()) == ([], 0)
    assert team.first.status() is None
    said = team.clone()("status", "-v").stdout
    assert re.findall(r" (apply|down) by .+ (started|kept|ended) local/", said) == [
        ("apply", "started"),
        ("apply", "kept"),
        ("down", "ended"),
    ]


def test_a_late_job_does_not_bring_an_older_commit_back(team: Team, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GITHUB_TRIGGERING_ACTOR", "ada\x1b[31m")
    late, shallow = team.clone(), team.clone("--depth=1")
    before = git("rev-parse", "HEAD", folder=late.folder)
    commit = team.merge("2s")
    team.first.apply()
    first = team.first.status()["machines"][0]["applied"]
    assert (first["commit"], first["generation"]) == (commit, 1)
    by = f"commit {commit[:12]}, applied {first['date']} by ada\\x1b[31m, generation 1"
    assert by in team.first("status").stdout
    git("fetch", "-q", folder=late.folder)
    for words in (["--yes"], ["--dry-run"]):
        said = late("apply", "tiny", *words, code=5).stderr
        assert f"commit {before[:12]} is older than the one that runs" in said
        assert by in said
        assert "git pull" in said
        assert "fogspec apply tiny --older" in said
    # In a clone without history the commit that runs is not known, or not known to be later.
    for fetch in (["--depth=1", "origin", "master"], ["--unshallow"]):
        said = shallow.apply(code=5).stderr
        assert f"commit {before[:12]} may be older than the one that runs" in said
        assert "git fetch --unshallow" in said
        git("fetch", "-q", *fetch, folder=shallow.folder)
    assert "is older than the one that runs" in shallow.apply(code=5).stderr
    assert team.first.status()["machines"][0]["applied"] == first

    assert "the machine stays, under the new manifest" in late.apply("--older").stdout
    accepted = late.status()["machines"][0]["applied"]
    assert (accepted["commit"], accepted["generation"]) == (before, 2)
    git("pull", "-q", "--ff-only", "origin", "master", folder=late.folder)
    late.apply()
    assert "no changes" in late.apply().stdout
    assert late.status()["machines"][0]["applied"]["generation"] == 3
    git("commit", "-q", "--allow-empty", "-m", "docs", folder=team.first.folder)
    assert "no changes" in team.first.apply().stdout
    assert team.first.status()["machines"][0]["applied"]["commit"] == git("rev-parse", "HEAD", folder=team.first.folder)
    late.apply(code=5)
    git("checkout", "-q", "-b", "hotfix", folder=late.folder)
    git("commit", "-q", "--allow-empty", "-m", "another branch", folder=late.folder)
    git("fetch", "-q", str(team.first.folder), "HEAD", folder=late.folder)
    assert "no changes" in late.apply().stdout
    late("down", "tiny")
    assert (team.alive(), team.held()) == (0, [])


def test_a_clone_of_depth_one_deploys_a_newer_commit_once_it_has_the_history(team: Team) -> None:
    team.first.apply()
    team.merge("2s")
    shallow = team.clone("--depth=1")
    assert "git fetch --unshallow" in shallow.apply(code=5).stderr
    git("fetch", "-q", "--unshallow", folder=shallow.folder)
    assert "the machine stays, under the new manifest" in shallow.apply().stdout
    shallow.kill()
    team.first.kill()
    until(lambda: not team.alive())
    before = shallow.status()["machines"][0]["applied"]
    behind = team.clone()
    git("reset", "-q", "--soft", "HEAD~1", folder=behind.folder)
    behind("watch", "tiny", "--once", "--yes")
    assert (team.alive(), behind.status()["machines"][0]["applied"]) == (1, before), "a restart is of what was applied"
    behind("down", "tiny")


def test_a_replaced_machine_of_another_clone_ends_after_the_new_one_answers(team: Team) -> None:
    team.first.apply()
    other = team.clone()
    (old,) = [one["name"] for one in other.status()["machines"]]
    team.first.kill()
    until(lambda: not team.first.alive())
    assert other.status()["health"] == "Missing"
    assert f"{old}: gone" in other.apply().stderr
    assert other.judged()["health"] == "Healthy"
    assert (bool(team.first.alive()), bool(other.alive())) == (False, True)
    assert "nothing is left" in team.first("down", "tiny").stdout
    assert team.alive() == 0


def test_what_runs_without_a_spec_is_in_status_and_in_the_gate(team: Team) -> None:
    team.first.apply()
    other = team.clone()
    for name in ("specs/tiny.yaml", "specs/tiny.lock", "specs/work.py"):
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
    assert re.search(r"^tiny \(no spec\) .* OutOfSync, ", said, re.MULTILINE)
    assert said.endswith("next: fogspec down tiny\n")
    assert "FAIL  tiny: no spec has an application of this name" in other("check", code=3).stdout
    assert [one["has_spec"] for one in json.loads(other("status", "-o", "json").stdout)] == [True, False]
    assert "1 ended" in other("down", "tiny").stdout
    assert "tiny" not in other("check", code=None).stdout


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
    assert (team.alive(), team.held()) == (0, [])


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
    assert other.judged()["health"] == "Healthy"
    assert len(other.status()["machines"]) == 1
    other("down", "tiny")
    assert (team.alive(), team.held()) == (0, [])


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
    team.first("down", "tiny", code=6)
    assert team.alive() == 1
    assert "apply deploys what is committed" in team.first("check").stderr
    assert "1 ended" in team.first("down", "tiny", env={"FOGSPEC_STATE": "folder"}).stdout
    away.rename(team.remote)
    assert team.first.status()["health"] == "Missing"
    assert "next: fogspec apply compiled/tiny/manifest.yaml" in team.first("status").stdout
    team.first("down", "tiny")
    assert team.held() == []


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
    for words in (["status"], ["apply", "tiny", "--yes"], ["status", "-o", "json"]):
        said = team.first(*words, code=1)
        assert REF in said.stderr + said.stdout, said
        assert "nothing runs" not in said.stderr + said.stdout
    assert "  running   unknown\n" in team.first("status", code=1).stdout
    team.first("watch", "tiny", "--once", "--max-restarts", "0", code=6)
    assert "fogspec_deployment" not in (team.first.state.parent / "metrics.prom").read_text()
    assert team.alive() == 1
    adopted = team.first("apply", "tiny", "--adopt")
    assert "taken over, 1cpu-1gib in local" in adopted.stdout
    assert "apply has nothing to do" in adopted.stdout
    (kept,) = team.first.state.glob("deployment.yaml.unreadable-*")
    assert kept.read_text() == whole[: len(whole) // 2]
    assert "no changes" in team.first.apply().stdout
    team.put(whole[: len(whole) // 2])
    team.first("down", "tiny")
    assert (team.alive(), team.held()) == (0, [])


def without_skypilot() -> None:
    host = registry.deployment_backend

    def absent(infra: str) -> object:
        if infra != "local":
            raise NotInstalled("SkyPilot is not installed here")
        return host(infra)

    registry.deployment_backend = absent  # type: ignore[assignment]


def test_a_damaged_record_stays_until_there_is_a_new_one(team: Team) -> None:
    team.first.apply()
    team.put("{")
    (state,) = team.first.state.glob("deployed/*/out/state.json")
    whole, pids = state.read_text(), team.first.alive()
    tell(pids, signal.SIGSTOP)
    state.write_text('{"state": "starting"}')
    ended = forked(team.first.folder, ["apply", "tiny", "--adopt"], first=without_skypilot)
    assert (ended.returncode, team.record()) == (5, "{"), ended
    state.write_text(whole)
    tell(pids, signal.SIGCONT)
    ended = forked(team.first.folder, ["apply", "tiny", "--adopt"], first=without_skypilot)
    assert ended.returncode == 0, ended
    assert "taken over, 1cpu-1gib in local" in ended.stdout
    assert "cannot be read" in ended.stderr
    assert team.clone().judged()["health"] == "Healthy"


def test_down_keeps_a_damaged_record_of_what_may_run(team: Team) -> None:
    team.first.apply()
    team.put("{")
    ended = forked(team.first.folder, ["down", "tiny"], first=without_skypilot)
    assert (ended.returncode, team.alive(), team.record()) == (6, 0, "{"), ended
    assert "SkyPilot is not installed here" in ended.stderr


def test_a_record_says_where_an_application_without_spec_runs(team: Team) -> None:
    team.first.apply()
    for words in (["rm", "-rq", "specs", "compiled", "results"], ["commit", "-qm", "gone"]):
        git(*words, folder=team.first.folder)
    ended = forked(team.first.folder, ["down", "tiny"], first=without_skypilot)
    assert (ended.returncode, team.alive(), team.held()) == (0, 0, []), ended


def test_a_record_of_another_repository_is_refused(team: Team) -> None:
    team.first.apply()
    team.put(team.record().replace("repository: ", "repository: other").replace("owner: ", "owner: a"))
    for words in (["apply", "tiny", "--yes"], ["down", "tiny"], ["apply", "tiny", "--adopt"]):
        said = team.first(*words, code=5).stderr
        assert "is the state of tiny of other" in said, said
    assert team.alive() == 1
    git("update-ref", "-d", team.refs()[0], folder=team.remote)
    team.first("apply", "tiny", "--adopt")
    assert team.first.judged()["health"] == "Healthy"
    team.first("down", "tiny")
    assert team.alive() == 0


def test_adopt_takes_over_what_is_on_no_record(team: Team) -> None:
    team.first.apply()
    before = team.first.status()["machines"][0]["applied"]
    git("update-ref", "-d", team.refs()[0], folder=team.remote)
    said = team.first.apply(code=5).stderr
    assert "fogspec apply tiny --adopt takes it over" in said
    alive = team.first.alive()
    taken = team.first("apply", "tiny", "--adopt").stdout
    assert "tiny: nothing was started or ended\nnext: fogspec status specs/tiny.yaml\n" in taken
    assert team.first.alive() == alive
    live = team.clone().judged()
    now = live["machines"][0]["applied"]
    assert before["commit"] is not None
    assert {**now, "date": None} == {**before, "date": None}, "the record of an apply"
    assert (live["sync"], live["health"]) == ("Synced", "Healthy")
    assert "nothing runs that is not in its live state" in team.first("apply", "tiny", "--adopt").stdout
    only = json.loads(team.first("apply", "tiny", "--adopt", "-o", "json").stdout)
    assert (only["name"], only["adopted"], only["left"]) == ("tiny", [], [])


def test_adopt_finds_the_manifest_that_was_committed_before(team: Team) -> None:
    team.first.apply()
    git("update-ref", "-d", team.refs()[0], folder=team.remote)
    team.first.change("latency: 1s", "latency: 2s")
    team.first("compile", "specs/tiny.yaml")
    git("commit", "-qam", "other limit", folder=team.first.folder)
    assert "apply has nothing to do" in team.first("apply", "tiny", "--adopt").stdout
    assert team.first.status()["sync"] == "OutOfSync"
    assert "the machine stays, under the new manifest" in team.first.apply().stdout
    git("update-ref", "-d", team.refs()[0], folder=team.remote)
    shutil.rmtree(team.first.folder / ".git")
    git("init", "-q", folder=team.first.folder)


def test_adopt_refuses_what_does_not_answer(team: Team) -> None:
    team.first.apply()
    git("update-ref", "-d", team.refs()[0], folder=team.remote)
    (state,) = team.first.state.glob("deployed/*/out/state.json")
    tell(team.first.alive(), signal.SIGSTOP)
    state.write_text('{"state": "starting"}')
    said = team.first("apply", "tiny", "--adopt", code=5).stderr
    assert "1 machine was not taken over" in said
    assert "its nodes do not answer, it is starting" in said
    tell(team.first.alive(), signal.SIGCONT)


def test_a_wrong_setting_is_located(team: Team) -> None:
    at = "fogspec.yaml:3:"
    for text, said in (
        (PROJECT.replace("git}", "git+https://user:secret@example.org/a.git}"), at),
        (PROJECT.replace("git}", "git+file:///tmp/a.git}"), at),
        (PROJECT.replace("git}", "s3}"), at),
        (PROJECT.replace("git}", "'file:///tmp/a'}"), at),
        (PROJECT.replace("git}", "'s3://bucket/a'}"), "write folder, git, git+https://host/path or git+ssh://"),
        (PROJECT.replace("state:", "stat:"), at),
        ("{", "fogspec.yaml:1:"),
        ("", "fogspec.yaml"),
    ):
        (team.first.folder / "fogspec.yaml").write_text(text)
        for words in (
            ["apply", "tiny", "--yes"],
            ["status"],
            ["down", "tiny"],
            ["apply", "tiny", "--adopt"],
            ["check"],
        ):
            ended = team.first(*words, code=1)
            assert said in ended.stderr, (text, ended)
        assert team.alive() == 0


def test_git_without_origin_says_what_to_do(team: Team) -> None:
    git("remote", "remove", "origin", folder=team.first.folder)
    assert "git remote add origin URL" in team.first.apply(code=1).stderr
    for other in ("s3://bucket/a", f"file://{team.remote}"):
        said = team.first.apply(code=1, env={"FOGSPEC_STATE": other}).stderr
        assert "write folder, git or git+URL" in said


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
        git("config", name, f"touch {mark}-{name}; false", folder=team.first.folder)
    team.first.apply()
    team.first.status()
    team.first("down", "tiny")
    assert list(tmp_path.glob("ran*")) == []


def test_a_remote_that_checks_a_record_out_through_its_filter_is_refused(team: Team, tmp_path: Path) -> None:
    mark, tree = tmp_path / "ran", tmp_path / "tree"
    tree.mkdir()
    team.first.apply()
    (ref,) = team.refs()
    team.first("down", "tiny")
    for name, value in (("core.bare", "false"), ("core.worktree", str(tree)), ("filter.x.smudge", f"touch {mark}; cat"),
                        ("receive.denyCurrentBranch", "updateInstead")):  # fmt: skip
        git("config", name, value, folder=team.remote)
    (team.remote / "info").mkdir(exist_ok=True)
    (team.remote / "info/attributes").write_text("* filter=x\n")
    git("--git-dir=.", "symbolic-ref", "HEAD", ref, folder=team.remote)
    for words in (["apply", "tiny", "--yes"], ["status"], ["down", "tiny"]):
        ended = team.first(*words, code=5)
        assert f"{team.remote}/config: core.bare = false" in ended.stderr, ended
        assert "nothing runs" not in ended.stdout
    assert (team.alive(), team.held(), mark.exists()) == (0, [], False)


def test_a_remote_on_this_host_with_a_setting_that_runs_something_is_refused(team: Team) -> None:
    config = team.remote / "config"
    plain = config.read_text()
    for name, value in (
        ("core.worktree", "/nowhere"), ("core.bare", "false"), ("core.hooksPath", "hooks"), ("core.fsmonitor", "x"),
        ("core.alternateRefsCommand", "x"), ("core.attributesFile", "x"), ("receive.denyCurrentBranch", "updateInstead"),
        ("receive.procReceiveRefs", "refs"), ("uploadpack.packObjectsHook", "x"), ("gc.recentObjectsHook", "x"),
        ("filter.a.b.smudge", "x"), ("include.path", "x"), ("includeIf.gitdir:/.path", "x"), ("remote.a.uploadpack", "x"),
        ("extensions.worktreeConfig", "true"), ("alias.receive-pack", "!x"),
    ):  # fmt: skip
        git("config", "--file", str(config), name, value, folder=team.first.folder)
        said = team.first("status", code=5).stderr
        found = re.search(f"{re.escape(str(config))}: (\\S+) = (.*): ", said)
        assert found is not None, said
        assert (found[1].lower(), found[2]) == (name.lower(), value)
        assert ("git clone --mirror" if name == "core.bare" else f"git config --file {config} --unset-all") in said
        config.write_text(plain)
    config.write_text(f"{plain}[core]\n\tbare = false\n\tbare\n")
    assert "core.bare = false" in team.first("status", code=5).stderr, "each of several values"
    config.write_text(f'{plain}[core]\n\tx = "a\\n\\u001bb{"c" * 999}"\n'.replace("\\u001b", "\x1b"))
    said = team.first("status", code=5).stderr.splitlines()[0]
    assert f"{config}: core.x = a\\n\\x1bb" in said, "text stays text"
    assert len(said) < 500
    config.write_text(f"{plain}[core\n")
    assert "no contact: fatal: bad config line" in team.first("status", code=6).stderr
    config.write_text(plain)
    # Also by way of a branch: git follows each of them.
    git("symbolic-ref", "refs/heads/way", f"{REF}tiny", folder=team.remote)
    git("symbolic-ref", "HEAD", "refs/heads/way", folder=team.remote)
    said = team.first("status", code=5).stderr
    assert f"{team.remote}/HEAD: names a record" in said
    assert f"git --git-dir={team.remote} symbolic-ref HEAD refs/heads/main" in said
    git("symbolic-ref", "HEAD", "refs/heads/main", folder=team.remote)
    (team.remote / "commondir").write_text(".\n")
    assert f"{team.remote}: points to another repository" in team.first("status", code=5).stderr


def test_a_clone_with_files_as_remote_is_refused_wherever_git_finds_it(team: Team) -> None:
    clone = team.clone().folder
    for at, folder in ((clone, clone / ".git"), (clone.with_suffix(".part"), clone / ".git")):
        git("remote", "set-url", "origin", str(at), folder=team.first.folder)
        if at != clone:
            clone.rename(at.with_suffix(".part.git"))
            folder = at.with_suffix(".part.git") / ".git"
        said = team.first.apply(code=5).stderr
        assert f"{folder}/config: core.bare = false" in said
    subprocess.run(
        said.partition("make a bare one: ")[2].splitlines()[0], shell=True, cwd=team.first.folder, check=True
    )
    assert "runs on" in team.first.apply().stdout
    assert "1 ended" in team.first("down", "tiny").stdout


def test_a_bare_repository_as_a_team_shares_it_is_taken(team: Team) -> None:
    shutil.rmtree(team.remote)
    git("init", "-q", "--bare", "--shared", str(team.remote), folder=team.first.folder)
    for name, value in (
        ("core.logAllRefUpdates", "true"), ("core.compression", "9"), ("receive.denyCurrentBranch", "refuse"),
        ("receive.denyDeletes", "false"), ("receive.fsckObjects", "true"), ("transfer.fsckObjects", "true"),
        ("gc.auto", "0"), ("gc.pruneExpire", "now"), ("user.name", "a"), ("user.email", "a@example.org"),
        ("remote.origin.url", "https://example.org/a.git"), ("remote.origin.fetch", "+refs/*:refs/*"),
        ("remote.origin.mirror", "true"), ("uploadpack.allowAnySHA1InWant", "true"), ("http.receivepack", "true"),
        ("pack.threads", "1"),
    ):  # fmt: skip
        git("config", name, value, folder=team.remote)
    team.first.apply()
    assert team.first.judged()["health"] == "Healthy"
    assert "1 ended" in team.first("down", "tiny").stdout
    assert (team.alive(), team.held()) == (0, [])


def test_the_module_names_what_the_refs_are() -> None:
    assert git_store.REFS == REF
