"""The ways to make a plan fit, against a search of every way that there is, in fractions of a cent."""

import re
from fractions import Fraction
from itertools import combinations
from math import ceil

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogspec.base.errors import Infeasible
from fogspec.catalog.filters import filter_offers
from fogspec.plan import budget as module
from fogspec.plan.budget import BudgetOption, CostEstimate, ceil_cents, cheapest_options, estimate_cost, within_budget
from fogspec.plan.design import make_plan
from fogspec.plan.schema import Plan, estimate
from tests.support.catalogs import application, table

ROWS = [
    f"{family}.{size},{gpu},{count},{cpus},{cpus * ratio},{price},{price / 3},r1,"
    for family, ratio in (("a", 2), ("b", 4))
    for size, cpus, price in (("s", 2, 0.1), ("m", 8, 0.4), ("l", 32, 1.6))
    for gpu, count in ((("", ""),) if family == "a" else (("", ""), ("T4", 1)))
]
CATALOG = table(*ROWS)
BESIDE = Fraction(2) * (
    Fraction("16.46") / 730 + Fraction("0.005")
)  # of disk and address of each, in a region that is not known
HARDWARE = {"cpus": "2..32", "gpus": ["none", "T4"]}


def planned(budget: float | None, hardware: dict[str, object] = HARDWARE, **benchmark: object) -> tuple[object, Plan]:
    app = application(hardware, ["aws/r1"], budget=None if budget is None else f"${budget}", **benchmark)
    return app, make_plan(app, CATALOG)


def paid_s(setup_s: float, measuring_s: float) -> Fraction:
    """5 min until the machine's end is armed, its life in whole minutes with 5 min to collect, 2 min until it is gone."""
    return Fraction(300 + ceil((Fraction(setup_s) + Fraction(measuring_s) + 300) / 60) * 60 + 120)


def accepted(app: object, catalog: object = CATALOG, spent: float = 0.0) -> object:
    """What `compile` would find of a changed spec: here without rules, and with nothing measured."""

    def cost(spec: object) -> float | None:
        try:
            plan = make_plan(app.model_copy(update={"spec": spec}), catalog)  # type: ignore[attr-defined,arg-type]
        except Infeasible:
            return None
        return estimate_cost(plan, spent_usd=spent).total_usd

    return cost


def options(budget: float, spent: float = 0.0, hardware: dict[str, object] = HARDWARE) -> list[str]:
    app, plan = planned(budget, hardware)
    offers = filter_offers(CATALOG, app.spec.hardware, app.spec.infra)  # type: ignore[attr-defined]
    return [
        one.line()
        for one in cheapest_options(app, plan, estimate_cost(plan, spent_usd=spent), offers, accepted(app, spent=spent))
    ]  # type: ignore[arg-type]


@given(st.integers(0, 10**7), st.integers(0, 99))
def test_whole_cents_are_rounded_up_and_never_down(cents: int, hundredths: int) -> None:
    exact = Fraction(cents) + Fraction(hundredths, 100)
    assert round(ceil_cents(float(exact / 100)) * 100) == ceil(exact)


def test_a_budget_of_nothing_buys_nothing_and_none_needs_no_change() -> None:
    assert options(0.0) == []
    app, plan = planned(None)
    offers = filter_offers(CATALOG, app.spec.hardware, app.spec.infra)  # type: ignore[attr-defined]
    assert cheapest_options(app, plan, estimate_cost(plan), offers, accepted(app)) == []  # type: ignore[arg-type]


def test_the_cost_is_what_is_left_to_do_and_what_was_spent() -> None:
    _, plan = planned(1.0)
    samples = plan.spec.samples
    done = frozenset(one.id for one in samples[:2])
    due = estimate_cost(plan, done, 0.25)
    assert [one.id for one in due.todo] == [one.id for one in samples[2:]]
    hours = paid_s(plan.spec.ready_timeout, plan.spec.duration) / 3600
    by_hand = sum((Fraction(str(one.machine.price)) + BESIDE) for one in samples[2:]) * hours + Fraction(1, 4)
    assert due.total_usd == pytest.approx(float(by_hand), abs=2e-6)


@pytest.mark.parametrize(("over", "fits"), [(-0.01, True), (0.0, True), (0.000001, False), (1.0, False)])
def test_a_budget_holds_to_the_last_digit(over: float, fits: bool) -> None:
    _, plan = planned(None)
    due = estimate_cost(plan)
    assert within_budget(plan, due), "no budget is no limit"
    limited = plan.model_copy(update={"spec": plan.spec.model_copy(update={"budget": due.total_usd - over})})
    assert within_budget(limited, due) is fits
    assert within_budget(limited, CostEstimate((), 99.0, estimate((), plan.spec.commitment))), (
        "nothing is left to pay for"
    )


