"""Faults at AWS's API, where they really happen: the reason in AWS's words, no machine, no cost."""

import time

import pytest

from tests.aws.site import AwsSite, until
from tests.tools.aws import engine

MACHINE = "c6i.4xlarge"
# What AWS answers: docs.aws.amazon.com/AWSEC2/latest/APIReference/errors-overview.html
REFUSED = {
    "VcpuLimitExceeded": ("quota", "You have requested more vCPU capacity than your current vCPU limit of 16 allows."),
    "UnauthorizedOperation": ("access", "You are not authorized to perform this operation."),
}


@pytest.mark.rare
@pytest.mark.parametrize("code", [*REFUSED])
def test_a_refused_launch_is_told_in_awss_words_and_costs_nothing(site: AwsSite, code: str) -> None:
    reason, message = REFUSED[code]
    engine.ask("/_fault", action="RunInstances", match=MACHINE, code=code, message=message, times=10_000)
    spec = site.write(name := f"refused-{reason}", [MACHINE])
    site.compile(spec)
    bench = site.bench(spec)
    ended = bench.ended()
    said = (site.project / "bench.log").read_text() + str(bench.events)
    assert ended != 0
    assert f"{code}: {message}" in said
    if (site.project / "results" / name).exists():
        (record,) = site.results(name).values()
        assert (record.state, record.reason, record.spent) == ("failed", reason, 0)
    assert site.instances() == []
    assert site.left() == []


@pytest.mark.rare
def test_a_price_that_rose_starts_nothing(site: AwsSite) -> None:
    site.compile(spec := site.write("dearer", ["m6i.xlarge"]))
    prices = site.cluster / "sky" / ".sky" / "catalogs" / "v8" / "aws" / "vms.csv"
    before = prices.read_text()
    prices.write_text(before.replace(",0.192,", ",0.384,"))
    try:
        bench = site.bench(spec)
        assert bench.ended() != 0
    finally:
        prices.write_text(before)
    said = (site.project / "bench.log").read_text() + str(bench.events)
    assert "$0.384" in said
    assert "$0.192" in said
    assert site.instances() == []


@pytest.mark.rare
def test_machines_that_are_ended_while_they_begin_keep_no_other_from_beginning(site: AwsSite) -> None:
    ec2 = engine.client()
    image = ec2.describe_images()["Images"][0]["ImageId"]

    def launch() -> str:
        launched = ec2.run_instances(ImageId=image, InstanceType="c6i.large", MinCount=1, MaxCount=1)
        return str(launched["Instances"][0]["InstanceId"])

    for number in range(20):
        one = launch()
        time.sleep(0.05 * (number % 8))
        ec2.terminate_instances(InstanceIds=[one])
    last = launch()
    try:
        until(lambda: last in engine.ask("/_machines"))
    finally:
        ec2.terminate_instances(InstanceIds=[last])
