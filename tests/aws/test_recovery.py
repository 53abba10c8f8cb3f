"""Machines on AWS that fail, and an API that does for a while: another machine, no machine left, the bill as booked."""

import collections
from typing import Any

import pytest

from fogspec.language.loader import read_document
from fogspec.plan.schema import Plan
from fogspec.results.io import read_results_folder
from tests.aws.site import AwsSite, until
from tests.slurm.site import Bench, recorded
from tests.tools.aws import engine
from tests.tools.aws.cloud import ENDPOINT

USER = "AKIAOFTHEUSER"  # whose calls these are: fogspec's and SkyPilot's, not the account owner's or a machine's
CANNOT = 6  # the exit code of what the cloud would not do
# Measures; on four vCPUs until its machine has had its notice, if one is to come.
RECLAIMED = """\
import json
import os
import time
import urllib.request

import fogspec_probe

cpus = json.load(open("/run/instance.json"))["cpus"]


def to_be_reclaimed():
    waiting = json.load(urllib.request.urlopen("ENDPOINT/_waiting"))
    return os.path.exists("/run/spot-notice") or any(one["action"] == "reclaim" for one in waiting)


for number in range(10**9):
    fogspec_probe.start("work")
    time.sleep(0.02 + 0.4 / cpus)
    fogspec_probe.stop("work")
    if number == 10 and cpus == 4:
        open("/tmp/measuring", "w").close()
        while to_be_reclaimed():
            time.sleep(0.2)
""".replace("ENDPOINT", ENDPOINT)
# Measures; in the middle it waits until the user's credentials have expired.
WAITS = """\
import itertools
import json
import time
import urllib.request

import fogspec_probe


def expired():
    waiting = json.load(urllib.request.urlopen("ENDPOINT/_waiting"))
    return any(one["whose"] == "login" for one in waiting)


for number in itertools.count():
    fogspec_probe.start("work")
    time.sleep(0.05)
    fogspec_probe.stop("work")
    while number == 10 and not expired():
        time.sleep(0.2)
""".replace("ENDPOINT", ENDPOINT)
EXPIRED: dict[str, Any] = {"code": "ExpiredToken", "message": "The security token included in the request is expired",
                           "times": 10_000, "whose": "login"}  # fmt: skip
NO_CAPACITY = "We currently do not have sufficient capacity in the Availability Zone you requested."


def within_what_is_booked(site: AwsSite, name: str, budget_usd: float = 10.0) -> bool:
    """Whether EC2 bills no more than the results say, and these no more than the budget."""
    booked = read_results_folder(site.project / "results" / name).spec.spent
    return site.bill() <= booked * 1.02 and booked <= budget_usd


def test_spot_machines_that_fail_are_replaced_and_what_is_refused_for_a_while_is_tried_again(site: AwsSite) -> None:
    types = ("c6i.large", "m6i.large", "c6i.xlarge")
    spec = site.write("storm", list(types), steps=40, work=RECLAIMED)
    site.edit(spec, "gpus: [none]", "gpus: [none], spot: true")
    late, dying, lost = (site.machine("storm", one) for one in types)
    # Throttled at first, then a machine that EC2 does not list yet: SkyPilot may start another, and both are paid.
    engine.ask("/_fault", action="RunInstances", match=late, code="RequestLimitExceeded",
               message="Request limit exceeded.", times=2)  # fmt: skip
    engine.ask("/_fault", action="vanish", match=late, how="invisible", after_s=8)
    # One that dies while it is set up, and whose end is refused twice.
    engine.ask("/_fault", action="boot", match=dying, how="dying", after_s=12)
    engine.ask("/_fault", action="TerminateInstances", match=dying, code="InternalError", message="An internal error.",
               times=2)  # fmt: skip
    engine.ask("/_fault", action="reclaim", match=lost, how="reclaim", sign="/tmp/measuring", after_s=2)
    site.compile(spec)
    assert site.bench(spec).ended() == 0
    assert engine.ask("/_waiting") == [], "all of it happened"
    assert {name: one.state for name, one in site.results("storm").items()} == dict.fromkeys(types, "ok")
    launched = collections.Counter(one.type for one in site.instances())
    assert [one for one in site.instances() if not one.spot] == []
    assert launched["m6i.large"] >= 2
    assert launched["c6i.xlarge"] >= 2
    assert within_what_is_booked(site, "storm")
    assert site.left() == []


