"""Where else a sample could be measured: the next place, then the nearest admissible machine."""

from fogspec.catalog.filters import filter_offers
from fogspec.catalog.table import Catalog
from fogspec.plan.design import make_plan
from fogspec.plan.schema import Substitute, sample_on
from fogspec.plan.substitutes import substitutes
from fogspec.spec.schema import Application
from tests.support.catalogs import application, table

OFFERS = table(
    "a.large,,,2,4,0.10,0.03,r1,", "a.large,,,2,4,0.12,0.04,r2,", "a.large,,,2,4,0.11,0.04,r3,",
    "a.large,,,2,4,0.13,0.05,r4,", "b.large,,,2,8,0.11,,r1,", "a.xlarge,,,4,8,0.20,,r1,", "c.huge,,,64,256,3.0,,r1,",
    "g.large,T4,1,4,16,0.60,,r1,", "g.xlarge,T4,1,8,32,0.80,,r2,",
)  # fmt: skip


def found(app: Application, offers: Catalog = OFFERS, instance: str = "a.large") -> list[Substitute]:
    admissible = filter_offers(offers, app.spec.hardware, app.spec.infra).offers
    rows = [n for n in range(len(admissible)) if admissible.instance[n] == instance]
    cheapest = min(rows, key=lambda n: admissible.price_usd_per_hour[n])
    return substitutes(app.spec, [sample_on(admissible.machine(cheapest), "")], admissible)


def places(alternatives: list[Substitute]) -> list[tuple[str, str]]:
    return [(one.machine.instance, one.machine.infra) for one in alternatives]


def test_first_the_same_machine_elsewhere_cheapest_first_then_its_neighbours_here():
    names = places(found(application(infra=["aws/r1", "aws/r2", "aws/r3", "aws/r4"])))
    assert names == [("a.large", "aws/r3"), ("a.large", "aws/r2"), ("b.large", "aws/r1"), ("a.xlarge", "aws/r1")]


def test_only_places_that_the_spec_allows():
    assert places(found(application(infra=["aws/r1"]))) == [("b.large", "aws/r1"), ("a.xlarge", "aws/r1")]


def test_accelerators_and_the_kind_of_price_stay():
    app = application({"gpus": ["none", "T4"], "spot": True}, infra=["aws/r1", "aws/r2"])
    assert places(found(app, instance="g.large")) == [("g.xlarge", "aws/r2")]
    spot = found(app)
    assert {one.machine.spot for one in spot} == {True}
    assert places(spot) == [("a.large", "aws/r2")]


def test_machines_listed_by_name_have_no_neighbours():
    app = application(infra=["aws/r1", "aws/r2"], machines=["a.large"])
    assert places(found(app)) == [("a.large", "aws/r2")]


def test_shapes_of_this_host_have_nowhere_to_go():
    app = application(machines=["local/1cpu-1gib"])
    plan = make_plan(app, "specs/demo.yaml", OFFERS)
    assert substitutes(app.spec, plan.spec.samples, OFFERS) == []


def test_a_machine_may_stand_in_for_several_but_none_of_the_plan_for_another():
    app = application(infra=["aws/r1"])
    offers = filter_offers(OFFERS, app.spec.hardware, app.spec.infra).offers
    planned = [sample_on(offers.machine(n), "") for n in range(len(offers))
               if offers.instance[n] in ("a.large", "a.xlarge")]  # fmt: skip
    found = substitutes(app.spec, planned, offers)
    assert [(one.substitute_for, one.machine.instance) for one in found] == [
        ("aws-r1-a-large", "b.large"),
        ("aws-r1-a-xlarge", "b.large"),
    ]


def test_a_machine_that_is_much_larger_is_no_neighbour():
    app = application({"cpus": "2"}, infra=["aws/r1", "aws/r2"])
    assert "c.huge" not in [one.machine.instance for one in found(app)]
    assert places(found(application({"machines": {"allow": ["a.large", "c.huge"]}}, infra=["aws/r1"]))) == []
