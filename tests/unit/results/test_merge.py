"""Laws of joining results: no sample lost, none doubled, no money forgotten."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogspec.base.errors import Refused
from fogspec.catalog.machine import Machine
from fogspec.plan.schema import Batch, PlanMetadata, Sampling, sample_on
from fogspec.results.merge import join_results
from fogspec.results.schema import (
    Carried,
    LatencySummary,
    Measured,
    NestedIn,
    Results,
    ResultsBody,
    checksum_ok,
    with_checksum,
)
from fogspec.spec.schema import Hardware, Waiver

TYPES = "abcdef"


def machine(name: str) -> Machine:
    return Machine(infra="aws/r1", instance=f"{name}.large", cpus=4, memory=8.0, price=1.0)


def record(name: str, latency_s: float = 1.0, state: str = "ok", spent: float = 1.0) -> Measured:
    return Measured(
        id=sample_on(machine(name), "").id, machine=machine(name), measured_on="test", state=state, requests=9,
        reason=None if state == "ok" else "capacity", duration=10.0, spent=spent,
        latency=LatencySummary(mean=latency_s) if state == "ok" else None,
    )  # fmt: skip


def results(*records: Measured, spent: float | None = None, application: str = "sha256:1", **body: object) -> Results:
    paid = sum(one.spent for one in records) if spent is None else spent
    return with_checksum(
        PlanMetadata(name="demo"),
        ResultsBody(application=application, runner="local", spent=paid, samples=list(records), **body),
    )


RECORDS = st.lists(
    st.builds(record, st.sampled_from(TYPES), st.sampled_from([1.0, 2.0]), st.sampled_from(["ok", "failed"])),
    unique_by=lambda one: one.id,
)


@given(RECORDS, RECORDS)
def test_no_measurement_is_lost_and_none_doubled(first: list[Measured], second: list[Measured]) -> None:
    ours, other = results(*first), results(*second)
    joined = join_results(ours, other)
    found = joined.results.spec.samples
    assert len({one.id for one in found}) == len(found)
    assert checksum_ok(joined.results)
    for side in (first, second):
        for one in side:
            if one.state == "ok":
                assert sum(one.model_copy(update={"id": other.id}) == other for other in found) == 1
    assert {one.machine.instance for one in found} == {one.machine.instance for one in (*first, *second)}
    assert joined.results.spec.spent >= max(ours.spec.spent, other.spec.spent)
    assert join_results(joined.results, joined.results).results == joined.results
    for one in (ours, other):
        assert {found.id for found in join_results(joined.results, one).results.spec.samples} == {
            one.id for one in found
        }


@given(RECORDS)
def test_with_itself_or_nothing_it_stays_what_it_is(first: list[Measured]) -> None:
    ours = results(*first)
    assert join_results(ours, ours).results == ours
    assert join_results(ours, results()).results == ours


def test_a_sample_of_both_sides_is_two_and_its_parts_go_with_it() -> None:
    def part(of: Measured) -> Measured:
        half = Machine(infra="aws/r1", instance="a.small", cpus=2, memory=4.0, price=0.5)
        nested = NestedIn(sample=of.id, machine=of.machine, part="half")
        return of.model_copy(update={"id": f"{of.id}-half", "machine": half, "nested_in": nested, "spent": 0.0})

    one, other = record("a"), record("a", 2.0)
    joined = join_results(results(one, part(one)), results(other, part(other)))
    assert [found.id for found in joined.results.spec.samples] == [
        "aws-r1-a-large", "aws-r1-a-large-half", "aws-r1-a-large-repeat-2", "aws-r1-a-large-repeat-2-half",
    ]  # fmt: skip
    assert joined.twice == ("aws-r1-a-large",)
    assert joined.results.spec.spent == 2.0


def test_a_base_says_who_measured_again_and_what_both_have_paid() -> None:
    base = results(record("a"), spent=1.5)
    ours = results(record("a"), record("b"), spent=2.5)
    other = results(record("a", 2.0), record("c"), spent=3.5)
    joined = join_results(ours, other, base)
    assert joined.twice == ()
    found = {one.machine.instance: one.latency.mean for one in joined.results.spec.samples if one.latency}
    assert found == {"a.large": 2.0, "b.large": 1.0, "c.large": 1.0}
    assert joined.results.spec.spent == pytest.approx(4.5)


def test_samples_of_an_earlier_state_are_carried_on_with_the_others() -> None:
    waiver = Waiver(change="spec.cloud[0].env.LOG", old="info", new="debug", reason="log")
    step = Carried(application="sha256:1", samples=["aws-r1-a-large"], waivers=[waiver])
    newer = results(record("a"), record("b"), application="sha256:2", carried=[step])
    older = results(record("a"), record("c"))
    for ours, other in ((newer, older), (older, newer)):
        found = join_results(ours, other).results.spec
        assert found.application == "sha256:2"
        assert sorted(found.carried[0].samples) == ["aws-r1-a-large", "aws-r1-c-large"]
        assert len(found.samples) == 3


def test_batches_of_both_campaigns_are_kept_and_the_sampler_decides_again() -> None:
    def sampling(*names: str, ended: str | None = "enough") -> Sampling:
        batches = [Batch(reason=name, samples=[sample_on(machine(name), name)]) for name in names]
        return Sampling(
            hardware=Hardware(), infra=["aws/r1"], limits_digest="1", batches=batches, stop_reason=ended
        )  # fmt: skip

    ours = results(record("a"), record("b"), sampling=sampling("a", "b"))
    other = results(record("a"), record("c"), sampling=sampling("a", "c"))
    found = join_results(ours, other).results.spec.sampling
    assert found is not None
    assert [one.reason for one in found.batches] == ["a", "b", "c"]
    assert found.stop_reason is None
    longer = results(record("a"), record("b"), record("c"), sampling=sampling("a", "b", "c"))
    assert join_results(ours, longer).results.spec.sampling == longer.spec.sampling
    elsewhere = sampling("a").model_copy(update={"infra": ["aws/r2"]})
    with pytest.raises(Refused, match="different candidates"):
        join_results(ours, results(record("a"), sampling=elsewhere))


def test_what_measured_something_else_is_refused_and_named() -> None:
    ours = results(record("a"), field_digests={"cloud": "1", "probe": "1"}, pins={"work.py": "1"})
    other = results(
        record("b"), application="sha256:2", field_digests={"cloud": "2", "probe": "1"}, pins={"work.py": "2"}
    )
    with pytest.raises(Refused) as refused:
        join_results(ours, other)
    assert refused.value.hints[0] == "different: spec.cloud, work.py"
    renamed = with_checksum(PlanMetadata(name="other"), ours.spec)
    with pytest.raises(Refused, match="demo and of other"):
        join_results(ours, renamed)
    with pytest.raises(Refused, match="runner local"):
        join_results(ours, with_checksum(ours.metadata, ours.spec.model_copy(update={"runner": "skypilot"})))
