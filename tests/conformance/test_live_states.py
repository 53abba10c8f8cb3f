"""What every place of live state must do: one suite over the folder of a clone and refs of a git repository."""

import contextlib
import subprocess
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from fogspec.backends.registry import owner_of
from fogspec.base import project_files
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import Busy, FogspecError, Refused
from fogspec.base.git import Ended
from fogspec.base.layout import Layout
from fogspec.catalog.machine import Machine
from fogspec.deploy import shared_state, state
from fogspec.deploy.git_store import GitStore
from fogspec.deploy.schema import DeployedMachine, DeploymentBody
from fogspec.deploy.shared_state import LEASE_S, SharedRecord, holding, key_of, store_of
from fogspec.deploy.state import DeploymentState
from fogspec.deploy.stores import Overtaken, Store, Stored, StoreUnavailable
from tests.support.repositories import git
from tests.support.scenes import until

HEX = "sha256:" + "1" * 64


@dataclass
class Times:
    """A clock that goes on when somebody waits, on a computer whose date is wrong by `wrong`."""

    now: float = 0.0
    wrong: timedelta = timedelta()
    waits: list[object] = field(default_factory=list)

    def now_s(self) -> float:
        return self.now

    def boot(self) -> str:
        return "boot"

    def date(self) -> datetime:
        return datetime.fromtimestamp(1e9 + self.now, UTC) + self.wrong

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        for one in self.waits:
            one()  # type: ignore[operator]


@dataclass
class Project:
    """An application in two clones; with a folder as its place, both are the same clone."""

    kind: str
    one: Layout
    other: Layout
    remote: Path
    times: Times = field(default_factory=Times)
    said: list[str] = field(default_factory=list)

    @contextlib.contextmanager
    def held(self, layout: Layout | None = None) -> Iterator[DeploymentState]:
        layout = layout or self.one
        with holding(layout, "apply of tiny", self.times, self.said.append) as record:
            yield DeploymentState.read(layout, self.times, record)

    def seen(self) -> DeploymentState:
        """What another clone sees."""
        shared_state._recent.clear()
        return DeploymentState.look(self.other, self.times)

    def machine(self, token: str = "000001", **more: object) -> DeployedMachine:
        return DeployedMachine(
            name=owner_of(self.one).deployment_name(HEX, token), deployer="skypilot", state="starting", manifest=HEX,
            machine=Machine(infra="lambda/r1", instance="a", cpus=2, memory=4.0, price=3600.0), runs=HEX, files={}, at=0.0,
            boot="boot", since="2026-01-01T00:00:00+00:00",
        ).model_copy(update=more)  # fmt: skip

    def store(self, layout: Layout | None = None) -> Store:
        found = store_of(layout or self.one)
        assert found is not None
        return found

    def damage(self) -> None:
        if self.kind == "folder":
            self.one.live.write_text(self.one.live.read_text()[:-40] + "]")
            return
        ref = f"refs/fogspec/state/{key_of(owner_of(self.one))}"
        blob = subprocess.run(
            ["git", "hash-object", "-w", "--stdin"], cwd=self.remote, input=b"spec: [", check=True, capture_output=True
        ).stdout
        entry = b"100644 blob " + blob.strip() + b"\tstate.yaml\n"
        tree = subprocess.run(["git", "mktree"], cwd=self.remote, input=entry, check=True, capture_output=True).stdout
        who = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
        commit = git(*who, "commit-tree", "-m", "a", tree.decode().strip(), folder=self.remote)
        git("update-ref", ref, commit, folder=self.remote)


