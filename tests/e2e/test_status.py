"""What makes what stale: each row of the language's table, through the command line."""

import json
from collections.abc import Callable

import pytest

from tests.support.running import CATALOG, Shell, measure, project, shell, spec  # noqa: F401

FRESH = {"plan": "fresh", "results": "fresh", "models": "fresh", "menu": "fresh", "manifest": "fresh"}
AT = ("--catalog", "offers.csv")


def states(shell: Shell, *words: str) -> tuple[dict[str, str], dict[str, list[str]], dict]:
    found = json.loads(shell("status", "specs/demo.yaml", *AT, "-o", "json", *words).out)[0]
    told = {stage["name"]: stage["reasons"] + stage["notes"] for stage in found["stages"]}
    return {stage["name"]: stage["state"] for stage in found["stages"]}, told, found


@pytest.fixture
def done(shell: Shell) -> Shell:
    """A project that is compiled, measured and chosen."""
    project(shell)
    measure(shell)
    shell("compile", "specs/demo.yaml", *AT)
    assert states(shell)[0] == FRESH
    return shell


def change(shell: Shell, old: str, new: str) -> None:
    before = shell.read("specs/demo.yaml")
    assert old in before
    shell.write("specs/demo.yaml", before.replace(old, new))


def test_before_and_while_measuring(shell: Shell) -> None:
    shell.write("offers.csv", CATALOG)
    shell.write("specs/demo.yaml", spec())
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
    shell("status", "specs/demo.yaml", *AT, "--exit-code", code=3)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("spec:\n", "spec: # the body\n"),
        ("$5,", "500 cent,"),
        ("1min}, setup_timeout: 1min", "60s}, setup_timeout: 60s"),
    ],
)
def test_a_comment_or_spelling_changes_nothing(done: Shell, old: str, new: str) -> None:
    change(done, old, new)
    assert states(done)[0] == FRESH
    done("status", "specs/demo.yaml", *AT, "--exit-code")
    done("compile", "specs/demo.yaml", *AT, "--check")


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [("latency: 10s", "latency: 9s", "limit: 10s -> 9s"), ("alpha: 0.5", "alpha: 0.25", "alpha: 0.5 -> 0.25")],
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
    path = "results/demo.yaml"
    from fogspec.results.schema import Results, with_checksum
    from fogspec.spec.loader import read_document
    from tests.support.files import write_yaml

    results = read_document(shell.folder / path, Results)
    samples = [one.model_copy(update={"metrics": {"length": 1.0 + i, "width": 9.0 - i}})
               for i, one in enumerate(results.spec.samples)]  # fmt: skip
    results = with_checksum(results.metadata, results.spec.model_copy(update={"samples": samples}))
    write_yaml(shell.folder / path, results.model_dump(mode="json", exclude_none=True), "a test")
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
        ("{cpus: 2..8}", "{cpus: 2..8, machines: {deny: [b.large]}}"),
    ],
)
def test_narrower_hardware_costs_nothing(done: Shell, old: str, new: str) -> None:
    change(done, old, new)
    state, told, found = states(done)
    assert (state["plan"], state["results"], state["models"], state["manifest"]) == ("stale", "fresh", "fresh", "stale")
    assert any("larger search box" in line for line in told["plan"])
    assert found["to_measure"] == 0
    done("compile", "specs/demo.yaml", *AT)
    assert states(done)[0] == FRESH
    done("compile", "specs/demo.yaml", *AT, "--check")


@pytest.mark.parametrize(
    ("old", "new", "says", "left"),
    [
        ("{cpus: 2..8}", "{cpus: 2..32}", "spec.hardware.cpus: 2..8 -> 2..32", 2),
        ("{cpus: 2..8}", "{cpus: 2..8, gpus: [none, T4]}", "spec.hardware.gpus: none -> none, T4", 1),
        ("{cpus: 2..8}", "{cpus: 2..8, spot: true}", "spec.hardware.spot: False -> True", 2),
    ],
)
def test_wider_hardware_costs_the_new_samples_only(done: Shell, old: str, new: str, says: str, left: int) -> None:
    change(done, old, new)
    state, told, found = states(done)
    assert state == {"plan": "stale", "results": "partial", "models": "fresh", "menu": "stale", "manifest": "stale"}
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
    assert f"{field} changed" in told["plan"]
    assert any(text.startswith(field) and " -> " in text for text in told["results"])
    assert found["to_measure"] == 4
    done("compile", "specs/demo.yaml", *AT)
    told = states(done)[1]
    assert any(text.startswith(field) for text in told["results"]), "also after the plan was compiled again"


def test_a_workload_that_was_locked_makes_everything_stale(shell: Shell) -> None:
    project(shell)
    shell("lock", *AT)
    shell("compile", "specs/demo.yaml")
    measure(shell)
    shell("compile", "specs/demo.yaml")
    assert states(shell)[0] == FRESH
    shell.write("specs/work.py", "print('other work')\n")
    state, told, _ = states(shell)
    assert state["plan"] == "stale"
    assert "work.py is not what the lock says" in told["plan"]
    assert "work.py" in shell("bench", "specs/demo.yaml", "--runner", "local", code=3).err
    shell("lock", "--check", code=3)
    shell("lock")
    state, told, _ = states(shell)
    assert state == dict.fromkeys(FRESH, "stale")
    assert "work.py is locked to something else" in told["results"]


def test_locking_after_measuring_keeps_the_results_and_says_so(done: Shell) -> None:
    done("lock", *AT)
    done("compile", "specs/demo.yaml")
    state, told, _ = states(done)
    assert state["results"] == "fresh"
    assert told["results"] == ["measured before anything was locked"]


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
        ("compiled/demo/manifest.yaml", lambda text: text.replace("a.small", "a.large"), "manifest"),
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
    said = done("status", *AT).out
    assert "manifest  stale" in said
    assert "spent" in said
    assert "next: fogspec compile specs/demo.yaml" in said


