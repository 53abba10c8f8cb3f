"""Quantities as people write them: a number and its unit in one string, kept as a float in base units.

Base units: seconds, GiB, USD, USD per request, USD per hour, requests per second. Every parser raises
`UnitError`, whose message says what must hold and whose `fix` is the text to write instead. Every formatter
writes the shortest text that its parser reads back to the same float.
"""

import difflib
import math
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import datetime
from decimal import Decimal
from typing import Any


class UnitError(ValueError):
    """A quantity that cannot be read: `message` goes after the field's name, `fix` is what to write instead."""

    def __init__(self, message: str, fix: str | None = None, code: str = "FS204") -> None:
        super().__init__(message)
        self.message = message
        self.fix = fix
        self.code = code


@dataclass(frozen=True, slots=True)
class Range:
    """A closed interval in base units; `None` is unbounded on that side."""

    low: float | None
    high: float | None

    def holds(self, value: float) -> bool:
        """Return whether `value` lies in the interval, ends included."""
        return (self.low is None or value >= self.low) and (self.high is None or value <= self.high)


HOURS_PER_MONTH = 730
_CORE_HOURS: ContextVar[bool] = ContextVar("core-hours", default=False)
REQUESTS_SHOWN, REQUESTS_TEXT = 1000, "1,000 requests"  # whose cost people are shown

NUMBER = r"(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?"
LONG_S = 60.0
LONGEST = 2000  # characters of a quantity, which patterns are tried on; the smallest float has 1,100
DURATION_S = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
MEMORY_GIB = {"MiB": 2.0**-10, "GiB": 1.0, "TiB": 1024.0}  # no GB: 16GB is written for a machine of 16 GiB

RATE_S = {
    **{unit: DURATION_S[unit] for unit in ("s", "min", "h")},
    "day": 86400.0,
    "week": 604800.0,
    "month": 2628000.0,
}

# Other spellings of units, in lower case; a word that two quantities share has an entry in each.
SPELLINGS = {
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "msec": "ms", "millis": "ms", "milliseconds": "ms",
    "m": "min", "mins": "min", "minute": "min", "minutes": "min", "hour": "h", "hours": "h", "hr": "h",
    "day": "d", "days": "d", "µs": "us",
}  # fmt: skip
MEMORY_SPELLINGS = {
    "g": "GiB", "gi": "GiB", "gig": "GiB", "gb": "GiB", "gigabytes": "GiB", "m": "MiB", "mi": "MiB", "mb": "MiB",
    "megabytes": "MiB", "t": "TiB", "ti": "TiB", "tb": "TiB", "terabytes": "TiB",
}  # fmt: skip


def parse_duration_s(text: Any) -> float:
    """Return seconds from `1.5s`, `50ms`, `5min`, `2h`."""
    return _parse_scaled(text, DURATION_S, SPELLINGS, "a duration", "s")


def parse_until(text: str) -> float | datetime:
    """Return seconds from `8h`, or the date of `2027-03-31T18:00:00Z`."""
    body = _body(text)
    if not re.match(r"\d{4}-\d", body):
        return parse_duration_s(text)
    try:
        date = datetime.fromisoformat(body)
    except ValueError:
        raise UnitError("must be a date such as 2027-03-31T18:00:00Z, or a time such as 8h") from None
    if date.tzinfo is None:
        fix = f"{body if 'T' in body else f'{body}T00:00:00'}Z"
        raise UnitError("must say its time zone", fix, "FS202")
    return date


def check_until(text: str) -> str:
    """Return the text if `parse_until` reads it; raise UnitError, also for a time that is not more than zero."""
    if parse_until(text) == 0:
        raise UnitError("must be more than zero")
    return text.strip()


def parse_memory_gib(text: Any) -> float:
    """Return GiB from `64GiB`, `512MiB`."""
    return _parse_scaled(text, MEMORY_GIB, MEMORY_SPELLINGS, "a memory size", "GiB")


