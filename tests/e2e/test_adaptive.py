"""`sampler: adaptive` as a user runs it: compile, bench in batches on a replayed sweep, compile again."""

import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from fogspec_lab import cli as lab
from tests.support import results as measured_files
from tests.support.running import Ended, Shell, shell, spec  # noqa: F401
from tests.support.scenes import until

SIZES = {"small": 2, "medium": 4, "large": 8, "xlarge": 16, "huge": 32, "giant": 64}
FAMILIES = {"a": (2, 0.05), "b": (4, 0.06), "c": (8, 0.08)}
ADAPTIVE = "{sampler: adaptive, budget: $5, stop: {requests: 20, duration: 1min}, ready_timeout: 1min}"
AT = ("--catalog", "offers.csv")


def latency_s(cpus: int, family: str) -> float:
    """More CPUs help up to a point; family b is a little faster."""
    return (6 * (0.1 + 0.9 / cpus) + 0.01 * cpus) * (0.9 if family == "b" else 1.0)


def machines() -> list[tuple[str, int, int, float, float]]:
    """Name, vCPUs, GiB, price and latency of each machine."""
    return [
        (f"{family}.{size}", cpus, cpus * per_cpu, round(price * cpus / 2, 4), latency_s(cpus, family))
        for family, (per_cpu, price) in FAMILIES.items()
        for size, cpus in SIZES.items()
    ]


def cost(price: float, latency: float) -> float:
    return price / 3600 * latency


def best() -> float:
    """The objective of the best machine: half latency over 5 s, half cost over its limit."""
    return min(objective(name) for name, *_ in machines())


def objective(instance: str) -> float:
    _, _, _, price, latency = next(one for one in machines() if one[0] == instance)
    return 0.5 * latency / 5 + 0.5 * cost(price, latency) / 0.001


@pytest.fixture
def project(shell: Shell) -> Shell:
    """A spec, a catalog and a sweep of all its machines."""
    head = "InstanceType,AcceleratorName,AcceleratorCount,vCPUs,MemoryGiB,Price,SpotPrice,Region,AvailabilityZone\n"
    shell.write("offers.csv", head + "".join(f"{n},,,{c},{m},{p},,r1,\n" for n, c, m, p, _ in machines()))
    shell.write("sweep.csv", "instance_type,latency_s\n" + "".join(f"{n},{s:.5f}\n" for n, _, _, _, s in machines()))
    shell.write("specs/work.py", "print('work')\n")
    write_spec(shell)
    return shell


def write_spec(shell: Shell, **parts: str) -> None:
    usual = {"constraints": "{latency: 5s, cost: $0.001/request}", "hardware": "{cpus: 2..64}", "benchmark": ADAPTIVE}
    shell.write("specs/demo.yaml", spec(**{**usual, **parts}))


def document(shell: Shell, name: str) -> dict:
    return YAML(typ="safe", pure=True).load(shell.read(name))


def bench(shell: Shell, *words: str, code: int = 0, sweep: str = "sweep.csv") -> Ended:
    return shell("replay", "specs/demo.yaml", "--from", sweep, *words, code=code, run=lab.main)


def results(shell: Shell) -> dict:
    return measured_files.document(shell.folder / "results/demo")


def usd(text: str) -> float:
    return float(text.removeprefix("$"))


def test_few_samples_a_good_choice_and_everything_fresh(project):
    assert "never beyond the budget of $5.00" in project("compile", "specs/demo.yaml", *AT).out
    first = document(project, "compiled/demo/plan.yaml")["spec"]
    assert (first["sampler"], len(first["samples"])) == ("adaptive", 3)
    project("check", "specs/demo.yaml")
    said = bench(project)
    assert "sampling ended: " in said.out
    found = results(project)
    batches = found["sampling"]["batches"]
    assert [one["id"] for one in first["samples"]] == [one["id"] for one in batches[0]["samples"]]
    asked = [one["id"] for batch in batches for one in batch["samples"]]
    assert [one["id"] for one in found["samples"]] == asked
    assert 4 <= len(asked) <= 9
    assert usd(found["spent"]) <= 5
    project("compile", "specs/demo.yaml", *AT)
    project("check", "specs/demo.yaml")
    project("check", "specs/demo.yaml")
    manifest = document(project, "compiled/demo/manifest.yaml")
    chosen = manifest["spec"]["instance"]
    assert objective(chosen) <= 1.05 * best()
    assert chosen in {one["machine"]["instance"] for one in found["samples"]}, "the choice is measured"