def test_a_refused_plan_is_a_status_too(shell: Shell) -> None:
    project(shell)
    change(shell, "budget: $5", "budget: $0.01")
    said = shell("status", *AT)
    assert "cannot be compiled: demo: the plan may cost" in said.out
    shell("status", *AT, "--exit-code", code=3)


@pytest.mark.parametrize(
    ("name", "edit", "stage"),
    [
        ("specs/demo.yaml", lambda text: text, None),
        ("specs/demo.yaml", lambda text: text.replace("alpha: 0.5", "alpha: 0.25"), "menu"),
        ("specs/demo.yaml", lambda text: text.replace("budget: $5", "budget: $4"), "plan"),
        ("specs/demo.yaml", lambda text: text.replace("setup_timeout: 1min", "setup_timeout: 2min"), "plan"),
        ("specs/demo.yaml", lambda text: text.replace("work.py]", "work.py, fast]"), "plan"),
        ("offers.csv", lambda text: text.replace("a.small,,,2,4,0.10", "a.small,,,2,4,0.15"), "plan"),
        ("compiled/demo/plan.yaml", lambda text: text + "# mine\n", "plan"),
        ("compiled/agent.pyz", lambda text: text + "# mine\n", "plan"),
        ("compiled/demo/models.yaml", lambda text: text.replace("  ", " ", 1), "models"),
        ("compiled/demo/menu.svg", lambda text: text + "<!-- mine -->\n", "menu"),
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
    done("status", *AT, "--exit-code", code=code)
    done("compile", *AT, "--check", code=code)
    done("diff", *AT, "--exit-code", code=code)
    done("verify", "compiled/demo/manifest.yaml", *AT, code=code)
    done("attest", "compiled/demo/manifest.yaml", *AT, code=code)
    applied = done("apply", "compiled/demo/manifest.yaml", *AT, "--dry-run", code=None)
    assert ("is stale or was edited" in applied.err) == (stage is not None)
    done("compile", *AT)
    unmeasured = states(done)[0]["results"] == "stale"  # the manifest stays, and stays stale, until there is another
    done("compile", *AT, "--check", code=3 if unmeasured else 0)


def test_files_beside_the_spec_count_in_every_command(shell: Shell) -> None:
    project(shell)
    shell("lock", *AT)
    shell("compile", "specs/demo.yaml")
    measure(shell)
    shell("compile", "specs/demo.yaml")
    shell.write("specs/work.py", "print('other work')\n")
    assert "work.py: not what the lock says" in shell("compile", "--check", code=3).err
    for words in (("status", "--exit-code"), ("diff", "--exit-code"), ("verify", "compiled/demo/manifest.yaml")):
        shell(*words, code=3)


HOSTS = "Cloud,InstanceType,vCPUs,MemoryGiB,Price,Region\nlocal,1cpu-1gib,1,1,0.02,\nlocal,2cpu-1gib,2,1,0.04,\n"


def test_this_computer_needs_no_budget_and_a_price_before_a_bench(shell: Shell) -> None:
    shell.write("specs/work.py", "print('work')\n")
    here = {"infra": "[local]", "hardware": "{cpus: 1..2}", "benchmark": "{stop: {requests: 20, duration: 1min}}"}
    shell.write("specs/demo.yaml", spec(**here))
    assert "1 application in 1 file valid" in shell("validate").out
    machines = "{stop: {requests: 20, duration: 1min}, machines: [local/1cpu-1gib]}"
    shell.write("specs/demo.yaml", spec(**{**here, "benchmark": machines}))
    for verb in ("compile", "status", "report"):
        ended = shell(verb, "demo", code=None)
        assert "next: fogspec lock specs/demo.yaml --catalog FILE" in ended.out + ended.err
    shell.write("hosts.csv", HOSTS)
    shell.write("specs/demo.yaml", spec(**here))
    compiled = shell("compile", "demo", "--catalog", "hosts.csv").out
    assert "2 samples on this host, free, at most 2 min of measuring" in compiled
    priced = shell("status", "demo", "--catalog", "hosts.csv").out
    assert "next: fogspec bench specs/demo.yaml --runner local --catalog hosts.csv" in priced


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
    (done.folder / "results/demo.yaml").unlink()
    measure(done, only=3)
    done("compile", "specs/demo.yaml", *AT, "--partial")
    measure(done)
    said = done("status", "specs/demo.yaml", *AT).out
    assert "spec.observations: changed" in said
    for one in said.splitlines():
        before, arrow, after = one.partition(" -> ")
        assert not arrow or not before.endswith(f": {after}")


def test_check_counts_the_files_that_compile_writes_not_those_that_stay(done: Shell) -> None:
    change(done, "work.py", "./work.py")
    said = done("compile", "specs/demo.yaml", *AT, "--check", code=3).err
    named = [one.strip() for one in said.splitlines() if one.startswith("  compiled/") and " " not in one.strip()]
    assert said.startswith(f"error: {len(named)} files would change")
    before = {name: done.read(name) for name in named}
    done("compile", "specs/demo.yaml", *AT)
    assert all(done.read(name) != text for name, text in before.items())
    assert "is stale: it stays until there is a new one" in said
    assert "cannot be written again yet" in done("compile", "specs/demo.yaml", *AT, "--check", code=3).err


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
    shell("bench", "demo", "--runner", "replay", "--from", "sweep.csv", "--catalog", "hosts.csv", "--yes")
    assert shell.read("results/demo.yaml").count("state: ok") <= 30
