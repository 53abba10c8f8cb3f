"""A plan is kept only while its samples serve: laws of search boxes, and prices that are new."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogspec.base.units import Range
from fogspec.catalog.filters import filter_offers
from fogspec.language.fingerprints import measured_record
from fogspec.language.schema import Hardware
from fogspec.plan.design import make_plan
from fogspec.plan.reuse import contains, reuse_plan
from tests.support.catalogs import application, table

ROWS = [
    f"{family}.{size},{gpu},{count},{cpus},{cpus * ratio},{price},{price / 3},{region},"
    for family, ratio in (("a", 2), ("b", 4))
    for size, cpus, price in (("s", 2, 0.1), ("m", 8, 0.4), ("l", 32, 1.6))
    for region in ("r1", "r2")
    for gpu, count in ((("", ""),) if family == "a" else (("", ""), ("T4", 1)))
]
CATALOG = table(*dict.fromkeys(ROWS))
ENDS = st.sampled_from([None, 1.0, 2.0, 4.0, 8.0, 32.0, 64.0])
RANGES = st.none() | st.builds(Range, ENDS, ENDS).filter(lambda one: None in (one.low, one.high) or one.low <= one.high)
ENTRIES = ["a.*", "b.*", "*", "a.s", "b.m", "*.l", "standard", "burstable"]
BOXES = st.tuples(
    st.builds(
        Hardware, cpus=RANGES, memory=RANGES, memory_per_cpu=RANGES, spot=st.booleans(),
        gpus=st.lists(st.sampled_from(["none", "T4"]), min_size=1, unique=True),
        allow=st.lists(st.sampled_from(ENTRIES), min_size=1, max_size=2), deny=st.lists(st.sampled_from(ENTRIES), max_size=2),
    ),
    st.lists(st.sampled_from(["aws", "aws/r1", "aws/r2"]), min_size=1, unique=True),
)  # fmt: skip


@pytest.mark.slow
@given(BOXES, BOXES)
def test_a_box_that_holds_another_admits_all_that_it_admits(outer: tuple, inner: tuple) -> None:
    if contains(*outer, *inner):
        wide, narrow = (filter_offers(CATALOG, *box).offers for box in (outer, inner))
        names = lambda one: {(*key, bool(spot)) for *key, spot in zip(one.region, one.instance, one.gpu, one.spot)}  # noqa: E731, B905
        assert names(narrow) <= names(wide)


@given(BOXES)
def test_a_box_holds_itself(box: tuple) -> None:
    assert contains(*box, *box)


def test_a_plan_is_kept_under_another_name() -> None:
    app = application({"cpus": "2..32"}, ["aws/r1"])
    plan = make_plan(app, CATALOG)
    renamed = app.model_copy(update={"metadata": app.metadata.model_copy(update={"name": "renamed"})})
    found = reuse_plan(renamed, plan, table(*list(dict.fromkeys(ROWS))[:-3]), measured_record(renamed))
    assert found is not None
    assert found.metadata.name == "renamed"
    assert [one.id for one in found.spec.samples] == [one.id for one in plan.spec.samples]


def test_a_kept_plan_has_the_same_samples_at_the_new_prices() -> None:
    app = application({"cpus": "2..32"}, ["aws/r1"])
    plan = make_plan(app, CATALOG)
    costlier = table(*(row.replace(",0.4,", ",0.5,") for row in dict.fromkeys(ROWS)))
    narrow = application({"cpus": "2..8"}, ["aws/r1"])
    found = reuse_plan(narrow, plan, costlier, measured_record(narrow))
    assert found is not None
    assert [one.id for one in found.spec.samples] == [one.id for one in plan.spec.samples]
    assert {one.machine.instance: one.machine.price for one in found.spec.samples}["a.m"] == 0.5
    assert found.spec.estimate.total > plan.spec.estimate.total
    assert found.spec.hardware == plan.spec.hardware, "the box that its samples were picked for"


def test_a_plan_that_measures_otherwise_or_too_little_is_not_kept() -> None:
    plan = make_plan(application({"cpus": "2..8"}, ["aws/r1"]), CATALOG)
    for other in (
        application({"cpus": "2..32"}, ["aws/r1"]),
        application({"cpus": "2..8"}, ["aws/r2"]),
        application({"cpus": "2..8"}, ["aws/r1"], warmup=7),
        application({"cpus": "2..8"}, ["aws/r1"], stop={"duration": "9min"}),
        application({"cpus": "2..8"}, ["aws/r1"], machines=["a.s"]),
    ):
        assert reuse_plan(other, plan, CATALOG, measured_record(other)) is None
    assert (
        reuse_plan(application({"cpus": "2..8"}, ["aws/r1"]), plan, CATALOG, {**plan.spec.inputs, "image": "sha256:1"})
        is None
    )
