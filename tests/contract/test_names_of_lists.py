"""Each name in SkyPilot's lists is one that a spec may have: places, instance types, accelerators and how many."""

import csv
import gzip
from collections.abc import Iterator

import pytest

from fogspec.base.clouds import is_zone_id
from fogspec.catalog.machine import Machine
from fogspec.language.loader import check_text
from fogspec.plan.schema import sample_id
from tests.conftest import SHARED

LISTS = SHARED / "data" / "catalog" / "skypilot-v8"
SIZE = {"cpus": 1, "memory": 1, "price": 0.1}
SPEC = """\
apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {{ name: arm }}
spec:
  cloud: [{{ cmd: [plan] }}]
  probe: {{ callback: plan }}
  infra: {infra}
  hardware: {{ gpus: {gpus}, allow: {machines}, deny: [no-such.machine] }}
  benchmark: {{ budget: $2.50, machines: {machines} }}
"""


def rows(cloud: str) -> Iterator[dict[str, str]]:
    for path in sorted((LISTS / cloud).glob("*.csv.gz")):
        with gzip.open(path, "rt", encoding="utf-8") as file:
            yield from csv.DictReader(file)


@pytest.mark.parametrize("cloud", ["aws", "azure", "gcp", "lambda", "vast"])
def test_every_name_of_a_list_may_stand_in_a_spec(cloud: str) -> None:
    if not LISTS.is_dir():
        pytest.skip("needs the larger data in FOGSPEC_SHARED")
    places, machines, gpus = set[str](), set[str](), {"none"}
    ids = dict[str, tuple[str, ...]]()
    for row in rows(cloud):
        zone = row.get("AvailabilityZone") or ""
        if is_zone_id(f"{cloud}/{row['Region']}/{zone}"):
            zone = ""  # SkyPilot takes the name that an account has for it
        places.add("/".join(filter(None, (cloud, row["Region"], zone))))
        machines |= {row["InstanceType"]} - {""}
        one = Machine(infra="/".join(filter(None, (cloud, row["Region"], zone))), instance=row["InstanceType"], **SIZE)
        # None reads as another one's: ids without a digest are what people see of the large clouds.
        assert ids.setdefault(sample_id(one), one.identity) == one.identity
        if name := row["AcceleratorName"]:
            count = float(row["AcceleratorCount"])
            gpus |= {name, f"{name}:{count:g}"} if count else {name}  # a part of one that a list rounds to none
    assert places
    text = SPEC.format(**{word: sorted(some) for word, some in
                          (("infra", places), ("machines", machines), ("gpus", gpus))})  # fmt: skip
    _, found = check_text(text.encode(), "spec.yaml")
    assert [one.message for one in found if one.severity == "error"] == []
