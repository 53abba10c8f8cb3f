"""The whole line on AWS's own API, as a user: plan, bench, results, manifest, apply, status, update, down; what it costs."""

import json
from typing import Any

from ruamel.yaml import YAML

from fogspec.results.io import read_results_folder
from tests.aws.conftest import TYPES, Benched
from tests.aws.site import AwsSite
from tests.tools.aws import engine, shapes


def status(site: AwsSite, spec: str) -> dict[str, Any]:
    return dict(json.loads(site.run("status", spec, "-o", "json").stdout)[0]["deployment"])


def deployed(site: AwsSite) -> list[dict[str, Any]]:
    path = site.project / ".fogspec" / "life" / "deployment.yaml"
    return list(YAML(typ="safe").load(path)["spec"]["machines"]) if path.exists() else []


def test_several_types_at_once_from_the_plan_to_the_manifest(benched: Benched) -> None:
    site = benched.site
    assert benched.left == [], "neither EC2 nor SkyPilot has anything left"
    records = site.results("life")
    assert {name: one.state for name, one in records.items()} == dict.fromkeys(TYPES, "ok")
    for name, one in records.items():
        shape = shapes.BY_NAME[name]
        assert one.requests >= 20
        assert one.latency is not None
        assert one.latency.mean >= 0.99 * (0.02 + 0.4 / shape.cpus), name
        assert one.machine.price == shape.price
    assert benched.at_once == len(TYPES)


def test_what_ec2_bills_is_within_the_budget_and_what_was_booked(benched: Benched) -> None:
    site = benched.site
    results = read_results_folder(site.project / "results" / "life").spec
    assert sorted(one.type for one in benched.instances) == sorted(TYPES), "one machine each, and no other"
    billed = sum(one.usd for one in benched.instances)
    assert billed <= 10.0
    assert billed <= results.spent * 1.02, "what is booked does not flatter"


def test_apply_update_and_down(benched: Benched) -> None:
    site, spec, manifest = benched.site, benched.spec, "compiled/life/manifest.yaml"
    said = site.run("apply", manifest, "--yes")
    assert "/month" in said.stderr
    (first,) = deployed(site)
    assert (first["state"], first["machine"]["instance"]) == ("serving", "c6i.large")
    assert site.jobs() == [first["name"]]
    assert status(site, spec)["sync"] == "Synced"

    site.edit(spec, "alpha: 0", "alpha: 1")
    site.compile(spec)
    site.run("apply", manifest, "--yes")
    (second,) = deployed(site)
    assert second["machine"]["cpus"] == 4
    assert site.jobs() == [second["name"]], "the old machine is gone"

    assert "nothing is left" in site.run("down", "life").stdout
    assert site.left() == []
    assert deployed(site) == []
    assert engine.client().describe_addresses()["Addresses"] == []
    assert [one for one in engine.client().describe_volumes()["Volumes"] if one["State"] == "in-use"] == []
