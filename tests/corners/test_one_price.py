"""One benchmark has one price, in `compile`, `bench --dry-run` and `diff`; to name it needs no SkyPilot."""

import json
import os
import re
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from fogspec.base.units import dollars
from fogspec.catalog import sources
from fogspec.language.loader import read_document
from fogspec.plan.schema import Plan
from tests.corners.test_no_access import sources_missing
from tests.e2e.test_bench_money import _Shop
from tests.support.running import CATALOG, Shell, measure, shell, spec  # noqa: F401

AT = ("--catalog", "offers.csv")
STOP = "stop: {requests: 20, duration: 1min}, ready_timeout: 1min"
SPECS = {
    "grid": (f"{{budget: $5, sampler: grid, {STOP}}}", 4),
    "list": (f"{{budget: $5, machines: [a.small, b.large], {STOP}}}", 2),
    "adaptive": (f"{{budget: $5, sampler: adaptive, {STOP}}}", 3),
    "servers": (f"{{budget: $5, sampler: adaptive, servers: 2, {STOP}}}", 3),
    "long": ("{budget: $5, sampler: grid, stop: {requests: 900, duration: 25min}, ready_timeout: 40min}", 4),
}


@pytest.fixture(autouse=True)
def no_prices_of_skypilot(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object) -> None:
        raise sources_missing()

    monkeypatch.setattr(sources, "load_catalog", _Shop(none))


BESIDE = 2 * (16.46 / 730 + 0.005)  # of disk and address per hour, in a region that is not known


def prices(shell: Shell) -> tuple[str, str, str, float, float]:
    """What compile, bench and diff say, then what JSON of compile and diff says."""
    compiled = shell("compile", "specs/demo.yaml", *AT, "-v", code=None).out  # exits with 7 while samples are left
    bench = shell("bench", "specs/demo.yaml", "--runner", "skypilot", "--dry-run").err
    diff = shell("diff", "specs/demo.yaml").out
    told = json.loads(shell("compile", "specs/demo.yaml", *AT, "-o", "json", code=None).out)[0]["estimate_usd"][
        "at_most"
    ]
    due = json.loads(shell("diff", "specs/demo.yaml", "-o", "json").out)["applications"][0]["measuring_usd_at_most"]
    (plan,) = re.findall(r"^  plan .*?at most (\$[0-9.]+)", compiled, re.MULTILINE)
    (offered,) = re.findall(r"samples to measure.*?at most (\$[0-9.]+)", bench)
    (measuring,) = re.findall(r"to measure first.*?at most (\$[0-9.]+)", diff)
    return plan, offered, measuring, told, due


@pytest.mark.parametrize("name", SPECS)
def test_a_benchmark_has_one_price(shell: Shell, name: str) -> None:
    benchmark, samples = SPECS[name]
    shell.write("offers.csv", CATALOG)
    shell.write("specs/work.py", "print('work')\n")
    shell.write("specs/demo.yaml", spec(benchmark=benchmark))
    plan, bench, diff, told, due = prices(shell)
    body = read_document(shell.folder / "compiled/demo/plan.yaml", Plan).spec
    assert len(body.samples) == samples
    # An adaptive bench may spend its budget; any other each machine until its end.
    by_hand = (
        5.0
        if body.sampler == "adaptive"
        else sum(one.machine.price + BESIDE for one in body.samples) * body.commitment.paid_s / 3600
    )
    assert {plan, bench, diff} == {dollars(by_hand)}
    assert (told, due) == (pytest.approx(by_hand, abs=1e-6),) * 2


@pytest.mark.parametrize("name", ["grid", "adaptive"])
def test_what_is_left_has_one_price_too(shell: Shell, name: str) -> None:
    shell.write("offers.csv", CATALOG)
    shell.write("specs/work.py", "print('work')\n")
    shell.write("specs/demo.yaml", spec(benchmark=SPECS[name][0]))
    shell("compile", "specs/demo.yaml", *AT)
    measure(shell, only=1)
    _, bench, diff, _, due = prices(shell)
    assert bench == diff == dollars(due)
    if name == "grid":
        measure(shell)
        bench = shell("bench", "specs/demo.yaml", "--runner", "skypilot", "--dry-run").err
        assert "0 of 4 samples to measure: at most $0.00" in bench
        (due,) = json.loads(shell("diff", "specs/demo.yaml", "-o", "json").out)["applications"]
        assert due["measuring_usd_at_most"] == 0


def test_the_price_of_machines_at_once_is_for_people(shell: Shell) -> None:
    shell.write("offers.csv", CATALOG.replace("0.10", "0.17").replace("0.40", "0.768"))
    shell.write("specs/work.py", "print('work')\n")
    shell.write("specs/demo.yaml", spec(benchmark=f"{{budget: $5, machines: [a.small, a.large], {STOP}}}"))
    shell("compile", "specs/demo.yaml", *AT)
    said = shell("bench", "specs/demo.yaml", "--runner", "skypilot", "--dry-run").err
    assert "2 machines at once: at most $1.05/h together" in said, "$0.938 of the machines alone"


@pytest.fixture
def python(tmp_path: Path) -> Path:
    """A Python with all packages of this one but SkyPilot, as `pip install fogspec` without its extra leaves it."""
    folder = tmp_path / "env"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    there = next(folder.glob("lib/python3.*/site-packages"))
    for one in Path(sysconfig.get_path("purelib")).iterdir():
        if one.name != "sky" and not one.name.startswith("skypilot"):
            (there / one.name).symlink_to(one)
    return folder / "bin" / "python"


@pytest.mark.slow
def test_a_dry_run_needs_no_skypilot(shell: Shell, python: Path, tmp_path: Path) -> None:
    """Neither the package nor the command is there."""
    shell.write("offers.csv", CATALOG)
    shell.write("specs/work.py", "print('work')\n")
    shell.write("specs/demo.yaml", spec())
    kept = {name: os.environ[name] for name in ("XDG_CACHE_HOME", "SKY_RUNTIME_DIR")}
    env = {"HOME": str(tmp_path), "PATH": "/usr/bin:/bin", **kept}

    def fogspec(*words: str) -> "subprocess.CompletedProcess[str]":
        argv = [str(python), "-m", "fogspec", *words, "specs/demo.yaml"]
        return subprocess.run(argv, cwd=shell.folder, env=env, capture_output=True, text=True)

    assert fogspec("compile", *AT).returncode == 0
    said = fogspec("bench", "--runner", "skypilot", "--dry-run")
    assert said.returncode == 1, said.stderr
    assert "problem      SkyPilot   SkyPilot is not installed here" in said.stdout
    assert "4 of 4 samples to measure: at most $" in said.stderr
    assert said.stdout.count("for disk and address, at most $") == 4
    said = fogspec("bench", "--runner", "skypilot", "--yes")
    assert said.returncode != 0
    assert "pip install 'fogspec[sky]'" in said.stderr, "without it nothing can be measured: it was not there"
