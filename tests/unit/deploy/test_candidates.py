"""What a machine costs now, and which image its tag stands for; the names of launches."""

from pathlib import Path

import pytest

from fogspec.base.errors import Refused
from fogspec.catalog.filters import price_now
from fogspec.catalog.machine import Gpu, Machine
from fogspec.catalog.sources import load_catalog
from fogspec.deploy.candidates import Candidate, affordable, check_price, cost_words, exact
from tests.support.jobs import WORK

DIGEST = "sha256:" + "ab" * 32
TABLE = """InstanceType,AcceleratorName,AcceleratorCount,vCPUs,MemoryGiB,Price,SpotPrice,Region,AvailabilityZone
c.large,,,8,16,0.40,0.12,r1,r1a
c.large,,,8,16,0.41,0.13,r1,r1b
c.large,,,8,16,0.30,,r2,
g.large,T4,1,8,16,0.60,,r1,
"""


def machine(infra: str = "aws/r1", instance: str = "c.large", spot: bool = False, gpu: str | None = None) -> Machine:
    shape = Gpu(name=gpu, count=1) if gpu else None
    return Machine(infra=infra, instance=instance, cpus=8, memory=16.0, gpu=shape, spot=spot, price=0.4)


@pytest.fixture
def catalog(tmp_path: Path):
    (tmp_path / "aws.csv").write_text(TABLE)
    return load_catalog(str(tmp_path / "aws.csv"), ("aws",))


def test_the_highest_price_of_a_region_counts(catalog) -> None:
    assert price_now(machine(), catalog) == 0.41
    assert price_now(machine("aws/r1/r1a"), catalog) == 0.40
    assert price_now(machine("aws/r2"), catalog) == 0.30
    assert price_now(machine(spot=True), catalog) == 0.13
    assert price_now(machine(instance="g.large", gpu="T4"), catalog) == 0.60
    assert price_now(machine(gpu="T4"), catalog) is None
    assert price_now(machine(instance="x.large"), catalog) is None


@pytest.mark.parametrize(
    ("now", "limit", "most", "allowed"),
    [
        (0.4, None, None, True),
        (0.41, None, None, False),
        (0.41, None, 0.41, True),
        (0.39, None, 0.38, False),
        (0.41, 0.405, 0.50, False),
        (0.39, 0.40, None, True),
        (None, None, 9.0, False),
    ],
)
def test_what_was_approved_what_is_allowed_and_what_is_hard(now, limit, most, allowed) -> None:
    one = Candidate(
        number=0, machine=machine(), work=WORK, task={}, runs="", approved_usd_per_hour=0.4, now_usd_per_hour=now
    )
    assert affordable(one, limit, most) is allowed
    if not allowed:
        with pytest.raises(Refused, match=r"c\.large in aws/r1"):
            check_price(one, limit, most, "a table")


def test_an_hour_a_day_a_month() -> None:
    def candidate(infra: str) -> Candidate:
        return Candidate(
            number=0,
            machine=machine(infra),
            work=WORK,
            task={},
            runs="",
            approved_usd_per_hour=0.4,
            now_usd_per_hour=0.5,
        )

    assert cost_words(candidate("slurm/lab/small")) == "$0.50/h, $365/month"
    assert cost_words(candidate("aws/us-east-1")) == "$0.50/h, and $0.028/h for disk and address, $385/month together"


TASK = {"resources": {"infra": "aws/r1", "image_id": "docker:ros:jazzy"}, "run": "x"}


def nobody(_name: str) -> str:
    raise AssertionError("no registry is asked")


def test_an_image_that_is_not_pinned_is_refused_unless_it_is_to_be_resolved() -> None:
    with pytest.raises(Refused, match="is not pinned"):
        exact(TASK, "aws/r1", "ros:jazzy", False, nobody)
    task, image = exact(TASK, "aws/r1", "ros:jazzy", True, lambda name: {"ros:jazzy": DIGEST}[name])
    assert image == f"ros@{DIGEST}"
    assert task["resources"] == {"infra": "aws/r1", "image_id": f"docker:ros@{DIGEST}"}
    assert TASK["resources"]["image_id"] == "docker:ros:jazzy"


def test_images_that_need_no_question() -> None:
    assert exact(TASK, "aws/r1", f"ros@{DIGEST}", False, nobody) == (TASK, f"ros@{DIGEST}")
    for infra in ("local", "slurm/a/b"):
        assert exact(TASK, infra, "ros:jazzy", False, nobody) == (TASK, None)
    assert exact(TASK, "aws/r1", None, False, nobody) == (TASK, None)
