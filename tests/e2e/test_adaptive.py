"""`sampler: adaptive` as a user runs it: compile, bench in batches on a replayed sweep, compile again."""

import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from tests.support.running import Ended, Shell, shell, spec  # noqa: F401
from tests.support.scenes import until

SIZES = {"small": 2, "medium": 4, "large": 8, "xlarge": 16, "huge": 32, "giant": 64}
FAMILIES = {"a": (2, 0.05), "b": (4, 0.06), "c": (8, 0.08)}
ADAPTIVE = "{sampler: adaptive, budget: $5, stop: {requests: 20, duration: 1min}, setup_timeout: 1min}"
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
    return shell("bench", "specs/demo.yaml", "--runner", "replay", "--from", sweep, *AT, *words, code=code)


def results(shell: Shell) -> dict:
    return document(shell, "results/demo.yaml")["spec"]


def usd(text: str) -> float:
    return float(text.removeprefix("$"))


def test_few_samples_a_good_choice_and_everything_fresh(project):
    assert "never beyond the budget of $5.00" in project("compile", "specs/demo.yaml", *AT).out
    first = document(project, "compiled/demo/plan.yaml")["spec"]
    assert (first["sampler"], len(first["samples"])) == ("adaptive", 3)
    project("compile", "specs/demo.yaml", *AT, "--check")
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
    project("compile", "specs/demo.yaml", *AT, "--check")
    project("status", "specs/demo.yaml", *AT, "--exit-code")
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
        assert f"--decided-above {above_s:g} --statistic mean" in task["run"]


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
    said = project("explain", "specs/demo.yaml", *AT).out
    assert "servers of one type on aws differ by more than 5% with probability 0.07" in said
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
    before = project.read("results/demo.yaml")
    assert "0 of" in bench(project).err
    assert project.read("results/demo.yaml") == before
    (project.folder / "results/demo.yaml").unlink()
    (project.folder / ".fogspec/demo/journal.jsonl").unlink()
    project("compile", "specs/demo.yaml", *AT)
    bench(project)
    assert project.read("results/demo.yaml") == before


def test_other_limits_cost_nothing_until_bench_is_asked(project):
    project("compile", "specs/demo.yaml", *AT)
    bench(project)
    measured = len(results(project)["samples"])
    write_spec(project, constraints="{latency: 2s}", objective="{alpha: 1}")
    project("compile", "specs/demo.yaml", *AT)
    project("status", "specs/demo.yaml", *AT, "--exit-code")
    assert len(results(project)["samples"]) == measured
    bench(project)
    assert len(results(project)["samples"]) >= measured
    project("compile", "specs/demo.yaml", *AT)
    project("compile", "specs/demo.yaml", *AT, "--check")


def test_a_larger_box_is_partial_and_a_smaller_one_fresh(project):
    write_spec(project, hardware="{cpus: 2..16}")
    project("compile", "specs/demo.yaml", *AT)
    bench(project)
    project("compile", "specs/demo.yaml", *AT)
    before = project.read("results/demo.yaml")
    write_spec(project, hardware="{cpus: 2..8}")
    project("compile", "specs/demo.yaml", *AT)
    project("status", "specs/demo.yaml", *AT, "--exit-code")
    assert project.read("results/demo.yaml") == before
    write_spec(project, hardware="{cpus: 2..64}")
    project("compile", "specs/demo.yaml", *AT, code=7)
    assert "the candidates have changed" in project("status", "specs/demo.yaml", *AT).out
    bench(project)
    project("compile", "specs/demo.yaml", *AT)
    project("status", "specs/demo.yaml", *AT, "--exit-code")


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