@pytest.mark.parametrize("budget", [0.2, 0.35, 0.5])
@pytest.mark.parametrize("spent", [0.0, 0.1])
def test_the_most_machines_that_fit_are_kept(budget: float, spent: float) -> None:
    _, plan = planned(budget)
    body = plan.spec
    most = 0
    for count in range(len(body.samples) + 1):
        for some in combinations(body.samples, count):
            hours = paid_s(body.ready_timeout, body.duration) / 3600
            if spent + float(sum((Fraction(str(one.machine.price)) + BESIDE) for one in some) * hours) <= budget + 1e-7:
                most = count
                break
    app, _ = planned(budget)
    offers = filter_offers(CATALOG, app.spec.hardware, app.spec.infra)  # type: ignore[attr-defined]
    due, cost = estimate_cost(plan, spent_usd=spent), accepted(app, spent=spent)
    every = cheapest_options(app, plan, due, offers, cost)  # type: ignore[arg-type]
    found = [one for one in every if "spec.benchmark.machines" in one.change]
    for one in found:
        assert one.change.startswith("set spec.benchmark.machines to [")
        assert one.change.endswith(f"], {most} of {len(body.samples)} machines")
        assert one.loss == pytest.approx(1 - most / len(body.samples))
        assert one.total_usd <= budget
        assert one.loses.count("(") // 3 >= 1, "each lost machine is named with what it stood for"


def every_option(budget: float, monkeypatch: pytest.MonkeyPatch, **hardware: object) -> dict[str, BudgetOption]:
    """All options for a plan of this budget, by what they change."""
    monkeypatch.setattr(module, "OPTIONS", 99)
    app, plan = planned(budget, {**HARDWARE, **hardware})
    offers = filter_offers(CATALOG, app.spec.hardware, app.spec.infra)  # type: ignore[attr-defined]
    found = cheapest_options(app, plan, estimate_cost(plan), offers, accepted(app))  # type: ignore[arg-type]
    assert len({one.change for one in found}) == len(found)
    return {one.change: one for one in found}


