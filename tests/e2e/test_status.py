"""What makes what stale: each row of the language's table, through the command line."""

import json
from collections.abc import Callable

import pytest

from fogspec.results.io import read_results_folder
from fogspec_lab import cli as lab
from tests.support import results as measured_files
from tests.support.results import write
from tests.support.running import CATALOG, Shell, chosen, measure, project, shell, spec  # noqa: F401

FRESH = {"plan": "fresh", "results": "fresh", "models": "fresh", "menu": "fresh", "manifest": "fresh"}
AT = ("--catalog", "offers.csv")


def states(shell: Shell, *words: str) -> tuple[dict[str, str], dict[str, list[str]], dict]:
    found = json.loads(shell("status", "specs/demo.yaml", "-o", "json", *words).out)[0]
    told = {stage["name"]: stage["reasons"] + stage["notes"] for stage in found["stages"]}
    return {stage["name"]: stage["state"] for stage in found["stages"]}, told, found


@pytest.fixture
def done(shell: Shell) -> Shell:
    """A project that is compiled, measured and chosen."""
    chosen(shell)
    assert states(shell)[0] == FRESH
    return shell


def change(shell: Shell, old: str, new: str) -> None:
    before = shell.read("specs/demo.yaml")
    assert old in before
    shell.write("specs/demo.yaml", before.replace(old, new))


def test_before_and_while_measuring(shell: Shell) -> None:
    shell.write("offers.csv", CATALOG)
    shell.write("specs/work.py", "print('work')\n")
    shell.write("specs/demo.yaml", spec())
    shell("lock", *AT)
    assert states(shell)[0] == {"plan": "missing", "results": "missing", "models": "missing", "menu": "missing",
                                "manifest": "missing"}  # fmt: skip
    project(shell)
    assert states(shell)[0]["plan"] == "fresh"
    measure(shell, only=2)
    state, told, found = states(shell)
    assert state["results"] == "partial"
    assert "2 of 4 planned samples are measured; to measure: aws-" in told["results"][0]
    assert found["to_measure"] == 2
    assert found["spent_usd"] > 0
    shell("check", "specs/demo.yaml", code=3)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("spec:\n", "spec: # the body\n"),
        ("$5,", "500 cent,"),
        ("1min}, ready_timeout: 1min", "60s}, ready_timeout: 60s"),
    ],
)
def test_a_comment_or_spelling_changes_nothing(done: Shell, old: str, new: str) -> None:
    change(done, old, new)
    assert states(done)[0] == FRESH
    done("check", "specs/demo.yaml")


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("latency: 10s", "latency: 9s", "spec.constraints.latency: 10s -> 9s"),
        ("alpha: 0.5", "alpha: 0.25", "spec.objective.alpha: 0.5 -> 0.25"),
    ],
)
def test_constraints_and_alpha_make_the_choice_stale(done: Shell, old: str, new: str, says: str) -> None:
    change(done, old, new)
    state, told, found = states(done)
    assert state == FRESH | {"menu": "stale", "manifest": "stale"}
    assert any(says in line for line in told["manifest"])
    assert found["to_measure"] == 0


def test_another_metric_that_was_measured_makes_models_stale(shell: Shell) -> None:
    project(shell, metrics="{length: {callback: length}, width: {callback: width}}", objective="{metric: length}")
    measure(shell)
    path = "results/demo"
    from fogspec.results.schema import results_of

    results = read_results_folder(shell.folder / path)
    samples = [one.model_copy(update={"metrics": {"length": 1.0 + i, "width": 9.0 - i}})
               for i, one in enumerate(results.spec.samples)]  # fmt: skip
    results = results_of(results.spec.model_copy(update={"samples": samples}))
    write(shell.folder / path, results.spec)
    shell("compile", "specs/demo.yaml", *AT)
    assert states(shell)[0] == FRESH
    change(shell, "metric: length", "metric: width")
    state, _, found = states(shell)
    assert (state["plan"], state["results"], state["models"], state["manifest"]) == ("fresh", "fresh", "stale", "stale")
    assert found["to_measure"] == 0


def test_a_new_catalog_with_the_same_costs_is_not_called_another_estimate(done: Shell) -> None:
    done.write("offers.csv", CATALOG.replace("0.10,0.03", "0.10,0.04"))
    _, told, _ = states(done)
    assert told["plan"] == ["new catalog; the costs of measuring stay"]


