"""A plan that may cost more than its budget is refused before anything is written, with the ways to make it fit."""

import re

import pytest
import yaml

from tests.support.running import CATALOG, Shell, measure, project, shell, spec  # noqa: F401

WIDE = "{cpus: 2..32, gpus: [none, T4]}"
AT = ("--catalog", "offers.csv")


def refused(shell: Shell, budget: str, **parts: str) -> str:
    limits = f"{{budget: {budget}, stop: {{duration: 5min}}, ready_timeout: 1min}}"
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
    assert "the plan may cost $2.06, the budget is $1.20" in said, (
        "$6.42 an hour for 18 minutes, and 8 disks and addresses"
    )
    assert "measuring $0.5717, set-up $0.1143, start and end of the machines $1.37, each at most" in said
    assert not (offers.folder / "compiled").exists()
    ways = [line for line in said.splitlines() if line.startswith("  - ")]
    assert len(ways) == 4
    assert "raise spec.benchmark.budget" in ways[-1]
    assert all("loses" in way for way in ways)


def test_fewer_machines_says_which_cells_are_lost(offers: Shell) -> None:
    said = refused(offers, "$0.40")
    assert re.search(
        r"machines to \[.*\], \d of \d machines: .* loses b\.huge \(largest vCPUs \(32\), median memory \(128 GiB\)\)",
        said,
    )


def taken(text: str, way: str) -> str:
    """The spec with one of the printed ways taken, as its words say."""
    data = yaml.safe_load(text)
    body = data["spec"]
    benchmark, hardware = body["benchmark"], body["hardware"]
    if found := re.search(r"lower spec.benchmark.stop.duration from \w+ to (\w+):", way):
        benchmark["stop"]["duration"] = found[1]
    elif found := re.search(r"lower spec.benchmark.ready_timeout from \w+ to (\w+):", way):
        benchmark["ready_timeout"] = found[1]
    elif found := re.search(r"set spec.benchmark.machines to \[([^]]+)\]", way):
        benchmark["machines"] = found[1].split(", ")
    elif found := re.search(r"lower spec.hardware.cpus to at most (\d+):", way):
        hardware["cpus"] = f"2..{found[1]}"
    elif found := re.search(r"take (\w+) out of spec.hardware.gpus:", way):
        hardware["gpus"].remove(found[1])
    elif found := re.search(r"raise spec.benchmark.budget to (\$[\d.]+):", way):
        benchmark["budget"] = found[1]
    else:
        pytest.fail(f"not a change of a spec: {way}")
    return yaml.safe_dump(data)


TIMES = "stop: {duration: 5min}, ready_timeout: 1min"
LONG = "{latency: 250s, cost: $1/request}"
BOTH = "[aws/r1, aws/r2]"


@pytest.mark.parametrize(
    ("benchmark", "parts"),
    [
        *((f"{{budget: {budget}, {TIMES}}}", {}) for budget in ("$0.10", "$0.40", "$0.60")),
        *((f"{{budget: {budget}, {TIMES}}}", {"constraints": LONG}) for budget in ("$1.85", "$1.60")),
        *((f"{{budget: {budget}, {TIMES}}}", {"infra": BOTH}) for budget in ("$1", "$2.20")),
        (f"{{budget: $0.80, {TIMES}, machines: [a.small, b.huge, g.large]}}", {}),
        (f"{{budget: $0.028, {TIMES}, sampler: adaptive}}", {}),
    ],
)
def test_every_way_to_make_it_fit_fits_when_it_is_taken(offers: Shell, benchmark: str, parts: dict[str, str]) -> None:
    offers.write("offers.csv", CATALOG + "".join(
        line.replace(",r1,", ",r2,") + "\n" for line in CATALOG.splitlines()[1:6]
    ))  # fmt: skip
    text = spec(**{"hardware": WIDE, "benchmark": benchmark, **parts})
    offers.write("specs/demo.yaml", text)
    ways = [line for line in offers("compile", "specs/demo.yaml", *AT, code=5).err.splitlines() if line[:4] == "  - "]
    for way in ways:
        offers.write("specs/demo.yaml", taken(text, way))
        offers("compile", "specs/demo.yaml", *AT)
        assert re.search(r": at most \$[\d.]+; loses|: loses nothing", way)


def test_ways_of_a_benchmark_that_has_begun_fit_when_they_are_taken(offers: Shell) -> None:
    limits = "{latency: 10s, confidence: none}"
    project(offers, hardware=WIDE, constraints=limits, benchmark=f"{{budget: $5, {TIMES}}}")
    measure(offers, only=3)
    text = spec(hardware=WIDE, constraints=limits, benchmark=f"{{budget: $1, {TIMES}}}")
    offers.write("specs/demo.yaml", text)
    ways = [line for line in offers("compile", "specs/demo.yaml", *AT, code=5).err.splitlines() if line[:4] == "  - "]
    assert len(ways) >= 3
    for way in ways:
        offers.write("specs/demo.yaml", taken(text, way))
        offers("compile", "specs/demo.yaml", *AT, "--partial")


def test_what_was_measured_already_is_not_paid_twice(offers: Shell) -> None:
    project(offers, benchmark="{budget: $0.40, stop: {duration: 1min}, ready_timeout: 1min}")
    measure(offers)
    offers("compile", "specs/demo.yaml", *AT)
    offers.write(
        "specs/demo.yaml", spec(hardware=WIDE, benchmark="{budget: $0.40, stop: {duration: 1min}, ready_timeout: 1min}")
    )
    said = offers("compile", "specs/demo.yaml", *AT, code=5).err
    assert "of it spent already" in said
    assert "4 samples to measure" in said
