"""The journal: every cut through it is a state to go on from, and damage is never passed over."""

import json
import os
from dataclasses import replace

import pytest

from fogspec.backends.naming import ForeignMachine, Owner
from fogspec.base.errors import OutOfDate
from fogspec.bench.journal import Journal, JournalState, LaunchRecord
from fogspec.catalog.machine import Machine
from fogspec.plan.schema import Sample
from fogspec.results.schema import Measured

MACHINE = Machine(infra="aws/us-east-1", instance="c6i.large", cpus=2, memory="4GiB", spot=False, price="$3.6/h")
SAMPLE = Sample(id="one", machine=MACHINE, reason="a corner")
RECORD = Measured(id="one", machine=MACHINE, measured_on="aws/c6i.large", state="timeout", requests=0,
                  duration="100s", spent="$0.1")  # fmt: skip


def started(name: str) -> LaunchRecord:
    return LaunchRecord(
        name=name, runner="local", application="sha256:app", sample=SAMPLE, price_usd_per_hour=3.6, lifetime_s=600.0,
        paid_s=1200.0, at_s=12.5, at_unix_s=1.7e9, boot="boot",
    )  # fmt: skip


def whole(path) -> Journal:
    journal = Journal(path)
    journal.begin("local", "sha256:app", "sha256:plan", 1.0)
    journal.start(started("a"))
    journal.end("a", 0.1, RECORD)
    journal.written("a")
    journal.start(started("b"))
    journal.end("b", 0.2, None)
    journal.start(started("c"))
    return journal


def test_what_is_read_back_is_what_was_written(tmp_path):
    journal = whole(tmp_path / "state" / "journal.jsonl")
    journal.close()
    again = Journal(tmp_path / "state" / "journal.jsonl")
    assert again.state == journal.state
    assert list(again.state.open) == ["c"]
    assert again.state.open["c"] == started("c")
    assert again.state.open["c"].commitment_usd == pytest.approx(1.2)
    assert (again.state.unwritten, again.state.attempts) == ({}, 3)
    assert again.state.spent_usd == pytest.approx(1.3)
    again.close()


def test_that_a_machine_did_not_end_by_itself_is_remembered(tmp_path):
    journal = whole(tmp_path / "journal.jsonl")
    assert journal.outlived("c").outlived
    journal.close()
    again = Journal(tmp_path / "journal.jsonl")
    assert again.state.open["c"] == replace(started("c"), outlived=True)
    again.close()


def test_a_record_that_was_not_written_yet_is_remembered(tmp_path):
    journal = Journal(tmp_path / "journal.jsonl")
    journal.begin("local", "sha256:app", "sha256:plan", 0.0)
    journal.start(started("a"))
    journal.end("a", 0.1, RECORD)
    journal.close()
    again = Journal(tmp_path / "journal.jsonl")
    assert again.state.unwritten["a"] == (started("a"), RECORD)
    again.close()


def test_a_full_disk_leaves_the_journal_as_it_was(tmp_path):
    path = tmp_path / "journal.jsonl"
    whole(path).close()
    before = path.read_bytes()
    full = False

    def sync(handle: int) -> None:
        if full:
            raise OSError(28, "No space left on device")
        os.fsync(handle)

    journal = Journal(path, sync)
    book = list(journal.state.open)
    full = True
    with pytest.raises(OSError, match="No space"):
        journal.start(started("d"))
    assert (path.read_bytes(), list(journal.state.open)) == (before, book)
    full = False
    journal.start(started("d"))
    journal.close()


def test_money_of_machines_without_a_record_is_not_forgotten(tmp_path):
    journal = whole(tmp_path / "journal.jsonl")
    journal.begin("local", "sha256:app", "sha256:plan", 1.1)
    assert journal.state.spent_usd == pytest.approx(1.3)
    journal.begin("local", "sha256:another", "sha256:plan", 0.0)
    assert journal.state.spent_usd == pytest.approx(1.3), "the budget is the application's"
    journal.begin("replay", "sha256:another", "sha256:plan", 0.2)
    assert journal.state.spent_usd == 0.2, "what a replay cost is no money"
    journal.begin("local", "sha256:app", "sha256:plan", 1.5)
    assert journal.state.spent_usd == 1.5
    journal.close()