def test_new_prices_re_estimate_the_plan_and_make_the_choice_stale(done: Shell) -> None:
    done.write("offers.csv", CATALOG.replace("a.small,,,2,4,0.10", "a.small,,,2,4,0.15"))
    state, told, found = states(done)
    assert (state["plan"], state["results"], state["models"], state["manifest"]) == ("stale", "fresh", "fresh", "stale")
    assert any("re-estimated" in line for line in told["plan"])
    assert found["to_measure"] == 0
    done("compile", "specs/demo.yaml", *AT)
    assert states(done)[0] == FRESH
    assert "$0.15/h" in done.read("compiled/demo/plan.yaml")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("{cpus: 2..8}", "{cpus: 2..8, memory: 8GiB..16GiB}"),
        ("{cpus: 2..8}", "{cpus: 2..8, deny: [b.large]}"),
    ],
)
def test_narrower_hardware_costs_nothing(done: Shell, old: str, new: str) -> None:
    change(done, old, new)
    state, _, found = states(done)
    assert (state["plan"], state["results"], state["models"], state["manifest"]) == ("fresh", "fresh", "fresh", "stale")
    assert found["to_measure"] == 0
    done("compile", "specs/demo.yaml", *AT)
    assert states(done)[0] == FRESH
    done("check", "specs/demo.yaml")


@pytest.mark.parametrize(
    ("old", "new", "says", "left", "models"),
    [
        ("{cpus: 2..8}", "{cpus: 2..32}", "spec.hardware.cpus: 2..8 -> 2..32", 2, "stale"),
        ("{cpus: 2..8}", "{cpus: 2..8, gpus: [none, T4]}", "spec.hardware.gpus: none -> none, T4", 1, "stale"),
        ("{cpus: 2..8}", "{cpus: 2..8, spot: true}", "spec.hardware.spot: False -> True", 2, "fresh"),
    ],
)
def test_wider_hardware_costs_the_new_samples_only(
    done: Shell, old: str, new: str, says: str, left: int, models: str
) -> None:
    change(done, old, new)
    state, told, found = states(done)
    assert state == {"plan": "stale", "results": "partial", "models": models, "menu": "stale", "manifest": "stale"}
    assert says in told["plan"]
    assert found["to_measure"] == left
    done("compile", "specs/demo.yaml", *AT, code=7)
    state, _, found = states(done)
    assert (state["plan"], state["results"], found["to_measure"]) == ("fresh", "partial", left)


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("work.py]", "work.py, fast]", "spec.cloud"),
        ("{callback: plan}", "{callback: other}", "spec.probe"),
        ("{budget: $5", "{warmup: 3, budget: $5", "spec.benchmark.warmup"),
        ("{budget: $5", "{workload: {node: {cmd: [./client]}}, budget: $5", "spec.benchmark.workload"),
        ("  probe:", "  ros: {distro: humble}\n  probe:", "spec.ros"),
    ],
)
def test_what_is_measured_makes_everything_stale(done: Shell, old: str, new: str, field: str) -> None:
    change(done, old, new)
    done.write("specs/client", "#!/bin/sh\n")
    state, told, found = states(done)
    assert state == dict.fromkeys(FRESH, "stale")
    for stage in ("plan", "results"):
        assert any(text.startswith(field) and " -> " in text for text in told[stage])
    assert found["to_measure"] == 4
    done("compile", "specs/demo.yaml", *AT)
    told = states(done)[1]
    assert any(text.startswith(field) for text in told["results"]), "also after the plan was compiled again"


def test_a_workload_that_changed_makes_everything_stale_also_without_a_lock(done: Shell) -> None:
    work = done.read("specs/work.py")
    done.write("specs/work.py", "print('other work')\n")
    state, told, _ = states(done)
    assert state == dict.fromkeys(FRESH, "stale")
    assert told["plan"] == ["work.py changed"]
    assert told["results"] == ["work.py changed"]
    assert "work.py changed since it was compiled" in done("bench", "demo", "--runner", "local", code=3).err
    done.write("specs/work.py", work)
    assert states(done)[0] == FRESH


def test_locking_after_measuring_keeps_the_results(done: Shell) -> None:
    done("lock", *AT)
    done("compile", "specs/demo.yaml")
    assert states(done)[0] == FRESH


def test_a_budget_is_checked_again(done: Shell) -> None:
    change(done, "budget: $5", "budget: $4")
    state, told, _ = states(done)
    assert state == FRESH | {"plan": "stale"}, "the plan names its budget, and nothing follows from it"
    assert told["plan"] == ["spec.benchmark.budget changed, and is enough"]
    change(done, "budget: $4", "budget: $0.01")
    assert states(done)[0] == FRESH | {"plan": "stale"}, "what is measured already needs no budget"


