"""Quantities: what is read, what is refused with which fix, and that what is written is read back."""

from collections.abc import Callable
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
    "transfer": units.parse_transfer_usd_per_gib,
    "count": units.parse_count,
}


@pytest.mark.parametrize(
    ("kind", "text", "value"),
    [
        ("duration", "1.5s", 1.5), ("duration", "50ms", 0.05), ("duration", "5 min", 300.0), ("duration", "2h", 7200.0),
        ("duration", "1e-3s", 0.001), ("memory", "512MiB", 0.5), ("memory", "1TiB", 1024.0), ("memory", "16GB", 16e9 / 2**30),
        ("money", "$2.50", 2.5), ("money", "40 cent", 0.4), ("cost", "$0.001/request", 0.001),
        ("cost", "$2/1000 requests", 0.002), ("cost", "0.01 cent/request", 0.0001), ("price", "$0.526/h", 0.526),
        ("rate", "2Hz", 2.0), ("rate", "6/min", 0.1), ("percent", "5%", 0.05), ("count", 16, 16.0), ("count", "0.5", 0.5),
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
        ("duration", "-2s", "FS204", None), ("duration", "1e400s", "FS204", None), ("duration", True, "FS303", None),
        ("duration", ["2s"], "FS303", None), ("memory", 4, "FS202", "4GiB"), ("memory", "4G", "FS203", "4GiB"),
        ("memory", "4gb", "FS203", "4GB"), ("money", 2.5, "FS202", "$2.5"), ("money", "2.50 USD", "FS204", "$2.50"),
        ("cost", 0.002, "FS201", "$0.002/request"), ("cost", "$0.002", "FS201", "$0.002/request"),
        ("cost", "0.002/request", "FS202", "$0.002/request"), ("cost", "$2/0 requests", "FS204", "$2/request"),
        ("price", "$0.5", "FS201", "$0.5/h"), ("price", "0.5/h", "FS202", "$0.5/h"), ("rate", 10, "FS201", "10/s"),
        ("price", "$12/day", "FS201", None), ("price", "$0.5/hr", "FS201", "$0.5/h"), ("cost", "$0.5/h", "FS201", None),
        ("cost", "$0.5/reqs", "FS201", "$0.5/request"), ("transfer", "$0.09/gb", "FS201", "$0.09/GB"),
        ("transfer", "$0.09/request", "FS201", None), ("transfer", "$0.09", "FS201", "$0.09/GiB"),
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
    [(300.0, "5min"), (90.0, "90s"), (0.05, "50ms"), (7200.0, "2h"), (0.0, "0s"), (1.649, "1.649s")],
)
def test_durations_are_written_as_people_do(seconds: float, text: str) -> None:
    assert units.format_duration(seconds) == text