def parse_money_usd(text: Any) -> float:
    """Return USD from `$2.50` or `40 cent`."""
    body = _body(text)
    if match := re.fullmatch(rf"\$\s*({NUMBER})", body):
        return _finite(match[1])
    if match := re.fullmatch(rf"({NUMBER})\s*(?:cents?|¢)", body):
        return _finite(match[1]) / 100
    if re.fullmatch(NUMBER, body):
        raise UnitError("must say its currency", f"${body}", "FS202")
    match = re.fullmatch(rf"(?:USD|usd)?\s*({NUMBER})\s*(?:USD|usd|dollars?|\$)?", body)
    wrong = UnitError("must be an amount such as $2.50 or 40 cent", f"${match[1]}" if match else None)
    raise _decimal_comma(body) or wrong


def parse_cost_usd_per_request(text: Any) -> float:
    """Return USD per request from `$0.001/request`, `$2/1000 requests`, `0.01 cent/request`."""
    amount, slash, per = _body(text).partition("/")
    amount = f"${amount.strip()}" if re.fullmatch(NUMBER, amount.strip()) else amount.strip()
    match = re.fullmatch(rf"\s*({NUMBER})?\s*requests?\s*", per)
    if per.strip().lower() in {"h", "hour", "hr"}:
        raise UnitError(
            "must be per request, such as $0.001/request; constraints.price limits the price per hour", None, "FS201"
        )
    if not slash or not match:
        if worded := re.fullmatch(rf"(.+?)\s+per\s+(?:({NUMBER})\s+)?requests?", amount):
            amount, per = worded[1], f"{worded[2]} requests" if worded[2] else "request"
        try:
            parse_money_usd(amount)
        except UnitError as wrong:
            amount = wrong.fix or ""
        if worded and amount:
            raise UnitError("must have '/' in place of 'per'", f"{amount}/{per}", "FS201")
        meant = amount and (not per.strip() or "req" in per.lower())
        raise _unsaid("must say per what", f"{amount}/request" if meant else None, "$0.001/request")
    count = _finite(match[1]) if match[1] else 1.0
    if count < 1:
        raise UnitError("must be per at least one request", f"{amount}/request")
    if _body(text).partition("/")[0].strip() != amount:
        raise UnitError("must say its currency", f"{amount}/{per.strip()}", "FS202")
    return parse_money_usd(amount) / count


def parse_price_usd_per_hour(text: Any) -> float:
    """Return USD per hour from `$0.526/h`."""
    amount, slash, per = _body(text).partition("/")
    if not slash or per.strip() not in {"h", "hour"}:
        number, unit = re.search(NUMBER, amount), _close(per.strip().lower() or "h", {"h": 1.0}, SPELLINGS)
        raise _unsaid("must say per hour", f"${number[0]}/h" if number and unit == "h" else None, "$0.50/h")
    try:
        return parse_money_usd(amount)
    except UnitError as wrong:
        raise UnitError(wrong.message, f"{wrong.fix}/h" if wrong.fix else None, wrong.code) from None


def parse_rate_per_s(text: Any) -> float:
    """Return a rate per second from `10/s`, `6/min`, `1000/h`, `2Hz`, `5/week`; a month has 730 hours."""
    body = _body(text)
    if match := re.fullmatch(rf"({NUMBER})\s*Hz", body):
        return _finite(match[1])
    if match := re.fullmatch(rf"({NUMBER})\s*(?:requests?)?\s*/\s*({'|'.join(RATE_S)})", body):
        return _finite(match[1]) / RATE_S[match[2]]
    if re.fullmatch(NUMBER, body):
        raise UnitError("must say per what time", f"{body}/s", "FS201")
    raise UnitError("must be a rate such as 10/s, 6/min or 2Hz")


def parse_percent(text: Any) -> float:
    """Return a fraction from `5%`."""
    body = _body(text)
    if match := re.fullmatch(rf"({NUMBER})\s*%", body):
        return _finite(str(Decimal(match[1]) / 100))
    if re.fullmatch(NUMBER, body):
        value = _finite(body)
        raise UnitError("must be a share in percent", format_percent(value if value <= 1 else value / 100), "FS202")
    raise UnitError("must be a share such as 5%")


