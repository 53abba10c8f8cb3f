"""The price that is named before anything is spent, against sums by hand."""

from types import SimpleNamespace
from typing import Any

import pytest

from fogspec.backends.protocol import Costs
from fogspec.base.errors import Refused
from fogspec.bench.quote import Quote, check_prices
from fogspec.catalog.machine import Machine
from fogspec.plan.commitment import Commitment
from fogspec.plan.schema import Sample
from tests.support.catalogs import table

ROW = "{name},,,2,4,{price},,r1,"


def sample(name: str, price: float, infra: str = "our-rack/r1") -> Sample:
    machine = Machine(infra=infra, instance=name, cpus=2, memory=4.0, price=price)
    return Sample(id=f"s-{name}", machine=machine, reason="")


# 5 min until its end is armed, 13 min of life (80 s + 400 s + 5 min, in whole minutes), 2 min until it is gone.
TWENTY_MINUTES = Commitment(measuring_s=400.0, setup_s=80.0)
ONE, TWO, FREE = sample("one", 3.0), sample("two", 1.5), sample("free", 0.0, "local")


def quote(*todo: Sample, cap: float | None = None, costs: Costs = Costs.REAL, adaptive: bool = False) -> Quote:
    return Quote(
        name="demo", todo=todo, planned=5, adaptive=adaptive, commitment=TWENTY_MINUTES, cap_usd=cap, runner="skypilot",
        costs=costs,
    )  # fmt: skip


def test_the_most_is_every_machine_for_all_of_its_life() -> None:
    assert quote(ONE, TWO).usd(ONE) == pytest.approx(1.0)
    assert quote(ONE, TWO).worst_usd == pytest.approx(1.5)
    assert quote(ONE, TWO).line() == (
        "demo: 2 of 5 samples to measure: at most $1.50, if every machine runs until it ends by itself"
    )
    assert list(quote(ONE, FREE).lines()) == [
        "  s-one: our-rack/r1 one, $3.00/h, at most $1.00",
        "  s-free: local free, free",
    ]


def test_disk_and_address_are_said_and_counted() -> None:
    """On AWS 128 GiB, IOPS and throughput of $16.46 a month and $0.005 an hour; where nothing is known $0.06 an hour."""
    known, unknown = sample("known", 0.3, "aws/us-east-1"), sample("other", 0.3, "vast/x")
    assert quote(known).worst_usd == pytest.approx((0.3 + 16.46 / 730 + 0.005) / 3, abs=1e-6)
    assert list(quote(known).lines()) == [
        "  s-known: aws/us-east-1 known, $0.30/h, and $0.028/h for disk and address, at most $0.1092"
    ]
    assert list(quote(unknown).lines()) == [
        "  s-other: vast/x other, $0.30/h, and $0.06/h, which is assumed, for disk and address, at most $0.12"
    ]
    assert list(quote(known).together(1)) == ["1 machine at a time: at most $0.328/h, for 20 min at most"]


def test_machines_that_run_together_are_priced_together_and_all_of_them_have_a_longest_time() -> None:
    three = quote(ONE, TWO, sample("three", 0.5))
    assert list(three.together(2)) == ["2 machines at once: at most $4.50/h together, for 40 min at most"]
    assert list(three.together(8)) == ["3 machines at once: at most $5.00/h together, for 20 min at most"]
    assert list(quote(ONE, TWO).together(1)) == ["1 machine at a time: at most $3.00/h, for 40 min at most"]
    assert list(quote().together(2)) == []
    assert list(quote(ONE, TWO, costs=Costs.NOTHING).together(2)) == []


@pytest.mark.parametrize(
    ("cap", "said"),
    [
        (None, "at most $1.50, if every machine runs until it ends by itself"),
        (2.0, "at most $1.50, if every machine runs until it ends by itself"),
        (1.5, "at most $1.50, if every machine runs until it ends by itself"),
        (1.0, "at most $1.00, where it stops"),
    ],
)
def test_a_cap_counts_where_it_is_lower(cap: float | None, said: str) -> None:
    assert quote(ONE, TWO, cap=cap).line().endswith(said)


def test_an_adaptive_bench_may_spend_all_of_its_cap() -> None:
    assert quote(ONE, cap=9.0, adaptive=True).line() == (
        "demo: 1 of 5 samples to measure, then the machines that the model selects: at most $9.00"
    )
    assert quote(ONE, adaptive=True).line().endswith("the model selects: no budget")


def test_who_must_consent() -> None:
    assert quote(ONE).needs_consent
    assert quote(adaptive=True).needs_consent
    assert not quote().needs_consent
    assert not quote(ONE, costs=Costs.NOTHING, adaptive=True).needs_consent
    assert quote(ONE, costs=Costs.NOTHING).line().endswith("with the skypilot runner: costs nothing")
    assert quote().line() == "demo: 0 of 5 samples to measure: at most $0.00"


