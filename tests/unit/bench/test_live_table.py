"""The live table: what it says of samples, also of those that nobody knew of when it began."""

import io
import json
from pathlib import Path
from typing import Any

from rich.console import Console

from fogspec.backends.protocol import Partial, SampleStatus
from fogspec.bench.live_table import COLUMNS, LiveTable
from fogspec.bench.progress import Events, Lines, Totals
from fogspec.bench.types import Event, EventKind
from fogspec.catalog.machine import Machine
from fogspec.plan.schema import Sample
from fogspec.results.schema import LatencySummary, Measured


def sample(name: str) -> Sample:
    machine = Machine(infra="aws/r1", instance=f"{name}.large", cpus=2, memory=4.0, price=0.1)
    return Sample(id=name, machine=machine, reason="")


def drawn(table: LiveTable) -> list[list[str]]:
    columns = [list(column.cells) for column in table.table().columns]
    return [[str(cell) for cell in row] for row in zip(*columns, strict=True)]


def test_it_shows_what_happens(tmp_path: Path):
    now = [0.0]
    console = Console(file=io.StringIO(), width=200)
    table = LiveTable([sample("a"), sample("b")], 200, 2.5, lambda: now[0], console)
    assert [column.header for column in table.table().columns] == list(COLUMNS)
    assert [row[2] for row in drawn(table)] == ["waits", "waits"]
    timings = tmp_path / "timings.jsonl"
    line = {"name": "w", "latency_s": 0.5, "ok": True}
    timings.write_text((json.dumps(line) + "\n") * 3 + '{"name": "cut off')
    table(Event(sample=sample("a"), kind=EventKind.STARTS, spent_usd=0.0, committed_usd=0.2, ends_s=100.0))
    now[0] = 40.0
    table(
        Event(
            sample=sample("a"),
            kind=EventKind.MEASURES,
            spent_usd=0.0,
            committed_usd=0.2,
            status=SampleStatus(running=True, timings=timings),
            ends_s=100.0,
        )
    )
    row = drawn(table)[0]
    assert row == ["a", "aws/r1/a.large", "measures", "3 of 200", "500 ms", "40 s", "at most 60 s"]
    caption = str(table.table().caption)
    assert caption == "0 of 2 samples done; spent $0.00 of $2.50, committed at most $0.20; time left: not known yet"
    far = SampleStatus(running=True, so_far=Partial(12, 0.25))
    table(
        Event(sample=sample("b"), kind=EventKind.MEASURES, spent_usd=0.0, committed_usd=0.2, status=far, ends_s=100.0)
    )
    assert drawn(table)[1][3:5] == ["12 of 200", "250 ms"], "its timings come when it is over"
    record = Measured(
        id="a", machine=sample("a").machine, measured_on="x", state="ok", requests=200, duration=55.0, spent=0.1,
        latency=LatencySummary(mean=0.5),
    )  # fmt: skip
    table(Event(sample=sample("a"), kind=EventKind.DONE, spent_usd=0.1, committed_usd=0.0, record=record))
    assert drawn(table)[0][2:] == ["ok", "200 of 200", "500 ms", "55 s", ""]
    table(Event(sample=sample("later"), kind=EventKind.STARTS, spent_usd=0.1, committed_usd=0.2, ends_s=300.0))
    assert [row[0] for row in drawn(table)] == ["a", "b", "later"]
    with table:
        now[0] += 1


def test_a_narrow_terminal_shows_whole_names(tmp_path: Path):
    names = [f"aws-us-east-1-c6i-{size}xlarge" for size in (2, 4)]
    out = io.StringIO()
    table = LiveTable([sample(name) for name in names], 200, None, lambda: 0.0, Console(file=out, width=80), warmup=5)
    timings = tmp_path / "timings.jsonl"
    timings.write_text(json.dumps({"name": "w", "latency_s": 0.5, "ok": True}) + "\n")
    for count, shown in ((1, ""), (7, "2 of 200")):
        timings.write_text((json.dumps({"name": "w", "latency_s": 0.5, "ok": True}) + "\n") * count)
        table(
            Event(
                sample=sample(names[0]),
                kind=EventKind.MEASURES,
                spent_usd=0.0,
                committed_usd=0.2,
                status=SampleStatus(running=True, timings=timings),
            )
        )
        assert drawn(table)[0][2] == shown, "warm-up does not count"
    Console(file=out, width=80).print(table.table())
    assert all(name in out.getvalue() for name in names)


def event(name: str, kind: EventKind, spent_usd: float = 0.0, committed_usd: float = 0.0) -> Event:
    return Event(sample=sample(name), kind=kind, spent_usd=spent_usd, committed_usd=committed_usd)


def test_the_time_left_rests_on_the_samples_that_are_done() -> None:
    now = [0.0]
    totals = Totals([sample(name) for name in "abcde"], 2.0, lambda: now[0])
    for name in "ab":
        totals.take(event(name, EventKind.STARTS, 0.0, 0.5))
    assert totals.left_s is None
    now[0] = 100.0
    totals.take(event("a", EventKind.DONE, 0.1, 0.25))
    totals.take(event("c", EventKind.STARTS, 0.1, 0.5))
    now[0] = 140.0
    assert totals.counts == (1, 5)
    # b is over its time, c has 60 s to go, d and e are to come: 260 s of machines, two at once.
    assert totals.left_s == 130.0
    assert totals.line() == (
        "1 of 5 samples done; spent $0.10 of $2.00, committed at most $0.50; about 2.2 min left, as 1 sample took 100 s"
    )
    totals.take(event("d", EventKind.UNWANTED, 0.1))
    assert totals.counts == (1, 4)
    for name in "bce":
        totals.take(event(name, EventKind.DONE, 0.4))
    assert totals.line() == "4 of 4 samples done; spent $0.40 of $2.00"


def test_a_sample_that_is_tried_again_is_not_done() -> None:
    totals = Totals([sample("a")], None, lambda: 0.0, more=True)
    totals.take(event("a", EventKind.STARTS))
    totals.take(event("a", EventKind.RETRIED))
    totals.take(event("substitute", EventKind.STARTS))
    assert totals.counts == (0, 2)
    assert totals.line().startswith("0 of 2 samples done, more may follow; spent $0.00")


def test_totals_follow_what_is_done_in_lines_and_in_json() -> None:
    lines, facts = list[str](), list[dict[str, Any]]()
    for reporter in (Lines(lines.append, Totals([sample("a")], 1.0, lambda: 0.0)),
                     Events(facts.append, Totals([sample("a")], 1.0, lambda: 0.0))):  # fmt: skip
        for kind in (EventKind.STARTS, EventKind.DONE):
            reporter(event("a", kind, 0.25))
    assert lines[2] == "1 of 1 sample done; spent $0.25 of $1.00"
    assert [one["samples_done"] for one in facts] == [0, 1]
    assert facts[1]["samples_planned"] == 1