def test_machines_that_are_not_to_be_had_give_their_place_to_others(project):
    project("compile", "specs/demo.yaml", *AT)
    plan = document(project, "compiled/demo/plan.yaml")["spec"]
    gone = plan["samples"][0]["machine"]["instance"]
    other = next(one for one in plan["substitutes"] if one["substitute_for"] == plan["samples"][0]["id"])
    sweep = "".join(line for line in project.read("sweep.csv").splitlines(True) if not line.startswith(f"{gone},"))
    project.write("short.csv", sweep)
    said = bench(project, sweep="short.csv")
    records = {one["id"]: one for one in results(project)["samples"]}
    failed = records[plan["samples"][0]["id"]]
    assert (failed["state"], failed["reason"]) == ("failed", "capacity")
    took = next(one for one in records.values() if one.get("substitute_for") == failed["id"])
    assert took["machine"]["instance"] == other["machine"]["instance"]
    assert f"{took['id']} takes its place" in said.err + said.out
    assert list(records)[1] == took["id"], "beside the sample whose place it took"
    project("compile", "specs/demo.yaml", *AT)
    assert (project.folder / f"compiled/demo/tasks/{took['id']}.sky.yaml").is_file()
    project("compile", "specs/demo.yaml", *AT, "--check")
    project("status", "specs/demo.yaml", *AT, "--exit-code")
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
    assert not Path(project.folder / "results/demo.yaml").exists()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_stopped_in_the_middle_of_a_wave_it_goes_on_to_the_same_end(project, number):
    project("compile", "specs/demo.yaml", *AT)
    bench(project)
    expected = project.read("results/demo.yaml")
    (project.folder / "results/demo.yaml").unlink()
    (project.folder / ".fogspec/demo/journal.jsonl").unlink()
    project("compile", "specs/demo.yaml", *AT)
    words = ["bench", "specs/demo.yaml", "--from", "sweep.csv", *AT, "--pace", "0.02"]
    running = subprocess.Popen([sys.executable, "-m", "fogspec", *words], cwd=project.folder, stderr=subprocess.DEVNULL)
    until(lambda: "- {id: " in (project.read("results/demo.yaml").partition("\n  samples:")[2]
                                if (project.folder / "results/demo.yaml").exists() else ""))  # fmt: skip
    running.send_signal(number)
    assert running.wait(timeout=240) == (130 if number == signal.SIGINT else -number)
    assert "stop_reason" not in results(project)["sampling"]
    bench(project)
    assert project.read("results/demo.yaml") == expected


def test_machines_are_asked_for_among_those_of_the_plans_own_catalog(project):
    project("compile", "specs/demo.yaml", *AT)
    project.write("offers.csv", project.read("offers.csv").replace("a.huge", "a.vast"))
    assert "compiled from another catalog" in bench(project, code=3).err
    assert not Path(project.folder / "results/demo.yaml").exists()


def test_asking_is_said_only_where_the_model_will_be_asked(project):
    project("compile", "specs/demo.yaml", *AT)
    assert "then the machines that the model selects" in bench(project).err
    assert "then the machines" not in bench(project).err


def test_what_a_library_knows_of_machines_is_used_from_the_first_wave_on(project):
    """A library of three workloads on these machines, locked: as good a choice, and what was locked is what is used."""
    rows = "".join(f"aws,{n},{c},{m},{p}\n" for n, c, m, p, _ in machines())
    project.write("data/machines.csv", "Cloud,InstanceType,vCPUs,MemoryGiB,Price\n" + rows)
    cells = [f"{w},other,aws,{n},{s * k:.4f}\n" for w, k in (("x", 0.3), ("y", 2), ("z", 7)) for n, *_, s in machines()]
    project.write("data/latencies.csv", "workload,suite,cloud,instance_type,latency_s\n" + "".join(cells))
    project("lock", "specs/demo.yaml", *AT, "--priors", "data")
    project("compile", "specs/demo.yaml")
    shell_words = ("bench", "specs/demo.yaml", "--runner", "replay", "--from", "sweep.csv")
    project(*shell_words)
    project("compile", "specs/demo.yaml")
    project("compile", "specs/demo.yaml", "--check")
    assert objective(document(project, "compiled/demo/manifest.yaml")["spec"]["instance"]) <= 1.05 * best()
    assert len(results(project)["samples"]) <= 9


