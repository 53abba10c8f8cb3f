"""A type is not a machine: the servers that samples ran on, from the agent to what a user reads."""

import os

import pytest

from fogspec.base import digest
from fogspec.results.io import read_results_folder
from fogspec.results.schema import Results, ServerFacts, results_of
from tests.support.deployed import Deployed, app, tiny  # noqa: F401
from tests.support.results import write
from tests.support.running import Shell, measure, project, shell  # noqa: F401

AT = ("--catalog", "offers.csv")


def told(results: Results, *servers: ServerFacts) -> Results:
    """The results as if the samples had run on these servers, in turn."""
    samples = [
        one.model_copy(update={"server": servers[i % len(servers)]}) for i, one in enumerate(results.spec.samples)
    ]
    return results_of(results.spec.model_copy(update={"samples": samples}))


def test_a_bench_records_the_server_of_each_sample(tiny: Deployed) -> None:
    results = read_results_folder(tiny.folder / "results/tiny")
    assert results.spec.samples
    for one in results.spec.samples:
        assert one.server is not None
        assert one.server.cpu
        assert one.server.threads
        assert one.server.steal is not None
    assert f"1cpu-1gib: {results.spec.samples[0].server.cpu}" in tiny("explain", "tiny", "-v").stdout
    tiny("report", "tiny", "--out", "page.html")
    assert "measured on" in (tiny.folder / "page.html").read_text()


def test_status_says_when_another_cpu_runs_than_was_measured(tiny: Deployed) -> None:
    tiny.apply()
    assert not [text for text in tiny.status()["reasons"] if "another CPU" in text]
    path = tiny.folder / "results/tiny"
    other = told(read_results_folder(path), ServerFacts(cpu="Older CPU"))
    write(path, other.spec)
    (said,) = [text for text in tiny.status()["reasons"] if "another CPU" in text]
    assert said.endswith("Older CPU was measured")
    assert tiny.status()["server"]["cpu"] in said


def test_apply_and_status_name_packages_that_differ_from_the_measured_machine(tiny: Deployed) -> None:
    path = tiny.folder / "results/tiny"
    results = read_results_folder(path)
    server = results.spec.samples[0].server
    assert server is not None
    assert server.kernel
    assert server.packages
    (listed,) = (tiny.folder / "results/tiny").glob("packages-*.txt")
    text = listed.read_bytes()
    assert digest.of_bytes(text) == server.packages
    assert listed.name == f"packages-{server.packages[7:19]}.txt"

    assert "packages differ" not in tiny.apply().stderr
    assert tiny.status()["packages"] == []
    tiny("down", "tiny", "--yes")

    conda = tiny.folder / "conda/conda-meta"
    conda.mkdir(parents=True)
    for name in ("a-1-0", "b-2-0", "c-3-0"):
        (conda / f"{name}.json").touch()
    began = tiny.apply(env={**os.environ, "CONDA_PREFIX": str(conda.parent)})
    first = "conda a none → 1_0"
    warning = f"packages differ from the measured machine's: {first}, 2 others (fogspec status tiny -v)"
    assert f"warning: {warning}" in began.stdout + began.stderr
    status = tiny.status()
    assert status["packages"] == [first, "conda b none → 2_0", "conda c none → 3_0"]
    assert warning in status["reasons"]
    assert status["sync"] == "Synced", "it makes nothing stale"
    assert "conda b none" not in tiny("status", "tiny").stdout
    assert "conda b none → 2_0" in tiny("status", "tiny", "-v").stdout

    listed.write_bytes(text + b"pip zzz 1\n")
    assert tiny.status()["packages"] == [], "a list that was edited tells nothing"
    listed.unlink()
    assert tiny.status()["packages"] == []
    tiny("check", "tiny")


@pytest.mark.parametrize("changed_to", [None, "EPYC 7763"])
def test_samples_on_different_cpus_all_count_and_are_said(shell: Shell, changed_to: str | None) -> None:
    project(shell)
    measure(shell)
    path = shell.folder / "results/demo"
    results = read_results_folder(path)
    first = results.spec.samples[0]
    if changed_to is None:
        again = first.model_copy(update={"id": f"{first.id}-2"})
        results = results_of(results.spec.model_copy(update={"samples": [*results.spec.samples, again]}))
        servers = [ServerFacts(cpu="EPYC 7452")] * len(results.spec.samples[:-1]) + [ServerFacts(cpu="EPYC 7763")]
    else:
        servers = [ServerFacts(cpu="EPYC 7452", changed_to=changed_to)]
    results = told(results, *servers)
    write(path, results.spec)
    said = shell("compile", "specs/demo.yaml", *AT).out
    count = len(results.spec.samples)
    assert f"{count} of {count} samples count" in said
    assert f"{first.machine.instance} is not one kind of machine: it was measured on EPYC 7452 and on EPYC 7763" in said
