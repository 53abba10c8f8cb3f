"""An adaptive bench on the real engine, while one of its machines cannot be had."""

from collections.abc import Iterator

import pytest

from fogspec.results.schema import Results
from fogspec.spec.loader import read_document
from tests.slurm.conftest import ABANDONED
from tests.slurm.site import Site
from tests.tools.slurm import daemons

CLOSED, NEIGHBOUR = "c-2x4", "2CPU--16GB"


@pytest.fixture
def closed(site: Site) -> Iterator[None]:
    """A partition that refuses jobs, as a cloud without capacity does."""
    daemons.run(site.cluster, "scontrol", "update", f"partitionname={CLOSED}", "state=drain")
    yield
    daemons.run(site.cluster, "scontrol", "update", f"partitionname={CLOSED}", "state=up")


@pytest.mark.usefixtures("closed")
def test_waves_go_on_with_the_nearest_machine_in_place_of_one_that_cannot_be_had(site: Site) -> None:
    path = site.project / (spec := site.write("batches", []))
    text = path.read_text().replace("machines: []", "sampler: adaptive").replace("cpus: 1..128", "cpus: 1..64")
    path.write_text(text)
    site.compile(spec)
    assert site.bench(spec).ended() == 0
    results = read_document(site.project / "results" / "batches.yaml", Results).spec
    records = site.results("batches")
    refused = records["2CPU--4GB"]
    assert (refused.state, refused.reason, refused.spent) == ("failed", "capacity", 0), refused
    assert "takes its place" in (refused.detail or "")
    assert (records[NEIGHBOUR].state, records[NEIGHBOUR].substitute_for) == ("ok", refused.id)
    assert results.sampling is not None
    assert results.sampling.stop_reason
    asked = {one.id for batch in results.sampling.batches for one in batch.samples}
    assert asked <= {one.id for one in results.samples}
    assert 0 < results.spent < 10  # the budget; what machines cost is what time this host takes
    site.compile(spec)
    assert (site.project / "compiled" / "batches" / "manifest.yaml").is_file()
    assert site.left(spare=ABANDONED) == []
