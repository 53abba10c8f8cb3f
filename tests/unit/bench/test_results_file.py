"""The files of results while they grow: each whole, with a checksum, and without secrets."""

import gzip

import pytest

from fogspec.base import digest
from fogspec.base.errors import InvalidInput, Refused
from fogspec.base.layout import Layout
from fogspec.base.redaction import register
from fogspec.bench.results_file import ResultsFile, set_aside
from fogspec.bench.run import check_same_runner
from fogspec.catalog.machine import Machine
from fogspec.results.io import read_results, timings_path
from fogspec.results.schema import LatencySummary, Measured
from fogspec_lab.recordings import recordings
from tests.support.results import text

MACHINE = Machine(infra="local", instance="1cpu-1gib", cpus=1, memory="1GiB", spot=False, price="$0/h")


def record(name: str, detail: str | None = None) -> Measured:
    latency = LatencySummary.model_construct(mean=0.1 / 3, sd=1e-9, p50=None, p95=None, p99=None)
    return Measured.model_construct(
        id=name, machine=MACHINE, measured_on="local/1cpu-1gib", state="ok", reason=None, detail=detail, requests=3,
        failed_requests=0, latency=latency, latency_lower_bound=None, metrics={"length": 1 / 3}, duration=1 / 7, spent=1 / 9,
        timings=None,
    )  # fmt: skip


def results_file(layout: Layout) -> ResultsFile:
    return ResultsFile(
        layout=layout, inputs={"a.py": "sha256:a"}, runner="local", source=None,
    )  # fmt: skip


@pytest.fixture
def file(tmp_path):
    layout = Layout.of(tmp_path / "specs" / "app.yaml", "app")
    return results_file(layout)


def test_after_every_record_its_file_is_whole_and_says_the_same_numbers(file):
    for count, name in enumerate(["a", "x", "b"], 1):
        file.put(record(name), 0.1 * count)
        read = read_results(file.layout)
        assert {one.id for one in read.spec.samples} >= {name}
    assert [one.id for one in read.spec.samples] == ["a", "b", "x"]
    assert read == file.results()
    assert read.spec.samples[1] == record("b")


def test_going_on_gives_the_same_bytes_as_one_run(file):
    for name in ("a", "b"):
        file.put(record(name), 0.2)
    before = text(file.layout.results)
    other = results_file(file.layout)
    other.resume(read_results(file.layout))
    other._written.clear()
    other.write()
    assert text(file.layout.results) == before


def test_timings_are_kept_and_named(file, tmp_path):
    raw = tmp_path / "raw.jsonl"
    raw.write_text("{}\n")
    assert file.keep(record("a"), raw).timings is not None
    packed = timings_path(file.layout.results, "a").read_bytes()
    assert gzip.decompress(packed) == b"{}\n"
    raw.write_text("")
    assert file.keep(record("a"), raw).timings is None
    assert file.keep(record("a"), None).timings is None


def test_a_results_folder_that_cannot_be_written_is_said(file):
    file.layout.results.parent.write_text("a file")
    with pytest.raises(InvalidInput, match=r"results/app/a\.yaml: cannot be written"):
        file.put(record("a"), 0.0)


def test_secrets_do_not_reach_the_results(file, monkeypatch, tmp_path):
    monkeypatch.setenv("MAP_TOKEN", "s3cr3t-value")
    register(["MAP_TOKEN", "NOT_SET"])
    raw = tmp_path / "raw.jsonl"
    raw.write_text('{"reason": "401 for s3cr3t-value"}\n')
    file.keep(record("a"), raw)
    packed = timings_path(file.layout.results, "a").read_bytes()
    assert gzip.decompress(packed) == b'{"reason": "401 for $MAP_TOKEN"}\n'


def test_older_results_are_set_aside_with_their_timings(file, tmp_path):
    raw = tmp_path / "raw.jsonl"
    for number in (1, 2):
        raw.write_text(f"{number}\n")
        file.put(file.keep(record("a"), raw), 0.0)
        before = text(file.layout.results)
        kept = set_aside(file.layout)
        file._written.clear()
        assert kept.relative_to(tmp_path).as_posix() == f"results/app.old-{number}"
        assert text(kept) == before
        (found,), _ = recordings(str(kept))
        assert found.timings is not None
        assert digest.of_bytes(found.timings.read_bytes()) == found.record.timings
    assert not file.layout.results.exists()
    assert not file.layout.timings.exists()


@pytest.mark.parametrize("reason", ["interrupted", "budget", "capacity", "quota"])
def test_what_was_measured_stays_when_measuring_it_again_comes_to_nothing(file, tmp_path, reason):
    raw = tmp_path / "raw.jsonl"
    raw.write_text("first\n")
    first = file.keep(record("a"), raw)
    file.put(first, 0.1)
    raw.write_text("second\n")
    broken = record("a").model_copy(update={"state": "failed", "reason": reason})
    file.put(file.keep(broken, raw), 0.3)
    read = read_results(file.layout)
    assert (read.spec.samples, read.spec.spent) == ([first], 0.3)
    path = timings_path(file.layout.results, "a")
    assert gzip.decompress(path.read_bytes()) == b"first\n"
    crashed = broken.model_copy(update={"reason": "crash"})
    file.put(file.keep(crashed, raw), 0.4)
    assert read_results(file.layout).spec.samples == [first], "a failure never replaces a measurement"
    again = record("a").model_copy(update={"requests": 77})
    file.put(file.keep(again, raw), 0.5)
    assert read_results(file.layout).spec.samples[0].requests == 77
    file.put(file.keep(crashed.model_copy(update={"id": "b"}), raw), 0.6)
    file.put(file.keep(record("b"), raw), 0.7)
    assert [one.state for one in read_results(file.layout).spec.samples] == ["ok", "ok"]


def test_measurements_of_two_kinds_are_not_mixed(file):
    class Other:
        name = "replay"

    file.put(record("a"), 0.0)
    with pytest.raises(Refused, match="they are not mixed"):
        check_same_runner(file.results(), Other())
    file.samples.clear()
    check_same_runner(file.results(), Other())