@pytest.fixture(params=["folder", "git"])
def project(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Project:
    return made(request.param, tmp_path, monkeypatch)


@pytest.fixture
def shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Project:
    return made("git", tmp_path, monkeypatch)


def made(kind: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Project:
    monkeypatch.delenv("FOGSPEC_STATE", raising=False)
    shared_state._store.cache_clear()
    monkeypatch.setattr(shared_state, "KEPT_S", -1.0)
    remote, layouts = folder / "remote.git", []
    git("init", "-q", "--bare", str(remote), folder=folder)
    for name in ("one", "other"):
        git("init", "-q", str(folder / name), folder=folder)
        git("remote", "add", "origin", str(remote), folder=folder / name)
        (folder / name / "specs").mkdir()
        layouts.append(Layout.of(folder / name / "specs" / "tiny.yaml", "tiny"))
        if kind != "folder":
            (folder / name / "fogspec.yaml").write_text(
                f"apiVersion: fogspec.dev/v1alpha1\nkind: Project\nspec: {{state: '{kind}'}}\n"
            )
    return Project(kind, layouts[0], layouts[0] if kind == "folder" else layouts[1], remote)


def test_what_is_put_is_seen_by_others_before_the_next_step(project: Project) -> None:
    assert project.seen().machines == []
    with project.held() as live:
        live.put(project.machine())
        assert project.seen().machines == [project.machine()]
        live.put(project.machine(state="serving", address="192.0.2.1"))
        live.put(project.machine("000002", state="serving"), ends=True)
        first, second = project.seen().machines
    assert (first.state, second.state) == ("ending", "serving")
    assert project.seen().machines == [first, second]


def test_a_machine_that_is_gone_leaves_its_cost(project: Project) -> None:
    with project.held() as live:
        live.put(project.machine())
        project.times.now += 60.0
        live.gone(project.machine().name)
    seen = project.seen()
    assert (seen.machines, seen.total_usd()) == ([], 60.0)


def test_the_manifest_of_a_machine_is_kept_until_it_is_gone(project: Project) -> None:
    name = project.machine().name
    with project.held() as live:
        live.put(project.machine())
        assert live.manifest_of(name) is None
        live.keep_manifest(name, "a: ü\nb: |\n  x\n\n".encode())
        live.put(project.machine(state="serving"))
    assert project.seen().manifest_of(name) == "a: ü\nb: |\n  x\n\n".encode()
    with project.held(project.other) as live:
        live.gone(name)
    assert project.seen().manifest_of(name) is None


def test_records_of_others_machines_are_kept_and_refused(project: Project) -> None:
    foreign = project.machine().model_copy(update={"name": "fogspec-another-machine"})
    with project.held() as live:
        live.put(project.machine())
        live.foreign.append(foreign)
        live.put(project.machine(state="serving"))
    seen = project.seen()
    assert (seen.foreign, seen.machines) == ([foreign], [project.machine(state="serving")])
    with pytest.raises(Refused, match="fogspec-another-machine"):
        seen.check_owned()


def test_clearing_leaves_the_history_alone(project: Project) -> None:
    with project.held() as live:
        live.put(project.machine())
        project.times.now += 60.0
        live.gone(project.machine().name)
        live.layout.files.write(live.layout.last_words, b"it")
        assert list(live.clear()) == [str(live.layout.last_words)]
        assert list(live.clear()) == []
    seen = project.seen()
    assert (seen.machines, seen.total_usd()) == ([], 0.0)
    assert [(act.did, act.name, act.spent) for act in seen.history] == [
        ("started", project.machine().name, None),
        ("ended", project.machine().name, 60.0),
    ]
    assert seen.history[1].by.date == "2001-09-09T01:47:40+00:00"


def test_clearing_without_a_history_leaves_nothing(project: Project) -> None:
    with project.held() as live:
        live.history = []
        live.layout.files.write(live.layout.live, b"x")
        assert str(live.layout.live) in list(live.clear())
        assert list(live.clear()) == []
    assert git("for-each-ref", folder=project.remote) == ""
    assert project.kind == "folder" or project.store().read_all() == {}


def test_the_history_has_the_latest_acts_and_counts_generations_on(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    most = 6
    monkeypatch.setattr(state, "MOST_ACTS", most)
    for number in range(most):
        with project.held() as live:
            by = live.applied("a" * 40)
            live.verb = "apply"
            live.put(project.machine(f"{number:06}", applied=by))
            live.put(project.machine(f"{number:06}", applied=by, state="serving"))
            live.gone(project.machine(f"{number:06}").name)
            list(live.clear())
    acts = project.seen().history
    assert len(acts) == most
    assert [(act.verb, act.did, act.by.generation) for act in acts[-3:]] == [
        ("apply", "ended", most - 1),
        ("apply", "started", most),
        ("apply", "ended", most),
    ]


def test_what_is_damaged_is_said_with_its_place_and_a_way_on(project: Project) -> None:
    with project.held() as live:
        live.put(project.machine())
    project.damage()
    with pytest.raises(DiagnosticError) as wrong:
        project.seen()
    (first, *_) = wrong.value.diagnostics
    place = project.one.live if project.kind == "folder" else project.store().path(key_of(owner_of(project.one)))
    assert first.span.path == str(place)
    assert "fogspec down tiny" in str(first.fix)
    assert "fogspec apply tiny --adopt" in str(first.fix)


def test_a_write_that_fails_changes_nothing(project: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with project.held() as live:
        live.put(project.machine())
        with monkeypatch.context() as broken:
            broken.setattr(project_files, "_replace", fails)
            broken.setattr(GitStore, "_commit", lambda *_: (_ for _ in ()).throw(StoreUnavailable("it", "away")))
            with pytest.raises(FogspecError):
                live.put(project.machine(state="serving"))
        assert live.machines == [project.machine()]
        live.put(project.machine("000002"))
    assert [one.state for one in project.seen().machines] == ["starting", "starting"]


def test_one_command_at_a_time_names_the_other(project: Project) -> None:
    with (
        project.held(),
        pytest.raises(Busy, match=r"apply of tiny must wait: apply of tiny .* has not ended"),
        project.held(project.other),
    ):
        pass
    with project.held(project.other) as live:
        assert live.machines == []


def away(record: SharedRecord) -> None:
    """The holder is on another computer, as far as its lease says."""
    assert record._lease is not None
    record._lease = record._lease.model_copy(update={"process": "boot pid:[1] 7 8", "host": "ci-7"})
    record._write()


def taken(project: Project, layout: Layout, what: str = "apply of tiny") -> SharedRecord:
    record = SharedRecord(
        store=project.store(layout),
        layout=layout,
        times=project.times,
        what=what,
        report=project.said.append,
        owner=owner_of(layout),
    )
    record.take()
    return record


def test_a_lease_that_is_not_renewed_ends_by_the_clock_of_who_waits(shared: Project) -> None:
    shared.times.wrong = timedelta(days=9000)  # by the holder's date it would hold for years
    first = taken(shared, shared.one)
    away(first)
    shared.times.wrong = timedelta(days=-3000)
    second = taken(shared, shared.other)
    assert LEASE_S <= shared.times.now < 2 * LEASE_S
    assert "apply of tiny on ci-7 has not been heard of for 60 s: taken over" in shared.said
    with pytest.raises(Busy, match="another command took over its state"):
        first.save(DeploymentBody(machines=[shared.machine()]), {})
    first.renew()
    first.give_back()
    second.save(DeploymentBody(machines=[shared.machine("000002")]), {})
    assert [one.name for one in shared.seen().machines] == [shared.machine("000002").name]


def test_a_lease_that_is_renewed_holds_even_if_its_date_is_long_past(shared: Project) -> None:
    shared.times.wrong = timedelta(days=-3000)
    first = taken(shared, shared.one)
    away(first)
    shared.times.wrong = timedelta()
    shared.times.waits.append(first.renew)
    with pytest.raises(Busy, match="must wait: apply of tiny on ci-7 has not ended"):
        taken(shared, shared.other)
    assert shared.times.now < LEASE_S
    first.save(DeploymentBody(machines=[shared.machine()]), {})


def test_a_lease_that_is_given_back_is_taken(shared: Project) -> None:
    first = taken(shared, shared.one)
    away(first)
    shared.times.waits.append(first.give_back)
    second = taken(shared, shared.other)
    assert shared.times.now < LEASE_S
    second.save(DeploymentBody(machines=[shared.machine()]), {})


def test_the_lease_of_a_process_that_ended_here_is_taken_at_once(shared: Project) -> None:
    first = taken(shared, shared.one)
    assert first._lease is not None
    *same, _pid, ticks = first._lease.process.split(" ")
    first._lease = first._lease.model_copy(update={"process": " ".join([*same, "1", ticks])})
    first._write()
    taken(shared, shared.other)
    assert shared.times.now == 0.0


def test_a_lease_is_renewed_beside_what_is_written(shared: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_state, "RENEW_S", 0.01)
    store, key = shared.store(shared.other), key_of(owner_of(shared.other))

    def renewed() -> int:
        found = shared_state.parsed(store.read(key), key, owner_of(shared.other))
        return 0 if found is None or found.spec.lease is None else found.spec.lease.renewed

    with shared.held() as live:
        until(lambda: renewed() >= 1)
        for number in range(1, 4):
            live.put(shared.machine(f"00000{number}"))
        seen = renewed()
        until(lambda: renewed() > seen)
    assert len(shared.seen().machines) == 3


def test_an_answer_that_is_lost_is_no_second_writer(shared: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    record, count = taken(shared, shared.one), iter(range(9))
    kind = type(shared.store())
    write = kind.write

    def lost(self: Store, *words: object) -> str | None:
        version = write(self, *words)  # type: ignore[arg-type]
        if next(count) == 0:
            raise StoreUnavailable("it", "the connection was cut")
        return version

    monkeypatch.setattr(kind, "write", lost)
    record.save(DeploymentBody(machines=[shared.machine()]), {})
    record.save(DeploymentBody(machines=[shared.machine(state="serving")]), {})
    assert [one.state for one in shared.seen().machines] == ["serving"]


def test_of_two_writes_one_arrives(shared: Project) -> None:
    one, other = shared.store(shared.one), shared.store(shared.other)
    first = one.write("tiny-x", b"a: 1\n", None, "first")
    with pytest.raises(Overtaken):
        other.write("tiny-x", b"a: 2\n", None, "second")
    with pytest.raises(Overtaken):
        other.write("tiny-x", None, "0" * 40, "third")
    assert other.read("tiny-x").version == first
    assert other.read("tiny-x").content == b"a: 1\n"
    second = other.write("tiny-x", b"a: 2\n", first, "second")
    assert set(one.read_all()) == {"tiny-x"}
    assert one.write("tiny-x", None, second, "last") is None
    assert other.read_all() == {}


def test_a_commit_without_the_file_is_damaged_not_empty(shared: Project) -> None:
    who = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
    tree = git("mktree", "--missing", folder=shared.remote)
    commit = git(*who, "commit-tree", "-m", "a", tree, folder=shared.remote)
    git("update-ref", f"refs/fogspec/state/{key_of(owner_of(shared.one))}", commit, folder=shared.remote)
    with pytest.raises(DiagnosticError):
        shared.seen()


def test_a_record_of_another_owner_is_refused(shared: Project) -> None:
    with shared.held() as live:
        live.put(shared.machine())
    store, key = shared.store(), key_of(owner_of(shared.one))
    now = store.read(key)
    other = now.content.replace(owner_of(shared.one).digest.encode(), b"a" * 52)
    store.write(key, other, now.version, "by hand")
    with pytest.raises(Refused, match="nothing was touched"):
        shared.seen()
    with pytest.raises(Refused, match="nothing was touched"), shared.held():
        pass


def test_records_of_other_applications_and_folders_are_not_mixed_up(shared: Project) -> None:
    longer = replace(shared.one, name="tiny-two")
    with holding(longer, "apply of tiny-two", shared.times, shared.said.append) as record:
        live = DeploymentState.read(longer, shared.times, record)
        name = owner_of(longer).deployment_name(HEX, "000001")
        live.put(shared.machine().model_copy(update={"name": name}))
    assert shared.seen().machines == []
    store = shared.store(shared.other)
    assert [one.name for one in shared_state.shared_layouts(store, shared.other.root)] == ["tiny-two"]
    prod = replace(shared.one, name="tiny@prod")
    with holding(prod, "apply of tiny@prod", shared.times, shared.said.append) as record:
        live, name = DeploymentState.read(prod, shared.times, record), owner_of(prod).deployment_name(HEX, "000001")
        live.put(shared.machine().model_copy(update={"name": name}))
    found = shared_state.shared_layouts(store, shared.other.root)
    assert [(one.name, one.environment) for one in found] == [("tiny-two", "default"), ("tiny@prod", "prod")]
    assert [one.name for one in DeploymentState.look(found[1], shared.times).machines] == [name]
    assert shared.seen().machines == []
    below = shared.other.root / "below"
    below.mkdir()
    assert shared_state.shared_layouts(store, below) == []


def test_a_record_without_content_is_damaged_not_gone(shared: Project) -> None:
    store, key = shared.store(), key_of(owner_of(shared.one))
    store.write(key, b"", None, "by hand")
    with pytest.raises(DiagnosticError):
        shared.seen()


def test_who_was_cut_off_for_long_does_not_write_even_where_there_is_no_record_again(shared: Project) -> None:
    slow, other = shared.store(), shared.store(shared.other)
    first = slow.write("tiny-x", b"a: 1\n", None, "first")
    version = other.read("tiny-x").version
    for number in range(2, 9):
        version = other.write("tiny-x", b"a: %d\n" % number, version, "meanwhile")
    with pytest.raises(Overtaken):
        slow.write("tiny-x", b"a: slow\n", first, "late")
    with pytest.raises(Overtaken):
        slow.write("tiny-x", None, first, "late")
    assert slow.read("tiny-x").content == b"a: 8\n"
    assert other.write("tiny-x", None, version, "end") is None
    with pytest.raises(Overtaken):
        slow.write("tiny-x", b"a: slow\n", version, "late")
    assert slow.read_all() == {}
    assert other.read("tiny-x").version is None
    again = other.write("tiny-x", b"a: 9\n", None, "again")
    with pytest.raises(Overtaken):
        slow.write("tiny-x", b"a: 9\n# slow\n", first, "late")
    with pytest.raises(Overtaken):
        slow.write("tiny-x", b"a: slow\n", None, "late")
    assert slow.read("tiny-x") == Stored(again, b"a: 9\n")


def test_of_many_at_once_one_arrives_each_time(shared: Project) -> None:
    stores = [GitStore(f"file://{shared.remote}", shared.one.root, shared.one.root) for _ in range(4)]
    version: str | None = None
    for turn in range(3):

        def attempt(number: int, turn: int = turn, version: str | None = version) -> str | None:
            stores[number].read("tiny-x")
            with contextlib.suppress(Overtaken, StoreUnavailable):
                return stores[number].write("tiny-x", b"a: %d\nb: %d\n" % (turn, number), version, "one of them")
            return None

        with ThreadPoolExecutor(len(stores)) as threads:
            arrived = [one for one in threads.map(attempt, range(len(stores))) if one is not None]
        assert len(arrived) == 1
        assert stores[0].read("tiny-x").version == arrived[0]
        version = arrived[0]


def test_a_record_that_is_created_while_git_finds_none_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    remote = tmp_path / "remote"
    git("init", "-q", "--bare", str(remote), folder=tmp_path)
    slow, other = (GitStore(f"file://{remote}", tmp_path, tmp_path) for _ in range(2))
    exchange, created = GitStore._exchange, list[str]()

    def meanwhile(self: GitStore, *words: str, stdin: bytes = b"") -> Ended:
        ended = exchange(self, *words, stdin=stdin)
        if self is slow and words[0] == "fetch" and not created:
            created.append(other.write("tiny-x", b"a: 1\n", None, "the first"))
        return ended

    monkeypatch.setattr(GitStore, "_exchange", meanwhile)
    assert slow.read("tiny-x") == Stored(created[0], b"a: 1\n")
