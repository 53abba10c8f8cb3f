"""A plan that may cost more than its budget is refused before anything is written, with the ways to make it fit."""

import re

import pytest

from tests.support.running import Shell, measure, project, shell, spec  # noqa: F401

WIDE = "{cpus: 2..32, gpus: [none, T4]}"
AT = ("--catalog", "offers.csv")


def refused(shell: Shell, budget: str, **parts: str) -> str:
    limits = f"{{budget: {budget}, stop: {{duration: 5min}}, setup_timeout: 1min}}"
    shell.write("specs/demo.yaml", spec(**{"hardware": WIDE, "benchmark": limits, **parts}))
    return shell("compile", "specs/demo.yaml", *AT, code=5).err


@pytest.fixture
def offers(shell: Shell) -> Shell:
    project(shell)
    for path in sorted((shell.folder / "compiled").rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    (shell.folder / "compiled").rmdir()
    return shell


def test_nothing_is_written_and_three_ways_are_named_besides_more_money(offers: Shell) -> None:
    said = refused(offers, "$1.20")
    assert "the plan may cost $1.93, the budget is $1.20" in said, "$6.42 an hour for 18 minutes"
    assert "measuring $0.535, set-up $0.107, start and end of the machines $1.28, each at most" in said
    assert not (offers.folder / "compiled").exists()
    ways = [line for line in said.splitlines() if line.startswith("  - ")]
    assert len(ways) == 4
    assert "raise spec.benchmark.budget" in ways[-1]
    assert all("loses" in way for way in ways)


def test_fewer_machines_says_which_cells_are_lost(offers: Shell) -> None:
    said = refused(offers, "$0.40")
    assert re.search(
        r"measure \d of \d machines .* loses b\.huge \(largest vCPUs \(32\), median memory \(128 GiB\)\)", said
    )


@pytest.mark.parametrize("budget", ["$0.10", "$0.25", "$0.40", "$0.60"])
def test_every_way_that_changes_the_spec_makes_it_fit(offers: Shell, budget: str) -> None:
    said = refused(offers, budget)
    tried = 0
    for line in said.splitlines():
        parts = {"hardware": WIDE, "benchmark": f"{{budget: {budget}, stop: {{duration: 5min}}, setup_timeout: 1min}}"}
        if found := re.search(r"lower spec.benchmark.stop.duration from 5min to (\w+)", line):
            parts["benchmark"] = parts["benchmark"].replace("duration: 5min", f"duration: {found[1]}")
        elif found := re.search(r"lower spec.benchmark.setup_timeout from 1min to (\w+)", line):
            parts["benchmark"] = parts["benchmark"].replace("setup_timeout: 1min", f"setup: {found[1]}")
        elif found := re.search(r"lower spec.hardware.cpus to at most (\d+)", line):
            parts["hardware"] = WIDE.replace("2..32", f"2..{found[1]}")
        elif found := re.search(r"take (\w+) out of spec.hardware.gpus", line):
            parts["hardware"] = WIDE.replace("[none, T4]", "[T4]" if found[1] == "none" else "[none]")
        elif found := re.search(r"raise spec.benchmark.budget to (\$[\d.]+)", line):
            parts["benchmark"] = parts["benchmark"].replace(budget, found[1])
        else:
            continue
        offers.write("specs/demo.yaml", spec(**parts))
        offers("compile", "specs/demo.yaml", *AT)
        tried += 1
    assert tried >= 2


def test_what_was_measured_already_is_not_paid_twice(offers: Shell) -> None:
    project(offers, benchmark="{budget: $0.30, stop: {duration: 1min}, setup_timeout: 1min}")
    measure(offers)
    offers("compile", "specs/demo.yaml", *AT)
    offers.write(
        "specs/demo.yaml", spec(hardware=WIDE, benchmark="{budget: $0.30, stop: {duration: 1min}, setup_timeout: 1min}")
    )
    said = offers("compile", "specs/demo.yaml", *AT, code=5).err
    assert "of it spent already" in said
    assert "4 samples to measure" in said