def test_a_sample_that_cannot_become_the_choice_need_not_become_precise(project):
    """From the latency in its task on, a machine breaks a limit or is no better than the choice; the first ones have none."""
    project("compile", "specs/demo.yaml", *AT)
    bench(project)
    found = results(project)
    first, *later = found["sampling"]["batches"]
    assert not any("decided_above" in one for one in first["samples"])
    decided = [one for batch in later for one in batch["samples"] if "decided_above" in one]
    assert decided
    project("compile", "specs/demo.yaml", *AT)
    chosen = document(project, "compiled/demo/manifest.yaml")["spec"]["instance"]
    for one in decided:
        above_s, price = float(one["decided_above"].removesuffix("s")), usd(one["machine"]["price"].removesuffix("/h"))
        dear = cost(price, above_s)
        assert above_s >= 4.99 or dear >= 0.00099 or 0.5 * above_s / 5 + 0.5 * dear / 0.001 > objective(chosen) * 0.99
        task = document(project, f"compiled/demo/tasks/{one['id']}.sky.yaml")
        assert task["run"] == f"exec bash ~/.fogspec/measure.sh --decided-above {above_s:g}"


def test_another_server_is_asked_for_and_its_price_and_worth_are_said(project):
    """A sweep has one server of each type: that there is no other one is said, and nothing measured is lost."""
    write_spec(project, benchmark=ADAPTIVE.replace("budget", "servers: 2, budget"))
    project("compile", "specs/demo.yaml", *AT)
    bench(project)
    found = results(project)
    assert "could not be measured on another server" in found["sampling"]["stop_reason"]
    (again,) = [one for one in found["samples"] if one["id"].endswith("repeat-2")]
    assert (again["state"], again["reason"]) == ("failed", "capacity")
    project("compile", "specs/demo.yaml", *AT)
    assert document(project, "compiled/demo/manifest.yaml")["spec"]["instance"] == again["machine"]["instance"]
    said = " ".join(project("explain", "specs/demo.yaml", "-v").out.split())
    assert "servers of one type on aws differ by more than 5% with probability 0.18" in said
    assert f"benchmark.servers: 2 measures {again['machine']['instance']} on another one, for at most $0.0" in said


def test_what_bench_writes_of_the_plan_is_what_compile_writes(project):
    project("compile", "specs/demo.yaml", *AT)
    bench(project)
    folder = project.folder / "compiled/demo"
    before = {path: path.read_bytes() for path in [folder / "plan.yaml", *folder.glob("tasks/*")]}
    assert len(before) > 4
    project("compile", "specs/demo.yaml", *AT)
    assert {path: path.read_bytes() for path in [folder / "plan.yaml", *folder.glob("tasks/*")]} == before


def test_the_same_results_again_and_nothing_measured_twice(project, tmp_path):
    project("compile", "specs/demo.yaml", *AT)
    bench(project)
    before = measured_files.text(project.folder / "results/demo")
    assert "0 of" in bench(project).err
    assert measured_files.text(project.folder / "results/demo") == before
    measured_files.remove(project.folder / "results/demo")
    (project.folder / ".fogspec/demo/journal.jsonl").unlink()
    project("compile", "specs/demo.yaml", *AT)
    bench(project)
    assert measured_files.text(project.folder / "results/demo") == before


def test_other_limits_cost_nothing_until_bench_is_asked(project):
    project("compile", "specs/demo.yaml", *AT)
    bench(project)
    measured = len(results(project)["samples"])
    write_spec(project, constraints="{latency: 2s}", objective="{alpha: 1}")
    project("compile", "specs/demo.yaml", *AT)
    project("check", "specs/demo.yaml")
    assert len(results(project)["samples"]) == measured
    bench(project)
    assert len(results(project)["samples"]) >= measured
    project("compile", "specs/demo.yaml", *AT)
    project("check", "specs/demo.yaml")


def test_a_larger_box_is_partial_and_a_smaller_one_fresh(project):
    write_spec(project, hardware="{cpus: 2..16}")
    project("compile", "specs/demo.yaml", *AT)
    bench(project)
    project("compile", "specs/demo.yaml", *AT)
    before = measured_files.text(project.folder / "results/demo")
    write_spec(project, hardware="{cpus: 2..8}")
    project("compile", "specs/demo.yaml", *AT)
    project("check", "specs/demo.yaml")
    assert measured_files.text(project.folder / "results/demo") == before
    write_spec(project, hardware="{cpus: 2..64}")
    project("compile", "specs/demo.yaml", *AT, code=7)
    assert "the candidates have changed" in project("status", "specs/demo.yaml").out
    bench(project)
    project("compile", "specs/demo.yaml", *AT)
    project("check", "specs/demo.yaml")


