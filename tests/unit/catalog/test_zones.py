"""Zones: lists that name none, lists that have ids, and what a spec may say."""

from pathlib import Path

import pytest

from fogspec.base.diagnostics import Diagnostic, DiagnosticError
from fogspec.catalog.filters import filter_offers, price_now
from fogspec.catalog.sources import load_catalog
from fogspec.catalog.table import Catalog
from fogspec.language.loader import check_text
from fogspec.language.schema import Hardware
from tests.support.catalogs import HEAD, table
from tests.unit.catalog.test_names import SPEC

BY_ID = (
    "c6i.large,,,2,4,0.085,0.031,us-east-1,use1-az1",
    "c6i.large,,,2,4,0.085,0.045,us-east-1,use1-az2",
    "c6i.xlarge,,,4,8,0.17,,us-east-1,use1-az3",
)
NAMES = "AvailabilityZone,AvailabilityZoneName\nuse1-az1,us-east-1b\nuse1-az2,us-east-1a\n"


def errors(infra: str) -> list[Diagnostic]:
    text = SPEC.format(infra=infra, allow="standard", gpus="none", machines="")
    return [one for one in check_text(text.encode(), "spec.yaml")[1] if one.severity == "error"]


def skypilot(folder: Path, **accounts: str) -> Catalog:
    """SkyPilot's layout: a table with ids of zones, and the names that accounts have for them."""
    (folder / "aws").mkdir(exist_ok=True)
    (folder / "aws/vms.csv").write_text("\n".join([HEAD, *BY_ID, ""]))
    for account, text in accounts.items():
        (folder / f"aws/az_mappings-{account}.csv").write_text(text)
    return load_catalog(str(folder), ["aws"])


def offers(catalog: Catalog, *infra: str) -> list[tuple[str, str, float]]:
    found = filter_offers(catalog, Hardware(spot=True), infra).offers
    return [
        (found.infra(row), str(found.instance[row]), float(found.price_usd_per_hour[row])) for row in range(len(found))
    ]


def test_an_id_is_the_zone_that_the_account_calls_so(tmp_path: Path) -> None:
    found = skypilot(tmp_path, a1b2=NAMES)
    assert offers(found, "aws/us-east-1/us-east-1b") == [
        ("aws/us-east-1/us-east-1b", "c6i.large", 0.085),
        ("aws/us-east-1/us-east-1b", "c6i.large", 0.031),
    ]
    assert {instance for _, instance, _ in offers(found, "aws")} == {"c6i.large"}, "the account has no use1-az3"
    assert found.about.notes == ("aws/vms.csv: zones that the account does not have are left out",)


@pytest.mark.parametrize("accounts", [{}, {"a1b2": NAMES, "c3d4": NAMES}])
def test_an_id_without_a_name_is_its_region_at_the_highest_price(tmp_path: Path, accounts: dict[str, str]) -> None:
    found = skypilot(tmp_path, **accounts)
    for zone in ("us-east-1a", "us-east-1f"):
        place = f"aws/us-east-1/{zone}"
        assert offers(found, place) == [
            (place, "c6i.large", 0.085), (place, "c6i.xlarge", 0.17), (place, "c6i.large", 0.045),
        ]  # fmt: skip
    assert [price for _, _, price in offers(found, "aws")] == [0.085, 0.17, 0.045]
    [note] = found.about.notes
    assert note.startswith("aws/vms.csv: zones have ids, and ")
    assert offers(found, "aws/us-east-1/use1-az1") == []


def test_other_names_are_another_catalog(tmp_path: Path) -> None:
    without = skypilot(tmp_path).about.digest
    one = skypilot(tmp_path, a=NAMES).about.digest
    other = skypilot(tmp_path, a=NAMES.replace("east-1b", "east-1c")).about.digest
    assert len({without, one, other}) == 3


def test_names_of_zones_that_cannot_be_read_are_located(tmp_path: Path) -> None:
    with pytest.raises(DiagnosticError, match="missing: AvailabilityZoneName"):
        skypilot(tmp_path, a="AvailabilityZone\nuse1-az1\n")


def test_a_row_without_a_zone_is_in_every_one_of_its_region() -> None:
    found = table("c6i.large,,,2,4,0.085,,us-east-1,", "m6i.large,,,2,8,0.096,,us-east-1,us-east-1a")
    a, b = "aws/us-east-1/us-east-1a", "aws/us-east-1/us-east-1b"
    assert offers(found, a) == [(a, "c6i.large", 0.085), (a, "m6i.large", 0.096)]
    assert offers(found, b) == [(b, "c6i.large", 0.085)]
    assert offers(found, b, a) == [(a, "c6i.large", 0.085), (b, "c6i.large", 0.085), (a, "m6i.large", 0.096)]
    assert offers(found, b, "aws") == [("aws/us-east-1", "c6i.large", 0.085), ("aws/us-east-1", "m6i.large", 0.096)]
    assert offers(found, "aws/us-east-1/eu-west-1a") == []
    [machine] = [filter_offers(found, Hardware(), [b]).offers.machine(0)]
    assert price_now(machine, found) == 0.085


@pytest.mark.parametrize("zone", ["use1-az1", "usw2-lax1-az1"])
def test_a_spec_names_a_zone_as_skypilot_takes_it(zone: str) -> None:
    [found] = errors(f"aws/us-east-1/{zone}")
    assert found.message == f"spec.infra[0] must have a zone's name, and aws/us-east-1/{zone} ends in an id"
    assert "write 'aws/us-east-1' for all zones, or the name that yours has" in str(found.fix)
    assert not errors("aws/us-east-1/us-east-1a")
    assert not errors(f"aws/{zone}"), "no zone; whether a region, the catalog says"
