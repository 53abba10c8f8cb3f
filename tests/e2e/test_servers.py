"""A type is not a machine: the servers that samples ran on, from the agent to what a user reads."""

import pytest

from fogspec.results.schema import Results, ServerFacts, with_checksum
from fogspec.spec.loader import read_document
from tests.support.deployed import Deployed, app, tiny  # noqa: F401
from tests.support.files import write_yaml
from tests.support.running import Shell, measure, project, shell  # noqa: F401

AT = ("--catalog", "offers.csv")


def told(results: Results, *servers: ServerFacts) -> Results:
    """The results as if the samples had run on these servers, in turn."""
    samples = [
        one.model_copy(update={"server": servers[i % len(servers)]}) for i, one in enumerate(results.spec.samples)
    ]
    return with_checksum(results.metadata, results.spec.model_copy(update={"samples": samples}))


def test_a_bench_records_the_server_of_each_sample(tiny: Deployed) -> None:
    results = read_document(tiny.folder / "results/tiny.yaml", Results)
    assert results.spec.samples
    for one in results.spec.samples:
        assert one.server is not None
        assert one.server.cpu
        assert one.server.threads
        assert one.server.steal is not None
    assert f"1cpu-1gib: {results.spec.samples[0].server.cpu}" in tiny("explain", "tiny").stdout
    tiny("report", "tiny", "--out", "page.html")
    assert "measured on" in (tiny.folder / "page.html").read_text()


def test_status_says_when_another_cpu_runs_than_was_measured(tiny: Deployed) -> None:
    tiny.apply()
    assert not [text for text in tiny.status()["reasons"] if "another CPU" in text]
    path = tiny.folder / "results/tiny.yaml"
    other = told(read_document(path, Results), ServerFacts(cpu="Older CPU"))
    write_yaml(path, other.model_dump(mode="json", exclude_none=True), "a test")
    (said,) = [text for text in tiny.status()["reasons"] if "another CPU" in text]
    assert said.endswith("Older CPU was measured")
    assert tiny.status()["server"]["cpu"] in said


@pytest.mark.parametrize("changed_to", [None, "EPYC 7763"])
def test_samples_on_different_cpus_all_count_and_are_said(shell: Shell, changed_to: str | None) -> None:
    project(shell)
    measure(shell)
    path = shell.folder / "results/demo.yaml"
    results = read_document(path, Results)
    first = results.spec.samples[0]
    if changed_to is None:
        again = first.model_copy(update={"id": f"{first.id}-2"})
        results = results.model_copy(
            update={"spec": results.spec.model_copy(update={"samples": [*results.spec.samples, again]})}
        )
        servers = [ServerFacts(cpu="EPYC 7452")] * len(results.spec.samples[:-1]) + [ServerFacts(cpu="EPYC 7763")]
    else:
        servers = [ServerFacts(cpu="EPYC 7452", changed_to=changed_to)]
    results = told(results, *servers)
    write_yaml(path, results.model_dump(mode="json", exclude_none=True), "a test")
    said = shell("compile", "specs/demo.yaml", *AT).out
    count = len(results.spec.samples)
    assert f"{count} of {count} samples count" in said
    assert f"{first.machine.instance} is not one kind of machine: it was measured on EPYC 7452 and on EPYC 7763" in said