def parse_range(text: Any, parse: Callable[[Any], float]) -> Range:
    """Return a closed interval from `2..64`, `2..`, `..64` or one value `4`; each end read by `parse`."""
    body = _body(text)
    if ".." not in body:
        try:
            value = parse(text)
        except UnitError as unread:
            raise _meant_range(body, parse) or _meant_least(body, parse) or unread from None
        return Range(value, value)
    low_text, _, high_text = (part.strip() for part in body.partition(".."))
    if not low_text and not high_text:
        raise UnitError("must have at least one end, such as 2.. or ..64")
    low, low_fix, wrong = _end(low_text, parse)
    high, high_fix, also_wrong = _end(high_text, parse)
    if first := wrong or also_wrong:
        fix = None if low_fix is None or high_fix is None else f"{low_fix}..{high_fix}"
        raise UnitError(first.message, fix, first.code)
    if low is not None and high is not None and low > high:
        raise UnitError("must go from the smaller to the larger value", f"{high_text}..{low_text}", "FS205")
    return Range(low, high)


def parse_count(text: Any) -> float:
    """Return a positive number without a unit, such as a vCPU count."""
    body = _body(text)
    if not re.fullmatch(NUMBER, body):
        number = re.match(NUMBER, body)
        raise UnitError("must be a number without a unit", number[0] if number else None)
    return _finite(body)


def _unsaid(message: str, fix: str | None, example: str) -> UnitError:
    """Return the error of an amount without its denominator; without a fix if it seems to be another quantity."""
    return UnitError(message if fix else f"{message}, such as {example}", fix, "FS201")


def _meant_range(text: str, parse: Callable[[Any], float]) -> UnitError | None:
    """Return the error of a range with another sign than `..` between its ends, such as `2G-64G`; None for other text."""
    match = re.fullmatch(rf"({NUMBER}\s*\w*)\s*(?:-|–|—|:|,|\bto\b)\s*({NUMBER}\s*\w*)", text)
    ends = [_end(end.strip(), parse)[1] for end in match.groups()] if match else []
    return (
        UnitError("must be a range with '..' between its ends", "..".join(map(str, ends)))
        if all(ends) and ends
        else None
    )


def _meant_least(text: str, parse: Callable[[Any], float]) -> UnitError | None:
    """Return the error of `16+`, as SkyPilot writes a least value, or `>=16`; None for other text."""
    match = re.fullmatch(rf"({NUMBER}\s?\w*)\s?\+|(?:>=|≥)\s?({NUMBER}\s?\w*)", text)
    least = _end((match[1] or match[2]).strip(), parse)[1] if match else None
    return UnitError("must be a range with '..', here without an upper end", f"{least}..") if least else None


def _decimal_comma(text: str) -> UnitError | None:
    """Return the error of `1,5s`; None for other text, and for `1,500ms`, which may be either."""
    if not re.fullmatch(r"\D*\d+,(\d{1,2}|\d{4,})\D*", text):
        return None
    return UnitError("must have a point before its decimals", text.replace(",", "."))


def _end(text: str, parse: Callable[[Any], float]) -> tuple[float | None, str | None, UnitError | None]:
    """Return one end of a range: its value, its text or the fix of it, and its error."""
    try:
        return (parse(text) if text else None), text, None
    except UnitError as wrong:
        return None, wrong.fix, wrong


def _body(text: Any) -> str:
    """Return the text of a scalar; a number is written as it was most likely typed."""
    if isinstance(text, bool) or not isinstance(text, (str, int, float)):
        raise UnitError("must be written as one string, such as 2s, 4GiB or $2.50", None, "FS303")
    if not isinstance(text, str) and not math.isfinite(text):
        raise UnitError("must be finite")
    if isinstance(text, str) and len(text) > LONGEST:
        raise UnitError(f"must have at most {LONGEST} characters")
    return format_number(text) if isinstance(text, (int, float)) else text.strip()


