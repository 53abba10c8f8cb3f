"""Quantities: what is read, what is refused with which fix, and that what is written is read back."""

from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogspec.base import units
from fogspec.base.units import Range, UnitError

PARSERS = {
    "duration": units.parse_duration_s,
    "memory": units.parse_memory_gib,
    "money": units.parse_money_usd,
    "cost": units.parse_cost_usd_per_request,
    "price": units.parse_price_usd_per_hour,
    "rate": units.parse_rate_per_s,
    "percent": units.parse_percent,
    "count": units.parse_count,
}


@pytest.mark.parametrize(
    ("kind", "text", "value"),
    [
        ("duration", "1.5s", 1.5), ("duration", "50ms", 0.05), ("duration", "5 min", 300.0), ("duration", "2h", 7200.0),
        ("duration", "1e-3s", 0.001), ("memory", "512MiB", 0.5), ("memory", "1TiB", 1024.0),
        ("money", "$2.50", 2.5), ("money", "40 cent", 0.4), ("cost", "$0.001/request", 0.001),
        ("cost", "$2/1000 requests", 0.002), ("cost", "0.01 cent/request", 0.0001), ("price", "$0.526/h", 0.526),
        ("rate", "1/week", 1 / 604_800), ("rate", "2Hz", 2.0), ("rate", "6/min", 0.1),
        ("percent", "5%", 0.05), ("count", 16, 16.0), ("count", "0.5", 0.5),
    ],
)  # fmt: skip
def test_reads(kind: str, text: Any, value: float) -> None:
    assert PARSERS[kind](text) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    ("kind", "text", "code", "fix"),
    [
        ("duration", 2, "FS202", "2s"), ("duration", "5m", "FS203", "5min"), ("duration", "3 seconds", "FS203", "3s"),
        ("duration", "800MB", "FS203", None), ("duration", "3 secnds", "FS203", "3s"), ("memory", "4ms", "FS203", None),
        ("memory", "512m", "FS203", "512MiB"), ("duration", "4 apples", "FS203", None), ("duration", "5 S", "FS203", "5s"),
        ("duration", "-2s", "FS204", "2s"), ("duration", "1e400s", "FS204", None), ("duration", True, "FS303", None),
        ("duration", ["2s"], "FS303", None), ("memory", 4, "FS202", "4GiB"), ("memory", "4G", "FS203", "4GiB"),
        ("memory", "16GB", "FS203", "16GiB"), ("duration", 2000, "FS202", None),
        ("money", 2.5, "FS202", "$2.5"), ("money", "2.50 USD", "FS204", "$2.50"),
        ("cost", "$0.001 per request", "FS201", "$0.001/request"), ("cost", "1 cent per request", "FS201", "1 cent/request"),
        ("cost", "2 USD per 1000 requests", "FS201", "$2/1000 requests"),
        ("cost", 0.002, "FS201", "$0.002/request"), ("cost", "$0.002", "FS201", "$0.002/request"),
        ("cost", "0.002/request", "FS202", "$0.002/request"), ("cost", "$2/0 requests", "FS204", "$2/request"),
        ("price", "$0.5", "FS201", "$0.5/h"), ("price", "0.5/h", "FS202", "$0.5/h"), ("rate", 10, "FS201", "10/s"),
        ("price", "$12/day", "FS201", None), ("price", "$0.5/hr", "FS201", "$0.5/h"), ("cost", "$0.5/h", "FS201", None),
        ("cost", "$0.5/reqs", "FS201", "$0.5/request"),
        ("percent", 0.05, "FS202", "5%"), ("percent", 5, "FS202", "5%"), ("count", "4 cpus", "FS204", "4"),
    ],
)  # fmt: skip
def test_refuses_with_the_fix(kind: str, text: Any, code: str, fix: str | None) -> None:
    with pytest.raises(UnitError) as wrong:
        PARSERS[kind](text)
    assert (wrong.value.code, wrong.value.fix) == (code, fix)
    if fix is not None:
        PARSERS[kind](fix)


@pytest.mark.parametrize(
    ("text", "low", "high"),
    [("2..64", 2, 64), ("2..", 2, None), ("..64", None, 64), ("4", 4, 4), (4, 4, 4), (" 2 .. 64 ", 2, 64)],
)
def test_reads_ranges(text: Any, low: float | None, high: float | None) -> None:
    assert units.parse_range(text, units.parse_count) == Range(low, high)