@pytest.mark.parametrize(
    ("name", "edit", "stage"),
    [
        ("compiled/demo/manifest.yaml", lambda text: text.replace("a.large", "a.small"), "manifest"),
        ("compiled/demo/models.yaml", lambda text: text + "\n", "models"),
        ("compiled/demo/tasks/aws-r1-a-small.sky.yaml", lambda text: text + "# mine\n", "plan"),
        ("compiled/demo/plan.yaml", lambda text: text.replace("samples:", "sample:"), "plan"),
    ],
)
def test_an_edited_file_is_noticed(done: Shell, name: str, edit: Callable[[str], str], stage: str) -> None:
    done.write(name, edit(done.read(name)))
    state, told, _ = states(done)
    assert state == FRESH | {stage: "stale"}
    assert told[stage]


def test_words_for_people(done: Shell) -> None:
    change(done, "alpha: 0.5", "alpha: 0.25")
    said = done("status").out
    assert "manifest  stale" in said
    assert "spent" in said
    assert "next: fogspec compile specs/demo.yaml" in said


def test_a_refused_plan_is_a_status_too(shell: Shell) -> None:
    project(shell)
    change(shell, "budget: $5", "budget: $0.01")
    said = shell("status")
    assert "cannot be compiled: demo: the plan may cost" in said.out
    shell("check", code=3)


@pytest.mark.parametrize(
    ("name", "edit", "stage"),
    [
        ("specs/demo.yaml", lambda text: text, None),
        ("specs/demo.yaml", lambda text: text.replace("alpha: 0.5", "alpha: 0.25"), "menu"),
        ("specs/demo.yaml", lambda text: text.replace("budget: $5", "budget: $4"), "plan"),
        ("specs/demo.yaml", lambda text: text.replace("ready_timeout: 1min", "ready_timeout: 2min"), "plan"),
        ("specs/demo.yaml", lambda text: text.replace("work.py]", "work.py, fast]"), "plan"),
        ("offers.csv", lambda text: text.replace("a.small,,,2,4,0.10", "a.small,,,2,4,0.15"), "plan"),
        ("compiled/demo/plan.yaml", lambda text: text + "# mine\n", "plan"),
        ("compiled/agent.pyz", lambda text: text + "# mine\n", "plan"),
        ("compiled/demo/models.yaml", lambda text: text.replace("  ", " ", 1), "models"),
        ("compiled/demo/deploy.sky.yaml", lambda text: text + "# mine\n", "manifest"),
        ("compiled/demo/deploy.fallback-1.sky.yaml", lambda text: "# Generated by fogspec: left over\n", "manifest"),
    ],
)
def test_every_command_has_the_same_freshness(
    done: Shell, name: str, edit: Callable[[str], str], stage: str | None
) -> None:
    path = done.folder / name
    before = path.read_bytes().decode("latin-1") if path.exists() else ""
    path.write_bytes(edit(before).encode("latin-1"))  # the agent is not text
    code = 0 if stage is None else 3
    state, told, _ = states(done)
    assert stage is None or state[stage] == "stale", state
    assert stage is None or told[stage], "a stale stage says why"
    assert ("stale" in state.values()) == (stage is not None)
    done("check", code=code)
    done.judged("diff", code=code)
    applied = done("apply", "compiled/demo/manifest.yaml", "--dry-run", code=None)
    assert ("is stale or was edited" in applied.err) == (stage is not None)
    done("compile", *AT)
    unmeasured = states(done)[0]["results"] == "stale"  # the manifest stays, and stays stale, until there is another
    done("check", code=3 if unmeasured else 0)


def test_files_beside_the_spec_count_in_every_command(shell: Shell) -> None:
    project(shell)
    shell("lock", *AT)
    shell("compile", "specs/demo.yaml")
    measure(shell)
    shell("compile", "specs/demo.yaml")
    shell.write("specs/work.py", "print('other work')\n")
    for words in (("diff",), ("check",)):
        shell.judged(*words, code=3)


HOSTS = "Cloud,InstanceType,vCPUs,MemoryGiB,Price,Region\nlocal,1cpu-1gib,1,1,0.02,\nlocal,2cpu-1gib,2,1,0.04,\n"


