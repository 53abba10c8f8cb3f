"""What a bench may spend: said first, agreed to, at prices that still hold, and never beyond the wall."""

import re
import shutil
import subprocess

import click
import pytest
from ruamel.yaml import YAML

from fogspec.backends.protocol import Costs
from fogspec.base.errors import InvalidInput
from fogspec.base.units import dollars
from fogspec.catalog import sources
from fogspec.language.loader import read_document
from fogspec.plan.schema import Plan
from fogspec.results.io import read_results_folder
from fogspec_lab import cli as lab
from fogspec_lab.replay import ReplaySamples
from tests.support import results as measured_files
from tests.support.running import CATALOG, Ended, Shell, project, shell  # noqa: F401

SWEEP = "instance_type,latency_s\na.small,2\na.large,0.8\nb.small,2\nb.large,0.8\nb.huge,0.3\na.huge,0.3\n"
AT = ("--catalog", "offers.csv")


@pytest.fixture
def paid(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> Shell:
    """A compiled project, and a replay that passes for a runner that costs real money; its catalog is the shop's."""
    monkeypatch.setattr(ReplaySamples, "costs", Costs.REAL)

    def none(*_: object) -> None:
        raise InvalidInput("no SkyPilot here")

    monkeypatch.setattr(sources, "load_catalog", _Shop(none))
    project(shell)
    shell.write("sweep.csv", SWEEP)
    return shell


class _Shop:
    """`load_catalog` without SkyPilot's own catalogs."""

    def __init__(self, none):
        self._none, self._real = none, sources.load_catalog

    def __call__(self, origin, clouds, machines=()):
        return self._none() if origin == "skypilot" else self._real(origin, clouds, machines)


def bench(shell: Shell, *words: str, code: int = 0, sweep: str = "sweep.csv") -> Ended:
    return shell("replay", "specs/demo.yaml", "--from", sweep, *words, code=code, run=lab.main)


def results(shell: Shell) -> dict:
    return measured_files.document(shell.folder / "results/demo")


def nothing_happened(shell: Shell) -> bool:
    return not (shell.folder / "results").exists() and not (shell.folder / ".fogspec/demo/attempts").exists()


def test_without_a_yes_nothing_is_spent(paid):
    said = bench(paid, code=5)
    assert "4 of 4 samples to measure: at most $0.3" in said.err
    assert "--yes" in said.err
    assert nothing_happened(paid)
    bench(paid, "--yes")
    assert len(results(paid)["samples"]) == 4


def test_who_is_asked_may_decline(paid, monkeypatch):
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr(click, "confirm", lambda *_, **__: False)
    assert "nothing was started" in bench(paid, code=5).err
    assert nothing_happened(paid)
    monkeypatch.setattr(click, "confirm", lambda *_, **__: True)
    bench(paid)
    assert len(results(paid)["samples"]) == 4


def test_what_is_measured_needs_no_yes(paid):
    bench(paid, "--yes")
    assert "0 of 4 samples to measure" in bench(paid).err


def test_a_price_that_rose_is_refused_before_anything_starts(paid):
    paid.write("offers.csv", CATALOG.replace("a.large,,,8,16,0.40", "a.large,,,8,16,0.44"))
    said = bench(paid, "--yes", code=5)
    assert "aws/r1 a.large costs $0.44/h, the plan says $0.40/h" in said.err
    assert "fogspec compile specs/demo.yaml" in said.err
    assert nothing_happened(paid)
    paid("compile", "specs/demo.yaml", *AT)
    bench(paid, "--yes")


def test_a_price_that_fell_and_a_machine_that_is_not_measured_are_no_matter(paid):
    paid.write("offers.csv", CATALOG.replace("a.large,,,8,16,0.40", "a.large,,,8,16,0.30").replace("1.60", "1.80"))
    bench(paid, "--yes")


def test_a_machine_that_is_no_longer_on_offer_is_refused(paid):
    paid.write("offers.csv", "".join(line for line in CATALOG.splitlines(True) if not line.startswith("b.large")))
    assert "aws/r1 b.large is not on offer" in bench(paid, "--yes", code=5).err


def test_a_dry_run_says_each_sample_and_its_most(paid):
    said = bench(paid, "--dry-run")
    assert said.out.count("for disk and address, at most $") == 4
    assert nothing_happened(paid)


def test_max_is_a_wall_below_the_budget(paid):
    bench(paid, "--yes", "--max", "$0.06")
    found = results(paid)
    assert float(found["spent"].removeprefix("$")) <= 0.06
    assert {one.get("reason") for one in found["samples"]} >= {"budget"}
    bench(paid, "--yes")
    assert {one["state"] for one in results(paid)["samples"]} == {"ok"}
    assert bench(paid, "--max", "2", code=2).err.count("max")


def test_a_lower_budget_counts_without_a_new_plan(paid):
    """The budget is the spec's, not what it was when the plan was written."""
    text = paid.read("specs/demo.yaml")
    paid.write("specs/demo.yaml", text.replace("budget: $5", "budget: $0.06"))
    bench(paid, "--yes")
    assert float(results(paid)["spent"].removeprefix("$")) <= 0.06


def test_a_grid_with_an_unavailable_machine_ends_without_it_and_says_the_ways_on(paid):
    paid.write("short.csv", SWEEP.replace("a.large,0.8\n", ""))
    said = bench(paid, "--yes", sweep="short.csv", code=None)
    states = {one["machine"]["instance"]: (one["state"], one.get("reason")) for one in results(paid)["samples"]}
    assert states.pop("a.large") == ("failed", "capacity")
    assert set(states.values()) == {("ok", None)}
    assert "    again: fogspec bench specs/demo.yaml --runner replay --only aws-r1-a-large" in said.out
    assert "    without it: fogspec compile specs/demo.yaml --partial" in said.out
    refused = paid("compile", "specs/demo.yaml", *AT, code=7)
    assert "3 of 4 planned samples are measured" in refused.out + refused.err
    paid("compile", "specs/demo.yaml", *AT, "--partial")
    manifest = YAML(typ="safe", pure=True).load(paid.read("compiled/demo/manifest.yaml"))
    assert manifest["warnings"][0]["missing"] == ["aws-r1-a-large"]
    before = {one["id"]: one for one in results(paid)["samples"]}
    bench(paid, "--yes")
    after = {one["id"]: one for one in results(paid)["samples"]}
    assert after.pop("aws-r1-a-large")["state"] == "ok"
    del before["aws-r1-a-large"]
    assert after == before, "what was measured stays as it was"


def test_a_host_without_a_runner_word_measures_what_it_replays(paid):
    assert "with the replay runner" not in bench(paid, "--dry-run").err
    assert paid("bench", "specs/demo.yaml", "--runner", "replay", code=2).err


def test_an_edit_of_what_is_measured_does_not_reset_what_was_spent(paid):
    """Not with its results set aside, not deleted, and not without the journal: the budget is the application's."""
    bench(paid, "--yes")
    bench(paid, "--yes", "--only", ",".join(one["id"] for one in results(paid)["samples"]))
    spent = float(results(paid)["spent"].removeprefix("$"))
    text = paid.read("specs/demo.yaml")
    budget = "$0.04"
    edited = text.replace("work.py]", "work.py, fast]")
    kept = read_results_folder(paid.folder / "results/demo").spec
    for case in ("journal", "deleted", "committed"):
        if case != "journal":
            measured_files.remove(paid.folder / "results/demo")
        if case == "committed":
            shutil.rmtree(paid.folder / ".fogspec")
            measured_files.write(paid.folder / "results/demo", kept)
            for words in (
                ["init", "-q"],
                ["add", "-A"],
                ["-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "a"],
            ):
                subprocess.run(["git", *words], cwd=paid.folder, check=True)
            measured_files.remove(paid.folder / "results/demo")
            for old in (paid.folder / "results").glob("demo.old-*"):
                shutil.rmtree(old)
        paid.write("specs/demo.yaml", edited)
        paid("compile", "specs/demo.yaml", *AT)
        paid.write("specs/demo.yaml", edited.replace("budget: $5", f"budget: {budget}"))
        said = bench(paid, "--yes", "--all", code=5)
        assert f"{dollars(spent)} of the budget of {dollars(0.04)} is spent" in said.err, case
        assert "raise spec.benchmark.budget to at least $" in said.err
        if case == "journal":
            assert measured_files.text(paid.folder / "results/demo.old-1")
            shutil.rmtree(paid.folder / "results/demo.old-1")
            measured_files.write(paid.folder / "results/demo", kept)
    raised = paid.read("specs/demo.yaml").replace(f"budget: {budget}", "budget: $9")
    paid.write("specs/demo.yaml", raised)
    paid("compile", "specs/demo.yaml", *AT)
    assert f"{dollars(spent)} of the budget of $9.00 is spent" in bench(paid, "--yes", "--all").err
    assert float(results(paid)["spent"].removeprefix("$")) > spent * 1.4


def test_after_a_change_one_sample_is_offered_with_its_price(paid):
    bench(paid, "--yes")
    before = results(paid)
    paid.write("specs/work.py", "print('other')\n")
    paid("compile", "specs/demo.yaml", *AT)
    body = read_document(paid.folder / "compiled/demo/plan.yaml", Plan).spec
    at_most = {one.machine.instance: dollars(body.commitment.usd(one.machine)) for one in body.samples}
    for words, code in (((), 5), (("--dry-run",), 0)):
        said = bench(paid, *words, code=code)
        ((name, usd),) = set(re.findall(r"demo: (\S+) to measure once more: at most (\$[0-9.]+),", said.err))
        assert usd == at_most[name]
        assert "a change by less than" in said.err
        assert results(paid) == before
    everything = bench(paid, "--dry-run", "--all")
    assert "4 of 4 samples to measure: at most $0.3" in everything.err
    assert "next: fogspec-lab replay specs/demo.yaml --from sweep.csv --all" in everything.out
    bench(paid, "--yes")
    after = results(paid)
    assert len(after["samples"]) == 5
    assert float(after["spent"].removeprefix("$")) > float(before["spent"].removeprefix("$"))
    said = bench(paid)
    assert "0 of 4 samples to measure" in said.err
