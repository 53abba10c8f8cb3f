"""Many offers, and work that several processes share."""

import csv
import gzip
import re
import shutil
from functools import partial

import pytest

from fogspec.catalog.sources.snapshot import TABLE
from fogspec.cli.diff import differences
from fogspec.language.discover import load_specs
from fogspec.review.git import Base
from fogspec.review.shared_work import share
from tests.conftest import SHARED
from tests.e2e.test_check import MANIFEST, replaced, repo  # noqa: F401
from tests.e2e.test_diff import repository  # noqa: F401
from tests.e2e.test_report import checkout, fogspec  # noqa: F401
from tests.support.running import Shell, shell  # noqa: F401


def test_several_processes_say_what_one_says(repo: Shell) -> None:
    for name in ("second", "third"):
        repo.neighbour(name, repo.read("specs/demo.yaml").replace("name: demo", f"name: {name}"))
    replaced(MANIFEST, "instance: .*", "instance: a.huge")(repo)
    one, two = (repo("check", "-j", number, code=3) for number in ("1", "2"))
    assert (one.out, one.err) == (two.out, two.err)
    assert [line.split()[1] for line in one.out.splitlines() if line[:4] in ("ok  ", "FAIL")] == [
        "demo",
        "second",
        "third",
    ]
    for words in (("status",), ("status", "-o", "json")):
        one, two = (repo(*words, "-j", number) for number in ("1", "2"))
        assert (one.out, one.err) == (two.out, two.err), words
    repo.write("offers.csv", repo.read("offers.csv").replace("0.10", "0.11"))
    one, two = (repo("check", "-j", number, code=3) for number in ("1", "2"))
    assert (one.out, one.err) == (two.out, two.err), "an error of a process is this command's"


def test_several_processes_find_what_one_finds(repository: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    repository.neighbour("other", repository.read("specs/demo.yaml").replace("name: demo", "name: other"))
    repository.write("offers.csv", repository.read("offers.csv").replace("0.4", "0.5", 1))
    monkeypatch.chdir(repository.folder)
    for base in (None, Base.of("HEAD")):
        one, two = (share(partial(differences, base, ()), load_specs(), number) for number in (1, 2))
        assert one == two
        assert [found.name for found in one] == ["demo", "other"]


def all_offerings(folder):
    """A catalog of 111,000 offers: the bundled one in three clouds, each region twice, and spot machines."""
    with gzip.open(TABLE, "rt", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    for cloud in ("aws", "azure", "gcp"):
        (folder / cloud).mkdir(parents=True)
        with open(folder / cloud / "vms.csv", "w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            for copy in ("", "-copy"):
                for row in rows:
                    changed = {"Region": row["Region"] + copy, "SpotPrice": 0.4 * float(row["Price"])}
                    writer.writerow({**row, "Cloud": cloud, **changed})
    return folder


def skypilots_offerings(_folder):
    return SHARED / "data" / "catalog" / "skypilot-v8"


@pytest.mark.parametrize(
    "catalog_of", [all_offerings, *([skypilots_offerings] if skypilots_offerings(None).is_dir() else [])]
)
def test_the_page_of_every_offering_stays_small(checkout, tmp_path_factory, catalog_of):
    spec = checkout / "specs" / "vslam-recorded.yaml"
    text = spec.read_text().replace("infra: [aws/us-east-1]", "infra: [aws, azure, gcp]")
    for old, new in (
        (r"    cpus: .*", "    cpus: 1..1024"), (r"    memory: .*", "    memory: 0.5GiB..32TiB"),
        (r"    memory_per_cpu: .*", "    spot: true\n    arch: [x86_64, arm64]"),
        (r"    allow: .*", "    allow: [standard, previous-generation, burstable]"),
        (r"    budget: .*", "    budget: $900"),
    ):  # fmt: skip
        text = re.sub(old, new, text)
    spec.write_text(text)
    shutil.copytree(catalog_of(tmp_path_factory.mktemp("offerings")), checkout / "offers")
    fogspec(checkout, "compile", "specs/vslam-recorded.yaml", "--catalog", "offers", code=7)
    page = fogspec(checkout, "report", "vslam-recorded", "--out", "-").stdout
    said = re.search(r"of ([\d,]+) offers the cheapest of each of ([\d,]+) instance types", page)
    assert int(said[1].replace(",", "")) > 80_000
    assert int(said[2].replace(",", "")) > 1500
    assert "that another one beats in everything" in page
    assert len(page) < 300_000