def test_this_computer_needs_neither_budget_nor_price_before_a_bench(shell: Shell) -> None:
    shell.write("specs/work.py", "print('work')\n")
    here = {"infra": "[local]", "hardware": "{cpus: 1..2}", "benchmark": "{stop: {requests: 20, duration: 1min}}"}
    shell.write("specs/demo.yaml", spec(**here))
    assert "1 application in 1 file valid" in shell("validate").out
    machines = "{stop: {requests: 20, duration: 1min}, machines: [local/1cpu-1gib]}"
    shell.write("specs/demo.yaml", spec(**{**here, "benchmark": machines}))
    for verb in ("compile", "status", "report"):
        ended = shell(verb, "demo", code=None)
        assert "fogspec bench specs/demo.yaml" in ended.out + ended.err
    shell.write("hosts.csv", HOSTS)
    shell.write("specs/demo.yaml", spec(**here))
    compiled = shell("compile", "demo", "--catalog", "hosts.csv").out
    assert "2 samples on this host, free, at most 2 min of measuring" in compiled
    priced = shell("status", "demo").out
    assert "next: fogspec bench specs/demo.yaml --runner local\n" in priced


@pytest.mark.parametrize(("load", "warned"), [(9.0, True), (0.1, False)])
def test_a_bench_on_this_computer_warns_when_it_is_busy(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, load: float, warned: bool
) -> None:
    monkeypatch.setattr("os.getloadavg", lambda: (load, load, load))
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    shell.write("specs/work.py", "print('work')\n")
    shell.write(
        "specs/demo.yaml", spec(benchmark="{stop: {requests: 20, duration: 1min}, machines: [local/1cpu-1gib]}")
    )
    shell("compile", "demo", code=None)
    said = shell("bench", "demo", "--runner", "local", "--dry-run").err
    assert ("warning: load 9.0 on 2 CPUs: these are figures of a busy host" in said) is warned


def test_a_change_where_values_are_cut_is_not_shown_as_two_equal_texts(done: Shell) -> None:
    before, key, after = done.read("compiled/demo/models.yaml").rpartition("values: {latency: ")
    done.write("compiled/demo/models.yaml", f"{before}{key}9{after}")
    said = done("status", "specs/demo.yaml").out
    assert "spec.samples: changed" in said
    for one in said.splitlines():
        before, arrow, after = one.partition(" -> ")
        assert not arrow or not before.endswith(f": {after}")


def test_a_manifest_that_stays_is_stale_until_it_is_measured_again(done: Shell) -> None:
    change(done, "work.py", "./work.py")
    said = done("check", "specs/demo.yaml", code=3).out
    assert said.count("spec.cloud[0].cmd: ") == 1, said
    again = "fogspec compile specs/demo.yaml"
    assert f"fix: {again} && fogspec bench specs/demo.yaml && {again}\n" in said
    done("compile", "specs/demo.yaml", *AT)
    said = done("check", "specs/demo.yaml", code=3).out
    assert "results are stale" in said
    assert "fix: fogspec bench specs/demo.yaml" in said


def test_sampling_on_this_computer_ends(shell: Shell) -> None:
    shell.write("specs/work.py", "print('work')\n")
    shell.write("hosts.csv", HOSTS)
    shell.write("sweep.csv", "instance_type,latency_s\n1cpu-1gib,2.0\n2cpu-1gib,1.0\n")
    here = {
        "infra": "[local]",
        "hardware": "{cpus: 1..2}",
        "benchmark": "{stop: {requests: 20, duration: 1min}, sampler: adaptive}",
    }
    shell.write("specs/demo.yaml", spec(**here))
    shell("compile", "demo", "--catalog", "hosts.csv")
    shell("replay", "demo", "--from", "sweep.csv", "--yes", run=lab.main)
    assert measured_files.text(shell.folder / "results/demo").count("state: ok") <= 30


def test_several_applications_have_a_line_each(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    project(shell)
    (shell.folder / "specs/other").mkdir()
    shell.write("specs/other/work.py", shell.read("specs/work.py"))
    shell.write("specs/other/other.yaml", shell.read("specs/demo.yaml").replace("name: demo", "name: other"))
    shell.write("specs/demo.yaml", shell.read("specs/demo.yaml").replace("spec:\n", "spec:\n  files: [work.py]\n", 1))
    shell("compile", *AT)
    measure(shell)
    shell("compile", "demo")
    for columns in ("80", "40"):
        monkeypatch.setenv("COLUMNS", columns)
        said = shell("status").out.splitlines()
        assert [line.split()[0] for line in said if line[:1] != " "] == ["application", "demo", "other", "next:"]
        assert "fresh" in said[1]
        assert "not" in said[2]
        assert all(len(line) <= int(columns) for line in said[:-1])
    assert "\n  results   missing  results/other\n" in shell("status", "-v").out
    assert "\n  results   missing  results/other\n" in shell("status", "other").out