@pytest.mark.parametrize(
    ("text", "parse", "code", "fix"),
    [
        ("64..2", units.parse_count, "FS205", "2..64"),
        ("4..8", units.parse_memory_gib, "FS202", "4GiB..8GiB"),
        ("4GiB..8", units.parse_memory_gib, "FS202", "4GiB..8GiB"),
        ("4..", units.parse_memory_gib, "FS202", "4GiB.."),
        ("..", units.parse_count, "FS204", None),
        ("4 to 8", units.parse_count, "FS204", "4..8"),
        ("8GiB..4096MiB", units.parse_memory_gib, "FS205", "4096MiB..8GiB"),
    ],
)
def test_refuses_ranges(text: str, parse: Callable[[Any], float], code: str, fix: str | None) -> None:
    with pytest.raises(UnitError) as wrong:
        units.parse_range(text, parse)
    assert (wrong.value.code, wrong.value.fix) == (code, fix)


FORMATTERS = [
    (units.format_duration, units.parse_duration_s), (units.format_memory, units.parse_memory_gib),
    (units.format_money, units.parse_money_usd), (units.format_cost, units.parse_cost_usd_per_request),
    (units.format_price, units.parse_price_usd_per_hour), (units.format_rate, units.parse_rate_per_s),
    (units.format_percent, units.parse_percent),
]  # fmt: skip


@pytest.mark.parametrize(("write", "read"), FORMATTERS)
@given(value=st.floats(min_value=0, max_value=1e12, allow_subnormal=False))
def test_what_is_written_is_read_back_to_the_last_bit(
    write: Callable[[float], str], read: Callable[[Any], float], value: float
) -> None:
    assert read(write(value)) == value


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (300.0, "5min"),
        (600.0, "10min"),
        (60.0, "1min"),
        (1200.0, "20min"),
        (36000.0, "10h"),
        (90.0, "90s"),
        (1000.0, "1000s"),
        (0.05, "50ms"),
        (7200.0, "2h"),
        (0.0, "0s"),
        (1.649, "1.649s"),
    ],
)
def test_durations_are_written_as_people_do(seconds: float, text: str) -> None:
    assert units.format_duration(seconds) == text


BY_HAND = {
    "duration": {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1, "min": 60, "h": 3600, "d": 86400},
    "memory": {"MiB": 1 / 1024, "GiB": 1, "TiB": 1024},
}
MEANT = {
    "duration": {
        "s": ["S", "sec", "secs", "second", "seconds", "Secnds"], "ms": ["msec", "millis", "milliseconds", "MS"],
        "min": ["m", "mins", "minute", "minutes", "Min"], "h": ["hour", "hours", "hr", "H"], "d": ["day", "days", "D"],
        "us": ["µs", "US"], "ns": ["NS"],
    },
    "memory": {
        "GiB": ["g", "gi", "gig", "gib", "G", "gigabytes", "gb", "gigabyte"], "MiB": ["m", "mi", "mib", "megabytes", "mb"],
        "TiB": ["t", "ti", "tib", "terabytes", "tb"],
    },
}  # fmt: skip


@pytest.mark.parametrize("kind", BY_HAND)
def test_every_unit_and_every_other_spelling_of_it(kind: str) -> None:
    for unit, scale in BY_HAND[kind].items():
        assert PARSERS[kind](f"3{unit}") == pytest.approx(3 * scale, rel=1e-15)
    for unit, spellings in MEANT[kind].items():
        for spelling in spellings:
            with pytest.raises(UnitError) as wrong:
                PARSERS[kind](f"3 {spelling}")
            assert (wrong.value.fix, wrong.value.code) == (f"3{unit}", "FS203"), spelling
            assert str(wrong.value) == wrong.value.message


@pytest.mark.parametrize(
    ("usd", "people", "short"),
    [(0.0, "$0.00", "$0"), (0.00123, "$0.0012", "$0.00123"), (0.0000005, "$0.00", "$0.0000005"), (0.999, "$0.999", "$0.999"),
     (1.0, "$1.00", "$1.00"), (1.005, "$1.00", "$1.00"), (12.345, "$12.35", "$12.35"), (99.96, "$99.96", "$100"),
     (1234.5, "$1,234.50", "$1,234"), (0.1, "$0.10", "$0.10"), (2.4, "$2.40", "$2.40"), (0.9996, "$0.9996", "$1.00")],
)  # fmt: skip
def test_money_for_people(usd: float, people: str, short: str) -> None:
    assert units.dollars(usd) == people
    assert units.money(usd) == short