@pytest.mark.parametrize("budget", ["$0.09", "$0.2", "$0.6", "$2"])
def test_the_budget_is_a_wall_for_waves_too(project, budget):
    write_spec(project, benchmark=ADAPTIVE.replace("$5", budget))
    project("compile", "specs/demo.yaml", *AT)
    bench(project)
    found = results(project)
    assert usd(found["spent"]) <= usd(budget)
    assert found["sampling"]["stop_reason"]
    assert not [one for one in found["samples"] if one.get("reason") == "budget" and one["id"] not in
                {sample["id"] for sample in found["sampling"]["batches"][0]["samples"]}]  # fmt: skip


def test_a_bench_may_be_told_to_spend_less_than_the_budget(project):
    project("compile", "specs/demo.yaml", *AT)
    bench(project, "--max", "$0.05")
    some = results(project)
    assert usd(some["spent"]) <= 0.05
    assert some["sampling"]["out_of_budget"]
    bench(project)
    assert usd(results(project)["spent"]) > usd(some["spent"])
    assert not results(project)["sampling"]["out_of_budget"]


def test_the_next_batch_does_without_a_machine_that_is_unavailable(project):
    project("compile", "specs/demo.yaml", *AT)
    first = document(project, "compiled/demo/plan.yaml")["spec"]["samples"]
    gone = first[0]["machine"]["instance"]
    sweep = "".join(line for line in project.read("sweep.csv").splitlines(True) if not line.startswith(f"{gone},"))
    project.write("short.csv", sweep)
    said = bench(project, sweep="short.csv")
    records = {one["id"]: one for one in results(project)["samples"]}
    failed = records[first[0]["id"]]
    assert (failed["state"], failed["reason"]) == ("failed", "capacity")
    assert "without it:" not in said.out + said.err, "sampling ended with a choice: nothing is missing"
    later = [one["machine"]["instance"] for one in records.values() if one["id"] not in {one["id"] for one in first}]
    assert later
    assert gone not in later
    others = [
        one for one in records.values() if one is not failed and "-repeat-" not in one["id"]
    ]  # measured once each
    assert {one["state"] for one in others} == {"ok"}
    project("compile", "specs/demo.yaml", *AT)
    project("check", "specs/demo.yaml")
    again = bench(project, sweep="short.csv")
    assert "0 of" in again.err


def test_a_workload_that_fails_everywhere_does_not_try_every_machine(project):
    project("compile", "specs/demo.yaml", *AT)
    project.write("none.csv", "instance_type,latency_s\nother.large,1.0\n")
    said = bench(project, sweep="none.csv", code=1)
    assert "no sample could be measured" in said.err
    assert len(document(project, "compiled/demo/plan.yaml")["spec"]["samples"]) <= 6
    assert "stop_reason" not in results(project)["sampling"]


def test_only_named_samples_ask_for_no_wave(project):
    project("compile", "specs/demo.yaml", *AT)
    first = document(project, "compiled/demo/plan.yaml")["spec"]["samples"][0]["id"]
    bench(project, "--only", first)
    assert "sampling" not in results(project)
    bench(project)
    assert results(project)["sampling"]["stop_reason"]


def test_a_dry_run_asks_nobody(project):
    project("compile", "specs/demo.yaml", *AT)
    said = bench(project, "--dry-run")
    assert said.out.count("at most $") == 3
    assert not Path(project.folder / "results/demo").exists()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_stopped_in_the_middle_of_a_wave_it_goes_on_to_the_same_end(project, number):
    project("compile", "specs/demo.yaml", *AT)
    bench(project)
    expected = measured_files.text(project.folder / "results/demo")
    measured_files.remove(project.folder / "results/demo")
    (project.folder / ".fogspec/demo/journal.jsonl").unlink()
    project("compile", "specs/demo.yaml", *AT)
    words = ["replay", "specs/demo.yaml", "--from", "sweep.csv", "--pace", "0.02"]
    running = subprocess.Popen(
        [sys.executable, "-m", "fogspec_lab", *words], cwd=project.folder, stderr=subprocess.DEVNULL
    )
    until(lambda: "  record:" in measured_files.text(project.folder / "results/demo"))
    running.send_signal(number)
    assert running.wait(timeout=1200) == (130 if number == signal.SIGINT else -number)
    assert "stop_reason" not in results(project)["sampling"]
    bench(project)
    # A sample that was stopped while it ran is paid for twice; which one runs at the signal depends on the computer's speed.
    found = measured_files.text(project.folder / "results/demo")
    assert paid_in(found) >= paid_in(expected) - 1e-9
    money = re.compile(r"^( *spent|integrity): .*\n", re.MULTILINE)
    assert money.sub("", found) == money.sub("", expected)


