"""Telling shared-tenancy prices from dedicated ones and from nothing, on prices that EC2 lists."""

import pytest

from fogspec_lab.ec2_prices import Price, by_region, by_size

EAST, WEST = "us-east-1", "us-west-1"


def test_a_dedicated_and_an_unknown_price_follow_from_the_family() -> None:
    listed = {"c6i.large": 0.085, "c6i.xlarge": 0.17, "c6i.4xlarge": 0.748, "c6i.16xlarge": 0.0}
    assert by_size({(name, EAST): price for name, price in listed.items()}) == {
        ("c6i.large", EAST): Price(0.085, "listed"),
        ("c6i.xlarge", EAST): Price(0.17, "listed"),
        ("c6i.4xlarge", EAST): Price(0.68, "family"),
        ("c6i.16xlarge", EAST): Price(2.72, "family"),
    }


def test_one_shared_price_is_confirmed_by_dedicated_ones_above_it() -> None:
    found = by_size({("r6i.large", EAST): 0.1386, ("r6i.xlarge", EAST): 0.252, ("r6i.16xlarge", EAST): 4.4352})
    assert [price.usd_per_hour for price in found.values()] == [0.126, 0.252, 4.032]


@pytest.mark.parametrize(
    "prices", [{"x9.large": 0.1}, {"x9.large": 0.1, "x9.xlarge": 0.0}, {"x9.large": 0.1, "x9.xlarge": 0.5}]
)
def test_what_nothing_confirms_has_no_price(prices: dict[str, float]) -> None:
    assert by_size({(name, EAST): price for name, price in prices.items()}) == {}


def test_a_rounded_price_of_an_old_type_stays_as_listed() -> None:
    listed = {"c4.large": 0.1, "c4.xlarge": 0.199, "c4.2xlarge": 0.398}
    found = by_size({(name, EAST): price for name, price in listed.items()})
    assert {price.usd_per_hour for price in found.values()} == {0.1, 0.199, 0.398}
    assert {price.basis for price in found.values()} == {"listed"}


def test_machines_with_accelerators_keep_the_factor_of_the_region() -> None:
    east = {"g4dn.xlarge": 0.526, "g4dn.2xlarge": 0.752, "g4dn.4xlarge": 1.276, "g4dn.8xlarge": 2.307}
    ohio = {"g4dn.xlarge": 0.0, "g4dn.2xlarge": 0.752, "g4dn.4xlarge": 1.204, "g4dn.8xlarge": 2.176}
    west = {"g4dn.xlarge": 0.631, "g4dn.2xlarge": 0.902, "g4dn.4xlarge": 1.445, "g4dn.8xlarge": 2.611}
    places = {EAST: east, "us-east-2": ohio, WEST: west}
    found = by_region({(name, region): price for region, prices in places.items() for name, price in prices.items()})
    assert found["g4dn.4xlarge", EAST] == Price(1.204, "family")
    assert found["g4dn.8xlarge", EAST] == Price(2.176, "family")
    assert found["g4dn.xlarge", "us-east-2"] == Price(0.526, "family")
    assert found["g4dn.xlarge", WEST] == Price(0.631, "listed")


def test_a_family_of_one_size_confirms_nothing() -> None:
    assert by_region({("p4d.24xlarge", EAST): 36.04986, ("p4d.24xlarge", WEST): 32.7726}) == {}