def _finite(number: str, scale: float = 1.0) -> float:
    value = _exactly(number, scale)
    if not math.isfinite(value):
        raise UnitError("must be finite")
    return value


def rounded(value: float, digits: int = 4) -> float:
    """Return the value to so many significant digits: more would be noise, and would differ between processors."""
    return float(f"{value:.{digits}g}")


def format_number(value: float) -> str:
    """Return the shortest decimal text that reads back to the same float, without an exponent if that is short."""
    if value == int(value) and abs(value) < 1e15:
        return str(int(value))
    text = repr(float(value))
    return format(Decimal(text), "f") if "e-" in text and value > 1e-12 else text


def format_duration(seconds: float) -> str:
    """Return `1.5s`, `50ms`, `5min`: in smaller units below one second, in larger ones if that is shorter; never `0.5h`."""
    if 0 < seconds < 1:
        unit, places = ("ms", 3) if seconds >= 1e-3 else ("us", 6)
        text = format(Decimal(repr(float(seconds))).scaleb(places), "f")
        return f"{text.rstrip('0').rstrip('.') if '.' in text else text}{unit}"
    scales = {"d": 86400.0, "h": 3600.0, "min": 60.0, "s": 1.0}
    return _format_scaled(seconds, {unit: scale for unit, scale in scales.items() if scale <= seconds}, "s")


def format_memory(gib: float) -> str:
    """Return `64GiB`, `512MiB`."""
    return _format_scaled(gib, {"GiB": 1.0, "MiB": 2.0**-10}, "GiB")


def format_money(usd: float) -> str:
    """Return `$2.5`."""
    return f"${format_number(usd)}"


def dollars(usd: float) -> str:
    """Return `$12.34`, `$0.77`, for people; below one dollar to a hundredth of a cent where there is one: `$0.0123`.

    Within `core_hours`, here as in what follows: `0.77 core-h`.
    """
    if usd >= 1:
        return _amount(f"{usd:,.2f}")
    whole, _, rest = f"{usd:.4f}".partition(".")
    return _amount(f"{whole}.{rest.rstrip('0').ljust(2, '0')}")


def money(usd: float, digits: int = 3) -> str:
    """Return `$0.526`, `$2.40`, `$385`, for people: with so many significant digits, and cents below $100."""
    if usd == 0:
        return _amount("0")
    usd = _as_written(usd, digits)
    to_show = abs(rounded(usd, digits))  # $99.96 is $100
    cents = 2 if to_show < 100 else 0
    text = f"{usd:,.{max(cents, digits - 1 - math.floor(math.log10(to_show)))}f}"
    whole, _, rest = text.partition(".")
    rest = rest.rstrip("0").ljust(cents, "0")
    return _amount(f"{whole}.{rest}" if rest else whole)


@contextmanager
def core_hours(counted: bool) -> Iterator[None]:
    """Show people costs in core-hours within, if these are what is `counted`: those of a catalog without prices."""
    before = _CORE_HOURS.set(counted)
    try:
        yield
    finally:
        _CORE_HOURS.reset(before)


def _amount(number: str) -> str:
    return f"{number} core-h" if _CORE_HOURS.get() else f"${number}"


def _as_written(value: float, digits: int) -> float:
    """Return the value as files have it, so that what is read from a file and what is computed are shown alike."""
    return rounded(value) if digits <= 3 and abs(value) < 1000 else value


def shown(value: float, digits: int = 3) -> str:
    """Return `1.65`, `26`, `1,250`: a number for people, with three significant digits, never with an exponent."""
    if not value or not math.isfinite(value):
        return f"{value:g}"
    value = _as_written(value, digits)
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    text = f"{value:,.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def shown_memory(gib: float) -> str:
    """Return `1.25 GiB`, or `512 MiB`, for people."""
    return f"{shown(gib)} GiB" if gib >= 1 else f"{shown(gib * 1024)} MiB"