def with_(*more: str) -> str:
    """The usual benchmark with more fields."""
    return ADAPTIVE.replace("{", "{" + "".join(f"{one}, " for one in more), 1)


def volume(requests: int, months: int = 6) -> str:
    return f"volume: {{requests_per_month: {requests}, months: {months}}}"


def test_a_larger_volume_pays_for_more_samples_and_a_tiny_one_for_a_single_one(project):
    counts = {}
    for requests in (1, 2_000, 100_000_000):
        write_spec(project, benchmark=with_(volume(requests)))
        project("compile", "specs/demo.yaml", *AT)
        bench(project)
        counts[requests] = len(results(project)["samples"])
        ended = results(project)["sampling"]["stop_reason"]
        assert f"save its price on {6 * requests:,} requests" in ended or "every machine was measured" in ended
        (project.folder / "results/demo.yaml").unlink()
        (project.folder / ".fogspec/demo/journal.jsonl").unlink()
    assert counts[1] == 1
    assert counts[1] < counts[2_000] < counts[100_000_000]


def test_the_plan_says_what_the_benchmark_spends_and_saves(project):
    write_spec(project, benchmark=with_(volume(1_000_000)))
    said = project("compile", "specs/demo.yaml", *AT).out
    assert re.search(r"worth +spends \$[0-9.]+ to save an expected \$[0-9,]+ over 6 months of 1,000,000 requests", said)
    dry = bench(project, "--dry-run").out
    assert re.search(r"  spends \$[0-9.]+ to save an expected", dry)
    told = json.loads(project("compile", "specs/demo.yaml", *AT, "-o", "json").out)[0]["payoff_usd"]
    assert 0 < told["spends"] < told["saves"]
    bench(project)
    assert "to save an expected" not in project("compile", "specs/demo.yaml", *AT).out
    assert "which saves $" in project("explain", "specs/demo.yaml", *AT).out
    assert json.loads(project("explain", "specs/demo.yaml", *AT, "-o", "json").out)[0]["next_sample"]["saves_usd"] >= 0


def test_more_volume_takes_sampling_up_again_and_the_first_samples_are_kept(project):
    write_spec(project, benchmark=with_(volume(1)))
    project("compile", "specs/demo.yaml", *AT)
    bench(project)
    before = [one["id"] for one in results(project)["samples"]]
    write_spec(project, benchmark=with_(volume(100_000_000)))
    project("compile", "specs/demo.yaml", *AT)
    bench(project)
    after = [one["id"] for one in results(project)["samples"]]
    assert after[: len(before)] == before
    assert len(after) > len(before)


@pytest.mark.parametrize(("wall_time", "batches"), [("2min", 1), ("4min", 2), ("10min", 5), ("2h", 60)])
def test_the_wall_time_decides_how_many_are_measured_at_once(project, wall_time, batches):
    """A sample takes two minutes at most."""
    write_spec(project, benchmark=with_(f"wall_time: {wall_time}"))
    project("compile", "specs/demo.yaml", *AT)
    bench(project)
    sampling = results(project)["sampling"]
    sizes = [len(one["samples"]) for one in sampling["batches"]]
    assert len(sizes) <= batches
    if batches > 5:
        assert set(sizes[1:]) == {1}
    else:
        assert max(sizes[1:], default=9) > 1 or sum(sizes) >= 8
        assert ("wall time" in sampling["stop_reason"]) == (len(sizes) == batches)


def test_a_spec_that_names_no_sampler_samples_adaptively_as_does_a_new_one(project):
    text = project.read("specs/demo.yaml")
    project.write("specs/demo.yaml", text.replace("sampler: adaptive, ", ""))
    assert project.read("specs/demo.yaml") != text
    project("compile", "specs/demo.yaml", *AT)
    assert document(project, "compiled/demo/plan.yaml")["spec"]["sampler"] == "adaptive"
    project("init", "fresh")
    assert document(project, "specs/fresh.yaml")["spec"]["benchmark"]["sampler"] == "adaptive"