@pytest.mark.parametrize(
    ("value", "low", "high", "holds"),
    [(2, 2, 3, True), (3, 2, 3, True), (1.9, 2, 3, False), (3.1, 2, 3, False), (0, None, 3, True), (9, 2, None, True),
     (4, None, 3, False), (1, 2, None, False), (7, None, None, True)],
)  # fmt: skip
def test_ranges_hold_their_ends(value: float, low: float | None, high: float | None, holds: bool) -> None:
    assert Range(low, high).holds(value) is holds


@pytest.mark.parametrize(
    ("value", "write", "text"),
    [
        (10.0, units.format_rate, "10/s"), (1 / 3600, units.format_rate, "1/h"), (0.5, units.format_rate, "0.5/s"),
        (251 / 604_800, units.format_rate, "35.857142857142854/day"),  # 1.4940476190476188/h is shorter, and another number
        (512 / 1024, units.format_memory, "0.5GiB"), (64.0, units.format_memory, "64GiB"), (0.0, units.format_memory, "0GiB"),
        (1e-6, units.format_duration, "1us"), (1e-9, units.format_duration, "0.001us"), (86400.0, units.format_duration, "1d"),
        (1800.0, units.format_duration, "30min"), (5400.0, units.format_duration, "1.5h"),
        (0.05, units.format_percent, "5%"), (1.0, units.format_percent, "100%"),
        (0.001, units.format_cost, "$0.001/request"), (0.526, units.format_price, "$0.526/h"),
        (2.5, units.format_money, "$2.5"),
        (1e15, units.format_number, "1000000000000000.0"),
        (1e-7, units.format_number, "0.0000001"), (999999999999999.0, units.format_number, "999999999999999"),
    ],
)  # fmt: skip
def test_what_is_written_by_hand(value: float, write: Callable[[float], str], text: str) -> None:
    assert write(value) == text


@pytest.mark.parametrize(
    ("low", "high", "text"), [(2, 64, "2..64"), (None, 64, "..64"), (2, None, "2.."), (4, 4, "4"), (None, None, "..")]
)
def test_ranges_are_written(low: float | None, high: float | None, text: str) -> None:
    assert units.format_range(Range(low, high), units.format_number) == text
    assert units.rounded(123456.0) == 123500.0
    assert units.rounded(0.00123456, 2) == 0.0012