def shown_duration(seconds: float, digits: int = 3) -> str:
    """Return `1.65 s`, `26 ms`, `10 min`, for people, with so many significant digits."""
    steps = ((1e-3, 1e-6, "µs"), (1.0, 1e-3, "ms"), (120.0, 1.0, "s"), (7200.0, 60.0, "min"), (math.inf, 3600.0, "h"))
    if not seconds:
        return "0 s"
    to_show = rounded(seconds, digits)  # 0.9999 s is 1 s, not 1,000 ms
    scale, unit = next((scale, unit) for below, scale, unit in steps if to_show < below)
    return f"{shown(seconds / scale, digits)} {unit}"


def shown_interval(ends_s: tuple[float, float] | None) -> str:
    """Return ` [1.56, 1.74]`, for people, with a space before it; units are left out that the upper end has too."""
    if ends_s is None:
        return ""
    low, high = map(shown_duration, ends_s)
    unit = high.rpartition(" ")[2]
    same = low.rpartition(" ")[2] == unit
    return f" [{low.removesuffix(f' {unit}')}, {high.removesuffix(f' {unit}')}]" if same else f" [{low}, {high}]"


def shown_price(usd_per_hour: float, digits: int = 3) -> str:
    """Return `$0.526/h`, for people, with so many significant digits."""
    return f"{money(usd_per_hour, digits)}/h"


def shown_month(usd_per_month: float) -> str:
    """Return `$384/month`, or `$29.20/month`, for people."""
    return f"{money(usd_per_month)}/month"


def shown_cost(usd_per_request: float, digits: int = 3) -> str:
    """Return `$0.241 per 1,000 requests`, for people: the one unit in which costs are compared."""
    return f"{money(REQUESTS_SHOWN * usd_per_request, digits)} per {REQUESTS_TEXT}"


def shown_apart(left: float, right: float, show: Callable[[float, int], str] = shown) -> tuple[str, str]:
    """Return both values for people, with as many digits, from three on, as it takes to tell them apart."""
    texts = ((show(left, digits), show(right, digits)) for digits in range(3, 10))
    return next((pair for pair in texts if left == right or pair[0] != pair[1]), (show(left, 3), show(right, 3)))


def shown_percent(fraction: float) -> str:
    """Return `18%`, or `0.4%`, `99.7%`, `< 0.1%` and `> 99.9%` near the ends, where 0% and 100% would not be true."""
    percent = 100 * fraction
    if 0.5 <= percent < 99.5 or not 0 < percent < 100:
        return f"{percent:.0f}%"
    if percent < 0.05:
        return "< 0.1%"
    return "> 99.9%" if percent >= 99.95 else f"{percent:.1f}%"


def headroom_text(value: float, bound: float) -> str:
    """Return `18% headroom` of a value in its limit, and `4% over the limit` beyond it."""
    if value > bound:
        return f"{shown_percent(value / bound - 1)} over the limit" if bound > 0 else "over the limit"
    return f"{shown_percent(1 - value / bound) if bound > 0 else '0%'} headroom"


def against(latency_s: float, cost_usd: float, other: str, other_latency_s: float, other_cost_usd: float) -> str:
    """Return `6.3 times cheaper and 17% faster than c6i.16xlarge`, of a machine and another one; costs are of a request."""
    parts = [_apart(cost_usd, other_cost_usd, "cheaper", "more expensive")] if other_cost_usd else []
    return f"{' and '.join([*parts, _apart(latency_s, other_latency_s, 'faster', 'slower')])} than {other}"


def _apart(own: float, other: float, less: str, more: str) -> str:
    ratio, word = (other / own if own else math.inf, less) if own < other else (own / other, more)
    if ratio < 2:
        return f"{abs(1 - own / other):.0%} {word}"
    return f"{f'{ratio:.2g}' if ratio < 100 else f'{ratio:,.0f}'} times {word}"


def format_cost(usd_per_request: float) -> str:
    """Return `$0.001/request`."""
    return f"${format_number(usd_per_request)}/request"


def format_price(usd_per_hour: float) -> str:
    """Return `$0.526/h`."""
    return f"${format_number(usd_per_hour)}/h"


