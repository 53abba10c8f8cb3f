"""Cleaning of listed EC2 prices: which of them are on-demand prices of shared tenancy.

apache-libcloud's table holds one price per instance type and region, taken at random from those of shared tenancy,
of dedicated tenancy (6 to 10% higher) and of reserved hosts ($0). Two laws of EC2's price list tell them apart;
both compare the prices of one family, and a price counts only where another one confirms it:

- size: within a family and region the price is proportional to the size's normalization factor
  (docs.aws.amazon.com/AWSEC2/latest/UserGuide/apply_ri.html). It holds for families without accelerators.
- region: a region raises the prices of all sizes of a family by the same factor. It holds for all families.

A price that breaks its law is replaced by the one that the law gives.
"""

import re
from bisect import bisect_left, bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

Key = tuple[str, str]  # instance type, region

FACTORS = {"nano": 0.25, "micro": 0.5, "small": 1.0, "medium": 2.0, "large": 4.0, "xlarge": 8.0}
SAME = 0.004  # relative: two prices are one, for listed prices are rounded to 3 to 5 decimals
CLOSE = 0.02  # a listed price keeps the law: the oldest types are priced by hand, dedicated ones cost 6% more
DEDICATED = (1.05, 1.12)  # price of dedicated tenancy by that of shared tenancy


@dataclass(frozen=True, slots=True)
class Price:
    """USD per hour; `basis` tells a listed price from one that follows from the family's other prices."""

    usd_per_hour: float
    basis: Literal["listed", "family"]


def by_size(listed: Mapping[Key, float]) -> dict[Key, Price]:
    """Return prices by the law of size; `listed` is in USD per hour, 0 where the price is unknown.

    Families and regions without two prices that confirm each other are left out.
    """
    groups: dict[Key, dict[str, float]] = defaultdict(dict)
    for (instance, region), price in listed.items():
        groups[instance.split(".")[0], region][instance] = price
    found: dict[Key, Price] = {}
    for (_, region), prices in groups.items():
        factors = {instance: factor for instance in prices if (factor := _factor(instance))}
        unit = _unit_price([(prices[instance] / factor, factor) for instance, factor in factors.items()])
        if unit is not None:
            found |= {
                (instance, region): _lawful(prices[instance], unit * factors[instance], 5) for instance in factors
            }
    return found


def by_region(listed: Mapping[Key, float]) -> dict[Key, Price]:
    """Return prices by the law of regions; `listed` is in USD per hour, 0 where the price is unknown.

    Sizes and regions without two prices that keep the law are left out.
    """
    groups: dict[str, dict[Key, float]] = defaultdict(dict)
    for key, price in listed.items():
        groups[key[0].split(".")[0]][key] = price
    found: dict[Key, Price] = {}
    for family in groups.values():
        prices = {key: price for key, price in family.items() if price > 0}
        sizes, regions = _product(prices)
        kept = [key for key, price in prices.items() if abs(price / (sizes[key[0]] * regions[key[1]]) - 1) <= SAME]
        confirmed = Counter(name for key in kept for name in key)
        decimals = max((len(f"{prices[key]:.10g}".partition(".")[2]) for key in kept), default=0)
        found |= {
            (instance, region): _lawful(price, sizes[instance] * regions[region], decimals)
            for (instance, region), price in family.items()
            if min(confirmed[instance], confirmed[region]) > 1
        }
    return found


def _lawful(listed: float, law: float, decimals: int) -> Price:
    return Price(listed, "listed") if abs(listed / law - 1) <= CLOSE else Price(round(law, decimals), "family")


def _factor(instance: str) -> float | None:
    size = instance.split(".")[1]
    match = re.fullmatch(r"(\d+)xlarge", size)
    return FACTORS["xlarge"] * int(match[1]) if match else FACTORS.get(size)


def _unit_price(candidates: Iterable[tuple[float, float]]) -> float | None:
    """Return the lowest price per unit of size that a second size confirms, by the same or by a dedicated price.

    `candidates` are unit prices with their sizes; a larger size's price has more digits of the unit price.
    """
    units = sorted((unit, factor) for unit, factor in candidates if unit > 0)
    for lowest, _ in units:
        same = [(factor, unit) for unit, factor in units if abs(unit / lowest - 1) <= SAME]
        if len(same) > 1 or any(DEDICATED[0] <= unit / lowest <= DEDICATED[1] for unit, _ in units):
            return max(same)[1]
    return None


def _product(prices: Mapping[Key, float]) -> tuple[dict[str, float], dict[str, float]]:
    """Return the prices as size x region, fitted alternately by modes, which outliers do not move."""
    sizes = {instance: 1.0 for instance, _ in prices}
    regions = {region: 1.0 for _, region in prices}
    for _ in range(20):
        for one in sizes:
            sizes[one] = _mode([price / regions[name] for (size, name), price in prices.items() if size == one])
        for one in regions:
            regions[one] = _mode([price / sizes[size] for (size, name), price in prices.items() if name == one])
    return sizes, regions


def _mode(values: Iterable[float]) -> float:
    """Return the middle of the largest group of equal values, the lowest such group if several are as large."""
    ordered = sorted(values)
    groups = [
        ordered[bisect_left(ordered, x * (1 - SAME / 2)) : bisect_right(ordered, x * (1 + SAME / 2))] for x in ordered
    ]
    largest = max(groups, key=len)
    return largest[len(largest) // 2]