@pytest.mark.parametrize(
    ("kind", "text", "message"),
    [
        ("money", "many", "must be an amount such as $2.50 or 40 cent"), ("rate", "fast", "must be a rate such as 10/s"),
        ("percent", "much", "must be a share such as 5%"), ("count", "few", "must be a number without a unit"),
        ("cost", "$0.5/h", "must be per request, such as $0.001/request; constraints.price"),
        ("cost", "$1/meter", "must say per what, such as $0.001/request"), ("price", "$1/m", "must say per hour, such as"),
        ("money", "$1e999", "must be finite"),
        ("count", float("inf"), "must be finite"), ("duration", "fast", "must be a duration with its unit, such as 2s"),
        ("memory", "3 xy", "must be a memory size in one of MiB, GiB"), ("cost", "$1/0.5 requests", "at least one request"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said(kind: str, text: Any, message: str) -> None:
    with pytest.raises(UnitError) as wrong:
        PARSERS[kind](text)
    assert str(wrong.value).startswith(message) or message in str(wrong.value)


@pytest.mark.parametrize(
    ("fraction", "text"),
    [
        (0.0, "0%"),
        (0.0004, "< 0.1%"),
        (0.004, "0.4%"),
        (0.18, "18%"),
        (0.997, "99.7%"),
        (0.99999, "> 99.9%"),
        (1.0, "100%"),
        (1.004, "100%"),
    ],
)
def test_a_percentage_is_0_or_100_only_where_it_is(fraction: float, text: str) -> None:
    assert units.shown_percent(fraction) == text


def test_headroom_and_excess_are_told_apart() -> None:
    assert units.headroom_text(1e-5, 1.0) == "> 99.9% headroom"
    assert units.headroom_text(1.04, 1.0) == "4% over the limit"
    assert units.headroom_text(1.0, 0.0) == "over the limit"
    assert units.headroom_text(0.0, 0.0) == "0% headroom"


@pytest.mark.parametrize(
    ("left", "right", "texts"),
    [
        (2.0004, 2.0, ("2.0004 s", "2 s")),
        (13.54, 10.0, ("13.5 s", "10 s")),
        (0.04389, 0.04, ("43.9 ms", "40 ms")),
        (2.0, 2.0, ("2 s", "2 s")),
    ],
)
def test_a_value_and_its_limit_never_read_the_same(left: float, right: float, texts: tuple[str, str]) -> None:
    assert units.shown_apart(left, right, units.shown_duration) == texts


def test_a_duration_that_rounds_up_takes_the_larger_unit() -> None:
    assert units.shown_duration(0.9999) == "1 s"
    assert units.shown_duration(0.0009999) == "1 ms"
    assert units.shown_duration(0.0000123) == "12.3 µs"
    assert units.shown_duration(600.0) == "10 min"


@pytest.mark.parametrize(
    ("text", "fix"), [("2G-64G", "2GiB..64GiB"), ("2GiB, 64GiB", "2GiB..64GiB"), ("2GiB-64xyz", None)]
)
def test_a_range_with_another_sign_is_mended_where_both_ends_are_known(text: str, fix: str | None) -> None:
    with pytest.raises(UnitError) as wrong:
        units.parse_range(text, units.parse_memory_gib)
    assert wrong.value.fix == fix


@pytest.mark.parametrize(
    ("parse", "text", "fix"),
    [
        (units.parse_count, "16+", "16.."),
        (units.parse_count, ">= 16", "16.."),
        (units.parse_memory_gib, "32+", "32GiB.."),
        (units.parse_memory_gib, "32 GB+", "32GiB.."),
    ],
)
def test_a_least_value_as_skypilot_writes_it_is_an_open_range(parse, text: str, fix: str) -> None:
    with pytest.raises(UnitError) as wrong:
        units.parse_range(text, parse)
    assert wrong.value.fix == fix


@pytest.mark.parametrize(
    ("parse", "text", "fix"),
    [
        (units.parse_duration_s, "1,5s", "1.5s"),
        (units.parse_duration_s, "1,5 s", "1.5 s"),
        (units.parse_money_usd, "$2,50", "$2.50"),
        (units.parse_duration_s, "1,500ms", None),
    ],
)
def test_a_decimal_comma_is_mended_where_it_can_be_nothing_else(parse, text: str, fix: str | None) -> None:
    with pytest.raises(UnitError) as wrong:
        parse(text)
    assert wrong.value.fix == fix


def test_a_text_that_patterns_would_be_tried_on_for_hours_is_refused_at_once() -> None:
    for text in ("1" + " " * 10**6 + "x9", "1,5" + " " * 10**6 + "1", "1" * 10**6 + "+x"):
        with pytest.raises(UnitError, match="at most 2000 characters"):
            units.parse_range(text, units.parse_memory_gib)


def test_a_deployment_lasts_longer_than_no_time() -> None:
    assert units.check_until(" 1s ") == "1s"
    with pytest.raises(UnitError, match="more than zero"):
        units.check_until("0s")
    assert units.parse_until("2027-03-31T18:00:00Z") == datetime(2027, 3, 31, 18, tzinfo=UTC)


def test_an_amount_without_a_denominator_is_mended_in_both() -> None:
    for text, fix in (("2.50 USD", "$2.50/request"), ("USD 2.50/", "$2.50/request"), ("many/request s", None)):
        with pytest.raises(UnitError) as wrong:
            units.parse_cost_usd_per_request(text)
        assert wrong.value.fix == fix


@pytest.mark.parametrize("value", [0.027347, 1.71482, 0.00414499, 3.94512, 99.964])
def test_what_is_computed_is_shown_as_what_is_read_from_a_file(value: float) -> None:
    for show in (units.shown, units.shown_duration, units.money):
        assert show(value) == show(units.rounded(value))
    assert units.shown(1234567.0) == "1,234,567"