def format_rate(per_s: float) -> str:
    """Return `10/s`, or per a longer time if that is shorter: `0.05/h`, `1/week`."""
    texts = [f"{format_number(per_s * scale)}/{unit}" for unit, scale in RATE_S.items() if unit != "min"]
    return min((text for text in texts if parse_rate_per_s(text) == per_s), key=len, default=texts[0])


def format_percent(share: float) -> str:
    """Return `5%`."""
    percent = Decimal(repr(float(share))) * 100
    text = format(percent, "f")
    return f"{text.rstrip('0').rstrip('.') if '.' in text else text}%"


def format_range(value: Range, fmt: Callable[[float], str]) -> str:
    """Return `2..64`, with each end written by `fmt`."""
    low = "" if value.low is None else fmt(value.low)
    high = "" if value.high is None else fmt(value.high)
    return low if low and low == high else f"{low}..{high}"


def _parse_scaled(text: Any, units: Mapping[str, float], spellings: Mapping[str, str], what: str, usual: str) -> float:
    body = _body(text)
    if re.fullmatch(NUMBER, body):
        if usual == "s" and float(body) >= LONG_S:  # 2000 are rather milliseconds, and no one but its author knows
            raise UnitError(f"must have its unit: {body}ms, or {body}s", code="FS202")
        raise UnitError("must have its unit", f"{body}{usual}", "FS202")
    match = re.fullmatch(rf"({NUMBER})\s*([A-Za-zµ]+)", body)
    if not match:
        if body.startswith("-") and re.fullmatch(rf"{NUMBER}\s*({'|'.join(units)})", body[1:].strip()):
            raise UnitError("must not be negative", body[1:].strip())
        raise _decimal_comma(body) or UnitError(f"must be {what} with its unit, such as 2{usual}")
    scale = units.get(match[2])
    if scale is None:
        fix = (meant := _close(match[2].lower(), units, spellings)) and f"{match[1]}{meant}"
        raise UnitError(f"must be {what} in one of {', '.join(units)}", fix, "FS203")
    return _finite(match[1], scale)


def _close(name: str, units: Mapping[str, float], spellings: Mapping[str, str]) -> str | None:
    """Return the unit that a word means, in another spelling or with a typo; None if it could be any."""
    known = {**{unit.lower(): unit for unit in units}, **spellings}
    if name in known or len(name) < 4:
        return known.get(name)
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.75) or [""]
    return known.get(near[0])


def _format_scaled(value: float, units: Mapping[str, float], usual: str) -> str:
    texts = [
        f"{format_number(value / scale)}{unit}"
        for unit, scale in units.items()
        if value and _exactly(format_number(value / scale), scale) == value
    ]
    # "min" counts as two letters: 10min rather than 600s, and 1.5h rather than 90min.
    return min(texts, key=lambda text: len(text.replace("min", "mn")), default=f"{format_number(value)}{usual}")


def _exactly(number: str, scale: float) -> float:
    """Return number x scale without binary rounding in between, so that 41.3ms is the same float as 0.0413s."""
    return float(Decimal(number) * Decimal(repr(float(scale))))


LIMIT_UNITS = {"latency": "s", "rate": "s", "cost": "usd_per_request", "price": "usd_per_hour"}


def shown_limit(name: str, value: float, unit: str = "", digits: int = 3) -> str:
    """Return a bound or a value of a limit for people, with so many significant digits."""
    match LIMIT_UNITS.get(name):
        case "s":
            return shown_duration(value, digits)
        case "usd_per_request":
            return shown_cost(value, digits)
        case "usd_per_hour":
            return shown_price(value, digits)
        case _:
            return f"{shown(value, digits)} {unit}".strip()


def shown_beside(name: str, value: float, bound: float, unit: str = "") -> tuple[str, str]:
    """Return a value and the bound that it violates for people, with the digits that tell them apart."""
    return shown_apart(value, bound, lambda number, digits: shown_limit(name, number, unit, digits))