@pytest.mark.rare
def test_a_deployment_falls_back_is_replaced_and_is_gone_in_the_end(site: AwsSite) -> None:
    spec = site.write("serves", ["c6i.large", "m6i.large"])
    site.edit(spec, "alpha: 0.5", "alpha: 0")
    site.edit(spec, "cpus: 1..128", "cpus: 2")
    site.edit(spec, "  benchmark:", "  deployment: {fallbacks: 1}\n  benchmark:")
    site.compile(spec)
    recorded(site, "serves")
    site.compile(spec)
    manifest = "compiled/serves/manifest.yaml"
    engine.ask("/_fault", action="RunInstances", match=f"{site.machine('serves')} c6i.large",
               code="InsufficientInstanceCapacity", message=NO_CAPACITY, times=10_000)  # fmt: skip
    said = site.run("apply", manifest, "--yes").stderr
    assert f"InsufficientInstanceCapacity: {NO_CAPACITY}" in said
    (first,) = site.instances()
    assert (first.type, first.state) == ("m6i.large", "running")

    engine.ask("/_fault", action="reclaim", match=site.machine("serves"), how="reclaim", after_s=0)
    until(lambda: not site.jobs())
    assert "Healthy" not in site.run("status", spec).stdout
    site.run("apply", manifest, "--yes")
    (_, second) = site.instances()
    assert second.state == "running", "it is replaced"

    engine.ask("/_fault", action="*", match=USER, **EXPIRED)
    down = site.run("down", "serves", code=CANNOT)
    assert "ExpiredToken" in down.stderr
    assert "nothing is left" not in down.stdout + down.stderr
    assert site.jobs() == [second.name], "what could not be verified gone is not said to be gone"
    engine.ask("/_lift", whose="login")
    assert "nothing is left" in site.run("down", "serves").stdout
    assert site.left() == []


@pytest.mark.rare
def test_a_bench_outlasts_an_api_that_hangs_and_credentials_that_expire(site: AwsSite) -> None:
    refused, late, unseen = types = ("c6i.large", "m6i.large", "c6i.xlarge")
    spec = site.write("outage", list(types), steps=40, work=WAITS)
    site.edit(spec, "duration: 1min", "duration: 20min")
    at = {one: site.machine("outage", one) for one in types}
    engine.ask("/_fault", action="RunInstances", match=f"{at[refused]} {refused}", code="InsufficientInstanceCapacity",
               message=NO_CAPACITY, times=10_000, whose="capacity")  # fmt: skip
    # Longer than boto3 waits for an answer: there is a machine that SkyPilot does not know of.
    engine.ask("/_fault", action="RunInstances", match=at[late], how="answer", hang_s=65)
    engine.ask("/_fault", action="DescribeInstances", match=at[late], hang_s=10, times=2)
    engine.ask("/_fault", action="TerminateInstances", match=at[late], hang_s=10)
    engine.ask("/_fault", action="CreateTags", match=at[unseen], code="InvalidInstanceID.NotFound",
               message="The instance ID does not exist")  # fmt: skip
    site.compile(spec)

    bench, measuring = site.bench(spec), set[str]()
    while len(measuring) < 2:
        measuring.add(bench.until(lambda one: one["event"] == "measures", site.patience_s)["sample"])
    engine.ask("/_fault", action="*", match=USER, **EXPIRED)
    bench.until(lambda one: one["event"] == "ends" and "ExpiredToken" in (one["detail"] or ""), site.patience_s)
    assert len(site.jobs()) == 2, "what EC2 did not end is waited for"
    engine.ask("/_lift", whose="login")
    assert bench.ended() == 0
    assert [one["whose"] for one in engine.ask("/_waiting")] == ["capacity"], "all else happened"
    said = str(bench.events)
    assert "InvalidInstanceID.NotFound: The instance ID does not exist" in said
    assert "Read timeout on endpoint URL" in said
    results = site.results("outage")
    assert {name: one.state for name, one in results.items()} == {refused: "failed", late: "ok", unseen: "ok"}
    assert (results[refused].reason, results[refused].spent) == ("capacity", 0)
    assert f"InsufficientInstanceCapacity: {NO_CAPACITY}" in str(results[refused].detail)
    assert refused not in {one.type for one in site.instances()}
    assert within_what_is_booked(site, "outage")
    assert site.left() == []


@pytest.mark.rare
def test_a_machine_that_never_answers_is_ended_in_time_and_paid(silent: tuple[AwsSite, Bench]) -> None:
    site, bench = silent
    assert bench.ended() == 1, "no sample could be measured"
    (record,) = site.results("silent").values()
    assert (record.state, record.reason) == ("failed", "setup")
    assert "not ready after" in str(record.detail)
    (machine,) = site.instances()
    assert machine.state == "terminated"
    plan = read_document(site.project / "compiled" / "silent" / "plan.yaml", Plan).spec
    assert machine.lived_s <= plan.commitment.paid_s
    assert record.spent > 0
    assert within_what_is_booked(site, "silent", plan.commitment.usd(record.machine))
    assert site.left() == []