def paid_in(text):
    return sum(map(float, re.findall(r"^ *spent: \$(.*)$", text, re.MULTILINE)))


def test_machines_are_asked_for_among_those_of_the_plans_own_catalog(project):
    project("compile", "specs/demo.yaml", *AT)
    project.write("offers.csv", project.read("offers.csv").replace("a.huge", "a.vast"))
    assert "compiled from another catalog" in bench(project, code=3).err
    assert not Path(project.folder / "results/demo").exists()


def test_asking_is_said_only_where_the_model_will_be_asked(project):
    project("compile", "specs/demo.yaml", *AT)
    assert "then the machines that the model selects" in bench(project).err
    assert "then the machines" not in bench(project).err


def test_what_a_library_knows_of_machines_is_used_from_the_first_wave_on(project):
    """A library of three workloads on these machines: as good a choice, and what the spec names is what is used."""
    rows = "".join(f"aws,{n},{c},{m},{p}\n" for n, c, m, p, _ in machines())
    project.write("data/machines.csv", "Cloud,InstanceType,vCPUs,MemoryGiB,Price\n" + rows)
    cells = [f"{w},other,aws,{n},{s * k:.4f}\n" for w, k in (("x", 0.3), ("y", 2), ("z", 7)) for n, *_, s in machines()]
    project.write("data/latencies.csv", "workload,suite,cloud,instance_type,latency_s\n" + "".join(cells))
    project("library", "--from", "data", "--out", "specs/library.json.gz", run=lab.main)
    text = project.read("specs/demo.yaml")
    project.write("specs/demo.yaml", text.replace("library: none", "library: library.json.gz"))
    project("compile", "specs/demo.yaml", *AT)
    project("replay", "specs/demo.yaml", "--from", "sweep.csv", run=lab.main)
    project("compile", "specs/demo.yaml")
    project("check", "specs/demo.yaml")
    assert objective(document(project, "compiled/demo/manifest.yaml")["spec"]["instance"]) <= 1.05 * best()
    assert len(results(project)["samples"]) <= 9


def with_(*more: str) -> str:
    """The usual benchmark with more fields."""
    return ADAPTIVE.replace("{", "{" + "".join(f"{one}, " for one in more), 1)


def test_as_many_are_measured_at_once_as_batch_size_says(project):
    write_spec(project, benchmark=with_("batch_size: 2"))
    said = project("compile", "specs/demo.yaml", *AT).out
    assert "then the model selects the next machines, 2 at once" in said
    bench(project)
    sizes = [len(one["samples"]) for one in results(project)["sampling"]["batches"]]
    assert sizes[0] == 3
    assert max(sizes[1:]) == 2


def test_a_spec_that_names_no_sampler_samples_adaptively_as_does_a_new_one(project):
    text = project.read("specs/demo.yaml")
    project.write("specs/demo.yaml", text.replace("sampler: adaptive, ", ""))
    assert project.read("specs/demo.yaml") != text
    project("compile", "specs/demo.yaml", *AT)
    assert document(project, "compiled/demo/plan.yaml")["spec"]["sampler"] == "adaptive"
    project("init", "fresh")
    assert "sampler" not in document(project, "specs/fresh/fresh.yaml")["spec"]["benchmark"]


def test_after_a_change_one_sample_keeps_the_campaign_or_begins_another(project):
    project("compile", "specs/demo.yaml", *AT)
    bench(project)
    before = results(project)
    project.write("specs/work.py", "print('other')\n")
    project("compile", "specs/demo.yaml", *AT)
    said = bench(project)
    assert "to measure once more with the replay runner" in said.err
    assert "then the machines" not in said.err
    after = results(project)
    assert after["sampling"] == before["sampling"]
    assert len(after["samples"]) == len(before["samples"]) + 1
    project("compile", "specs/demo.yaml", *AT)
    project("check", "specs/demo.yaml")
    assert "0 of 8 samples to measure" in bench(project).err
    assert len(results(project)["samples"]) == len(after["samples"])

    slow = "".join(f"{n},{4 * s:.5f}\n" for n, _, _, _, s in machines())
    project.write("slow.csv", f"instance_type,latency_s\n{slow}")
    project.write("specs/work.py", "print('slow')\n")
    project("compile", "specs/demo.yaml", *AT)
    assert "next: fogspec-lab replay" in bench(project, sweep="slow.csv", code=3).out
    (kept,) = results(project)["samples"]
    assert "sampling ended: " in bench(project, sweep="slow.csv").out
    assert kept in results(project)["samples"]
    project("compile", "specs/demo.yaml", *AT, code=None)
    project("check", "specs/demo.yaml")
