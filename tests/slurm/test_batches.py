"""An adaptive bench on the real engine, while one of its machines cannot be had."""

from collections.abc import Iterator

import pytest

from fogspec.results.io import read_results_folder
from tests.slurm.abandoned import ABANDONED
from tests.slurm.site import Site
from tests.tools.slurm import daemons

CLOSED = "c-2x4"


@pytest.fixture
def closed(site: Site) -> Iterator[None]:
    """A partition that refuses jobs, as a cloud without capacity does."""
    daemons.run(site.cluster, "scontrol", "update", f"partitionname={CLOSED}", "state=drain")
    yield
    daemons.run(site.cluster, "scontrol", "update", f"partitionname={CLOSED}", "state=up")


@pytest.mark.rare
@pytest.mark.usefixtures("closed")
def test_the_next_batches_do_without_a_machine_that_is_unavailable(site: Site) -> None:
    path = site.project / (spec := site.write("batches", []))
    text = path.read_text().replace("machines: []", "sampler: adaptive").replace("cpus: 1..128", "cpus: 1..64")
    path.write_text(text)
    site.compile(spec)
    assert site.bench(spec).ended() == 0
    results = read_results_folder(site.project / "results" / "batches").spec
    records = site.results("batches")
    refused = records["2CPU--4GB"]
    assert (refused.state, refused.reason, refused.spent) == ("failed", "capacity", 0), refused
    assert {one.state for one in records.values() if one is not refused} == {"ok"}
    assert results.sampling is not None
    assert results.sampling.stop_reason
    asked = {one.id for batch in results.sampling.batches for one in batch.samples}
    assert asked <= {one.id for one in results.samples}
    assert 0 < results.spent < 10  # the budget; what machines cost is what time this host takes
    site.compile(spec)
    assert (site.project / "compiled" / "batches" / "manifest.yaml").is_file()
    assert site.left(spare=ABANDONED) == []