def round_down(seconds: float) -> int:
    """The coarsest of whole minutes, tens of seconds and seconds that takes off at most a tenth."""
    return next(int(seconds // step * step) for step in (60, 10, 1) if seconds // step * step >= 0.9 * seconds)


@pytest.mark.parametrize("part", [0.7, 0.88, 0.92, 0.97])
def test_less_time_is_as_much_as_fits_and_a_round_figure(part: float, monkeypatch: pytest.MonkeyPatch) -> None:
    budget = round(part * planned(None)[1].spec.estimate.total, 4)
    _, plan = planned(budget)
    body = plan.spec
    usd_per_hour = sum((Fraction(str(one.machine.price)) + BESIDE) for one in body.samples)
    found = every_option(budget, monkeypatch)
    seen = 0
    for name, now_s, other_s, least_s, loses in (
        ("stop.duration", body.duration, body.ready_timeout, 10, "loses requests of each sample after that"),
        ("ready_timeout", body.ready_timeout, body.duration, 30, "loses every machine that takes longer to be ready"),
    ):
        fitting = [
            seconds
            for seconds in range(1, int(now_s))
            if usd_per_hour * paid_s(seconds, other_s) / 3600 <= Fraction(str(budget))
        ]
        mine = [one for change, one in found.items() if change.startswith(f"lower spec.benchmark.{name} from ")]
        if not fitting or round_down(fitting[-1]) < least_s:
            assert mine == []
            continue
        new_s = round_down(fitting[-1])
        (one,) = mine
        shown = f"{new_s}s" if new_s % 60 else f"{new_s // 60}min"
        assert one.change.endswith(f" to {shown}")
        assert one.loss == pytest.approx(1 - new_s / now_s)
        assert one.total_usd == pytest.approx(float(usd_per_hour * paid_s(new_s, other_s) / 3600))
        assert one.loses == loses
        seen += 1
    assert seen or part < 0.8


@pytest.mark.parametrize("budget", [0.45, 0.6, 0.75, 0.9])
def test_a_narrower_box_is_the_widest_that_fits(budget: float, monkeypatch: pytest.MonkeyPatch) -> None:
    found = every_option(budget, monkeypatch)
    totals = {high: planned(budget, {**HARDWARE, "cpus": f"2..{high}"})[1].spec.estimate.total for high in (2, 8, 32)}
    fitting = [high for high in (2, 8) if totals[high] <= budget]
    said = [change for change in found if "hardware.cpus" in change]
    if not fitting:
        assert said == []
    else:
        high = max(fitting)
        one = found[f"lower spec.hardware.cpus to at most {high}"]
        lost = sum(int(row.split(",")[3]) > high for row in ROWS) / len(ROWS)
        assert (one.loss, one.total_usd) == (pytest.approx(lost), pytest.approx(totals[high]))
        assert one.loses == f"loses {lost:.0%} of the candidates, those with more vCPUs"
        assert len(said) == 1
    for gpu, left, what in (("none", "T4", "machines without a GPU"), ("T4", "none", "machines with T4")):
        total = planned(budget, {**HARDWARE, "gpus": [left]})[1].spec.estimate.total
        one_or_none = found.get(f"take {gpu} out of spec.hardware.gpus")
        assert (one_or_none is not None) == (total <= budget)
        if one_or_none is not None:
            lost = sum((row.split(",")[1] == "T4") == (gpu == "T4") for row in ROWS) / len(ROWS)
            assert (one_or_none.loss, one_or_none.total_usd) == (pytest.approx(lost), pytest.approx(total))
            assert one_or_none.loses == f"loses {lost:.0%} of the candidates, {what}"
    assert not [change for change in every_option(budget, monkeypatch, gpus=["none"]) if "gpus" in change]


def test_lost_machines_are_named_four_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    for budget in (0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.75, 0.9):
        for change, one in every_option(budget, monkeypatch).items():
            if (found := re.search(r"(\d+) of (\d+) machines", change)) is None:
                continue
            lost = int(found[2]) - int(found[1])
            assert one.loses.count("; ") == min(lost, 5) - 1
            assert (f"; and {lost - 4} more" in one.loses) == (lost > 4)


def test_a_box_without_a_lower_end_keeps_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "OPTIONS", 99)
    for hardware in ({"gpus": ["none"]}, {"gpus": ["none"], "cpus": "8.."}):
        app, plan = planned(0.3, hardware)
        offers = filter_offers(CATALOG, app.spec.hardware, app.spec.infra)  # type: ignore[attr-defined]
        found = cheapest_options(app, plan, estimate_cost(plan), offers, accepted(app))  # type: ignore[arg-type]
        for one in found:
            if "cpus" in one.change:
                high = int(one.change.rsplit(" ", 1)[1])
                low = "8" if "cpus" in hardware else ""
                _, narrow = planned(0.3, {**hardware, "cpus": f"{low}..{high}"})
                assert narrow.spec.estimate.total == pytest.approx(one.total_usd)


def test_the_least_loss_comes_first_and_never_more_than_three() -> None:
    app, plan = planned(0.4)
    offers = filter_offers(CATALOG, app.spec.hardware, app.spec.infra)  # type: ignore[attr-defined]
    found = cheapest_options(app, plan, estimate_cost(plan), offers, accepted(app))  # type: ignore[arg-type]
    assert 1 <= len(found) <= 3
    assert [one.loss for one in found] == sorted(one.loss for one in found)
    assert all(0 < one.loss < 1 and one.total_usd <= 0.4 for one in found)
    assert all(one.line() == f"{one.change}: at most ${ceil_cents(one.total_usd):.2f}; {one.loses}" for one in found)


def test_a_list_of_machines_is_not_narrowed_by_hardware() -> None:
    app = application(HARDWARE, ["aws/r1"], budget="$0.01", machines=["a.s", "a.m"])
    plan = make_plan(app, CATALOG)
    offers = filter_offers(CATALOG, app.spec.hardware, app.spec.infra)
    assert not [
        one
        for one in cheapest_options(app, plan, estimate_cost(plan), offers, accepted(app))
        if "hardware" in one.change
    ]


@pytest.mark.parametrize("seconds", [1, 9, 10, 11, 59, 60, 61, 66, 67, 119, 120, 239, 240, 299, 600, 1234.5, 3601])
def test_a_round_figure_takes_off_a_tenth_at_most(seconds: float) -> None:
    assert module._round_down(seconds) == round_down(seconds)
    assert module._round_down(-seconds) < 0, "there is no time at all"


def test_an_accelerator_that_all_machines_left_would_have_to_have_is_no_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "OPTIONS", 99)
    app = application(HARDWARE, ["aws/r1"], budget="$0.2")
    plain = table(*(row for row in ROWS if ",T4," not in row))
    offers = filter_offers(plain, app.spec.hardware, app.spec.infra)
    plan = make_plan(app, plain)
    found = cheapest_options(app, plan, estimate_cost(plan), offers, accepted(app, plain))
    assert not [one.change for one in found if one.change == "take none out of spec.hardware.gpus"]