@pytest.mark.parametrize(
    ("budget", "spent", "most", "cap"),
    [(None, 1.0, None, None), (5.0, 1.0, None, 4.0), (5.0, 6.0, None, 0.0), (5.0, 1.0, 2.0, 2.0), (5.0, 4.0, 2.0, 1.0),
     (None, 0.0, 2.0, 2.0), (5.0, 0.0, 0.0, 0.0)],
)  # fmt: skip
def test_the_cap_is_what_is_left_and_what_is_allowed(
    budget: float | None, spent: float, most: float | None, cap: float | None
) -> None:
    found = Quote.of(prepared(budget, spent), backend(), most)
    assert found.cap_usd == (None if cap is None else pytest.approx(cap))
    assert (found.planned, found.todo, found.adaptive) == (2, (ONE,), False)
    assert found.commitment is TWENTY_MINUTES


def test_what_another_runner_spent_is_no_money_of_this_one() -> None:
    found = Quote.of(prepared(5.0, 3.0, runner="replay"), backend(), None)
    assert found.cap_usd == 5.0


@pytest.mark.parametrize(
    ("sampler", "only", "stopped", "adaptive"),
    [("grid", False, None, False), ("adaptive", True, None, False), ("adaptive", False, None, True),
     ("adaptive", False, "enough", False)],
)  # fmt: skip
def test_an_adaptive_campaign_that_has_ended_asks_for_no_more(
    sampler: str, only: bool, stopped: str | None, adaptive: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fogspec.plan.reuse.should_resume", lambda *_: False)
    one = prepared(5.0, 0.0)
    one.plan.spec.sampler, one.only = sampler, only
    one.results = SimpleNamespace(spec=SimpleNamespace(sampling=SimpleNamespace(stop_reason=stopped)))
    assert Quote.of(one, backend(), None).adaptive is adaptive
    if stopped:
        monkeypatch.setattr("fogspec.plan.reuse.should_resume", lambda *_: True)
        assert Quote.of(one, backend(), None).adaptive, "unless other limits ask for more"


def prepared(budget: float | None, spent: float, runner: str = "skypilot") -> Any:
    body = SimpleNamespace(samples=[ONE, TWO], sampler="grid", commitment=TWENTY_MINUTES)
    spec = SimpleNamespace(benchmark=SimpleNamespace(budget=budget))
    return SimpleNamespace(
        plan=SimpleNamespace(spec=body), application=SimpleNamespace(spec=spec), results=None, only=False, todo=(ONE,),
        layout=SimpleNamespace(name="demo"), spent_usd={runner: spent},
    )  # fmt: skip


def backend() -> Any:
    return SimpleNamespace(name="skypilot", costs=Costs.REAL)


@pytest.mark.parametrize(("now", "refused"), [(2.9, False), (3.0, False), (3.01, True)])
def test_a_price_that_rose_is_refused_and_named(now: float, refused: bool) -> None:
    prices = table(ROW.format(name="one", price=now), ROW.format(name="two", price=1.5), cloud="our-rack")
    if not refused:
        check_prices([ONE, TWO], prices, "again")
        return
    with pytest.raises(Refused, match="prices have risen") as said:
        check_prices([ONE, TWO], prices, "fogspec compile x")
    assert len(said.value.hints) == 2
    assert "one" in said.value.hints[0]
    assert said.value.hints[-1].endswith("fogspec compile x")


@pytest.mark.parametrize(
    ("budget", "spent", "costs", "said"),
    [
        (5.0, 1.25, Costs.REAL, "$1.25 of the budget of $5.00 is spent; spec.benchmark.budget allows more"),
        (5.0, 0.0, Costs.REAL, None),
        (None, 1.25, Costs.REAL, None),
        (5.0, 1.25, Costs.RECORDED, None),
    ],
)
def test_what_is_spent_already_is_said(budget: float | None, spent: float, costs: Costs, said: str | None) -> None:
    found = quote(ONE, costs=costs).spent_line(prepared(budget, spent))
    assert found is None if said is None else (found or "").startswith(said)


def test_what_becomes_of_machines_that_nobody_ends_is_said_where_they_cost_money() -> None:
    line, given = quote(ONE).unattended()
    assert given.startswith("each machine gets your credentials for our-rack")
    assert "a machine on our-rack starts" in line
    assert line.endswith("until fogspec down demo")
    assert list(quote(ONE, costs=Costs.RECORDED).unattended()) == []
    assert list(quote(FREE).unattended()) == []


def test_what_is_spent_is_said_of_this_runners_real_money_only() -> None:
    assert (
        quote(ONE).spent_line(prepared(5.0, 1.0))
        == "$1.00 of the budget of $5.00 is spent; spec.benchmark.budget allows more"
    )
    assert quote(ONE).spent_line(prepared(5.0, 3.0, runner="replay")) is None
    assert quote(ONE, costs=Costs.NOTHING).spent_line(prepared(5.0, 1.0)) is None
    assert quote(ONE).spent_line(prepared(None, 1.0)) is None


@pytest.mark.parametrize(("count", "more"), [(9, None), (10, "and 1 more")])
def test_many_rises_are_counted(count: int, more: str | None) -> None:
    todo = [sample(f"m{n}", 1.0) for n in range(count)]
    with pytest.raises(Refused) as refused:
        check_prices(todo, table(*(ROW.format(name=f"m{n}", price=2) for n in range(count)), cloud="our-rack"), "again")
    said = [one for one in refused.value.hints if one.startswith("and ")]
    assert said == ([more] if more else [])