def test_a_write_that_is_cut_short_is_no_entry(tmp_path, monkeypatch):
    path = tmp_path / "journal.jsonl"
    whole(path).close()
    before = path.read_bytes()
    journal = Journal(path)
    file, state = journal._file, list(journal.state.open)

    class Short:
        def __getattr__(self, name):
            return getattr(file, name)

        def write(self, content):
            return file.write(content[: len(content) // 2])

    journal._file = Short()
    with pytest.raises(OSError, match=r"\S"):
        journal.start(started("d"))
    assert (path.read_bytes(), list(journal.state.open)) == (before, state)
    journal._file = file
    journal.start(started("d"))
    journal.close()
    assert "d" in Journal(path).state.open


def test_a_foreign_name_in_the_journal_is_named(tmp_path):
    path = tmp_path / "journal.jsonl"
    owner = Owner("a repository", "default", "a")
    journal = whole(path)
    with pytest.raises(ForeignMachine, match="names c, which is not a machine of"):
        journal.check_owned(owner)
    journal.end("c", 0.0, None)
    journal.check_owned(owner)
    journal.start(replace(started(f"{owner.prefix}one")))
    journal.check_owned(owner)


def test_the_sum_of_a_journal_is_read_as_far_as_it_goes(tmp_path):
    path = tmp_path / "journal.jsonl"
    whole(path).close()
    content = path.read_bytes()
    state = JournalState.read(content)
    assert (list(state.open), state.attempts, state.campaigns, state.runner) == (["c"], 3, 1, "local")
    assert state.spent_usd == pytest.approx(1.3)
    assert JournalState.read(content + b"torn").open == state.open
    assert JournalState.read(b"").open == {}
    lines = content.splitlines(keepends=True)
    assert JournalState.read(b"".join([*lines[:2], b"nonsense\n", *lines[2:]])).attempts == 1


class Clocks:
    """A host's clocks: seconds of this boot, and of the date."""

    def __init__(self, boot: str, now_s: float, unix_s: float) -> None:
        self.boot, self.now_s, self.unix_s = (lambda: boot), (lambda: now_s), (lambda: unix_s)


@pytest.mark.parametrize(
    ("clocks", "age_s", "passed_s"),
    [
        (Clocks("boot", 112.5, 0.0), 100.0, 100.0),
        (Clocks("boot", 9012.5, 1.7e9), 9000.0, 9000.0),
        (Clocks("other", 5.0, 1.7e9 + 7200), 7200.0, 7200.0),
        (Clocks("other", 5.0, 1.7e9 + 60), 60.0, 1200.0),
        (Clocks("other", 5.0, 1.7e9 - 60), 0.0, 1200.0),
    ],
)
def test_how_long_a_machine_ran_by_the_clock_that_can_tell(clocks, age_s, passed_s):
    one = started("a")
    assert one.age_s(clocks) == pytest.approx(age_s)
    assert one.passed_s(clocks) == pytest.approx(passed_s)
    assert one.commitment_usd == pytest.approx(3.6 * 1200 / 3600)


def test_a_machine_that_ended_is_nobodys_sample_should_it_come_back(tmp_path):
    lines = [json.loads(line) for line in _content(tmp_path)]
    end = next(one for one in lines if one["do"] == "end")
    end |= {"at_s": 99.0, "at_unix_s": 1.8e9, "boot": "later"}
    state = JournalState.read(b"".join(json.dumps(one).encode() + b"\n" for one in lines))
    back = state.ended["a"]
    assert (back.at_s, back.at_unix_s, back.boot, back.outlived) == (99.0, 1.8e9, "later", False)
    assert back.application not in ("sha256:app", ""), "no bench measures it on"
    assert (back.name, back.sample, back.price_usd_per_hour) == ("a", SAMPLE, 3.6)


def _content(folder):
    path = folder / "journal.jsonl"
    whole(path).close()
    return path.read_bytes().splitlines()


@pytest.mark.parametrize("name", ["../evil", "a/b", "..", ".", "a\nb", "\x1b[2J", 7, None])
def test_no_name_of_a_journal_is_a_path(tmp_path, name):
    path = tmp_path / "journal.jsonl"
    path.write_text(
        json.dumps({"do": "campaign", "application": "a", "plan": "p", "base_usd": 0.0, "runner": name}) + "\n"
    )
    with pytest.raises(OutOfDate):
        Journal(path)
