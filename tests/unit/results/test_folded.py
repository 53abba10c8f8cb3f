"""The files of samples and the results that they are: the same from any order, and what does not belong together is named."""

import random
from typing import Any

import pytest

from fogspec.base import digest
from fogspec.base.diagnostics import DiagnosticError
from fogspec.catalog.machine import Machine
from fogspec.language.schema import Hardware
from fogspec.plan.schema import Batch, Sample, Sampling
from fogspec.results.folded import Unmatched, folded, split
from fogspec.results.io import read_results_folder
from fogspec.results.schema import Carried, LatencySummary, Measured, ResultsBody, results_of
from tests.support.results import first, write

OLD, NEW, OTHER = ({"a.py": f"sha256:{name}"} for name in "abc")


def record(cpus: int, name: str = "", **more: Any) -> Measured:
    machine = Machine(infra="local", instance=f"{cpus}cpu-1gib", cpus=cpus, memory=1, price=0.1)
    base = {"state": "ok", "requests": 9, "latency": LatencySummary(mean=1 / cpus), "duration": 60.0, "spent": 0.1 / 60}
    return Measured(id=name or f"c{cpus}", machine=machine, measured_on="a test", **{**base, **more})


def sample(cpus: int) -> Sample:
    return Sample(id=f"c{cpus}", machine=record(cpus).machine, reason=f"{cpus} CPUs")


def sampling(*batches: list[int], stop: str | None = None, cpus: str = "1..9") -> Sampling:
    return Sampling(
        hardware=Hardware.model_validate({"cpus": cpus}),
        infra=["local"],
        limits_digest="sha256:l",
        batches=[Batch(reason=f"batch {n}", samples=list(map(sample, one))) for n, one in enumerate(batches, 1)],
        stop_reason=stop,
    )


def body(*records: Measured, inputs: dict[str, Any] = NEW, **more: Any) -> ResultsBody:
    return ResultsBody(inputs=inputs, runner="local", samples=list(records), **more)


CAMPAIGNS = {
    "nothing but samples": body(record(1), record(2)),
    "one that failed and was paid twice": body(record(1), record(2, state="failed", reason="crash"), paid={"c2": 0.5}),
    "paid without a record": body(record(1), paid={"c2": 0.25}),
    "an adaptive campaign": body(record(4), record(1), sampling=sampling([4], [2, 1])),
    "one that ended": body(record(4), record(1), sampling=sampling([4], [1], stop="enough")),
    "older samples": body(record(1), record(2), carried=[Carried(inputs=digest.of_value(OLD), samples=["c1"])]),
}


@pytest.mark.parametrize("name", CAMPAIGNS)
def test_results_are_what_their_files_say_in_any_order(name: str) -> None:
    found = CAMPAIGNS[name]
    files = list(split(found))
    random.Random(name).shuffle(files)
    assert folded(files) == results_of(found)
    assert folded(files).spec.spent == pytest.approx(sum(one.spent for one in files))


def test_a_sample_of_the_other_branch_has_the_changes_that_this_one_waived() -> None:
    waived = Carried(inputs=digest.of_value(OLD), samples=["c1"], waivers=[])
    (mine,), (other,) = (list(split(one)) for one in (body(record(1), carried=[waived]), body(record(2), inputs=OLD)))
    found = folded([other, mine])
    assert found.spec.inputs == NEW
    assert found.spec.carried == [waived.model_copy(update={"samples": ["c1", "c2"]})]
    assert found == folded([mine, other])


def test_two_campaigns_decide_again() -> None:
    sides = [
        body(record(4), record(cpus), sampling=sampling([4], [cpus], stop=stop))
        for cpus, stop in ((1, "enough"), (2, None))
    ]
    found = folded(list({one.id: one for side in sides for one in split(side)}.values()))
    assert [[each.id for each in batch.samples] for batch in found.spec.sampling.batches] == [["c4"], ["c1", "c2"]]
    assert found.spec.sampling.stop_reason is None


@pytest.mark.parametrize(
    ("other", "says"),
    [
        (body(record(2), inputs=OTHER), "what it measured is not what"),
        (body(record(2)).model_copy(update={"runner": "skypilot"}), "measured with the runner"),
    ],
)
def test_what_does_not_belong_together_is_named(tmp_path, other: ResultsBody, says: str) -> None:
    files = [*split(body(record(1))), *split(other)]
    with pytest.raises(Unmatched, match=says):
        folded(files)
    write(tmp_path / "results", body(record(1)))
    write(tmp_path / "other", other)
    (tmp_path / "other/c2.yaml").rename(tmp_path / "results/c2.yaml")
    with pytest.raises(DiagnosticError) as wrong:
        read_results_folder(tmp_path / "results")
    (one,) = wrong.value.diagnostics
    assert one.span.path.startswith(str(tmp_path / "results/c"))


def test_each_damaged_file_is_named_and_the_others_stay(tmp_path) -> None:
    folder = tmp_path / "results"
    write(folder, body(record(1), record(2), record(3)))
    path = first(folder)
    path.write_text(path.read_text()[:200])
    (folder / "c2.yaml").rename(folder / "c9.yaml")
    with pytest.raises(DiagnosticError) as wrong:
        read_results_folder(folder)
    assert {one.span.path for one in wrong.value.diagnostics} == {str(path), str(folder / "c9.yaml")}
    path.unlink()
    (folder / "c9.yaml").unlink()
    assert [one.id for one in read_results_folder(folder).spec.samples] == ["c3"]


def test_a_file_that_asks_for_another_machine_than_it_measured_is_refused(tmp_path) -> None:
    odd = record(1).model_copy(update={"machine": record(2).machine})
    write(tmp_path / "results", body(odd, sampling=sampling([1])))
    with pytest.raises(DiagnosticError, match="it asks for 1cpu-1gib, and measured 2cpu-1gib"):
        read_results_folder(tmp_path / "results")


def test_neither_a_name_nor_a_path_is_in_a_file(tmp_path) -> None:
    write(tmp_path / "results/my-robot", body(record(1, timings="sha256:" + "a" * 64)))
    (tmp_path / "results/my-robot").rename(tmp_path / "results/my-arm")
    assert "my-robot" not in first(tmp_path / "results/my-arm").read_text()
    assert read_results_folder(tmp_path / "results/my-arm").spec.samples


def test_a_batch_whose_files_were_not_all_written_is_chosen_again_and_one_that_was_paid_for_stays():
    whole = body(record(4), sampling=sampling([4], [2, 1]))
    files = {one.id: one for one in split(whole)}
    for lost in ("c2", "c1"):
        found = folded([one for name, one in files.items() if name != lost])
        assert found.spec.sampling == sampling([4])
    files["c1"] = files["c1"].model_copy(update={"spent": 0.1})
    found = folded([files["c4"], files["c1"]])
    assert [[each.id for each in batch.samples] for batch in found.spec.sampling.batches] == [["c4"], ["c1"]]
    first = next(split(body(sampling=sampling([4, 2]))))
    assert folded([first]).spec.sampling is None
