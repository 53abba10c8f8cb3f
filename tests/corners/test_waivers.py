"""Measurements survive changes that the spec waives, and only these, for every verb alike."""

import json
import re
from collections.abc import Callable

import pytest
from ruamel.yaml import YAML

from fogspec.base import digest
from fogspec.results.io import read_results_folder
from fogspec_lab import cli as lab
from tests.e2e.test_check import AT, MANIFEST, VERBS, codes, git
from tests.support import results as measured_files
from tests.support.running import Shell, copied, measure, project, shell  # noqa: F401

NODE = (
    '[{cmd: [python3, work.py], env: {LOG: info, "a.b": one}}, '
    "{package: p, executable: e, parameters: {rate: 10, gains: [1.5, 2.5]}}]"
)


def committed(shell: Shell, files: dict[str, str]) -> None:
    """A committed application that is locked, measured, compiled, and has environment, parameters and these files."""

    def fill(made: Shell) -> None:
        for name, text in files.items():
            made.write(name, text)
        project(made, cloud=NODE, ros="{distro: humble}")
        made("lock", *AT)
        made("compile", *AT)
        measure(made)
        made("compile", *AT)
        git(made, "init", "-q")
        git(made, "add", "-A")
        git(made, "commit", "-qm", "all")

    copied(shell, f"a repository whose nodes have parameters {files}", fill)


@pytest.fixture
def measured(shell: Shell) -> Shell:
    """That application."""
    committed(shell, {})
    return shell


def change(shell: Shell, old: str, new: str) -> None:
    before = shell.read("specs/demo.yaml")
    assert old in before
    shell.write("specs/demo.yaml", before.replace(old, new))


def state(shell: Shell) -> dict:
    found: dict = json.loads(shell("status", "-o", "json").out)[0]
    return found | {stage["name"]: stage for stage in found["stages"]}


def pasted(shell: Shell, reason: str = "it only prints more") -> None:
    """What status prints, pasted into the spec by its user, with the reason."""
    said = shell("status").out
    block = said[said.index("    spec:\n      benchmark:\n") :]
    block = block[: block.index("\n  spent")].replace('reason: ""', f"reason: {reason}")
    waivers = YAML(typ="safe", pure=True).load(block)["spec"]["benchmark"]["waivers"]
    text = shell.read("specs/demo.yaml")
    before = re.search(r", waivers: \[(.*)\]\}$", text, re.MULTILINE)
    if before:
        text = text.replace(before[0], "}")
        waivers = [*json.loads(f"[{before[1]}]"), *waivers]
    shell.write("specs/demo.yaml", text.replace("sampler: grid}", f"sampler: grid, waivers: {json.dumps(waivers)}}}"))


def several(shell: Shell) -> None:
    change(shell, "LOG: info", "LOG: debug")
    change(shell, "rate: 10", "rate: 11")
    shell.write("specs/work.py", "# nothing\n")


CHANGES: dict[str, Callable[[Shell], object]] = {
    "an environment variable": lambda shell: change(shell, "LOG: info", "LOG: debug"),
    "one more variable": lambda shell: change(shell, "{LOG: info", "{MORE: 'yes', LOG: info"),
    "one variable less": lambda shell: change(shell, '"a.b": one', ""),
    "a name with a dot": lambda shell: change(shell, '"a.b": one', '"a.b": two'),
    "a parameter": lambda shell: change(shell, "rate: 10", "rate: 11"),
    "an item of a list": lambda shell: change(shell, "[1.5, 2.5]", "[1.5, 3.5]"),
    "a longer list": lambda shell: change(shell, "[1.5, 2.5]", "[1.5, 2.5, 3.5]"),
    "a word of a command": lambda shell: change(shell, "work.py]", "./work.py]"),
    "a prefix": lambda shell: change(shell, "{package: p", "{package: p, launch: {prefix: nice}"),
    "a secret": lambda shell: change(shell, "  infra:", "  secrets: [TOKEN]\n  infra:"),
    "a comment in a script": lambda shell: shell.write("specs/work.py", "print('work')  # works\n"),
    "a new file": lambda shell: shell.write("specs/notes.md", "more\n"),
    "a file less": lambda shell: (shell.folder / "specs/work.txt").unlink(),
    "several": lambda shell: several(shell),
}


@pytest.mark.parametrize("what", CHANGES)
def test_what_status_prints_is_pasted_and_the_results_count_for_every_verb(shell: Shell, what: str) -> None:
    shell.monkeypatch.setenv("TOKEN", "x")  # apply --dry-run requires it
    committed(shell, {"specs/work.txt": "text\n"})
    CHANGES[what](shell)
    shell("lock", *AT)
    shell("compile", *AT)
    assert state(shell)["results"]["state"] == "stale"
    assert all(code for code in codes(shell).values())
    assert "to keep the results, if these changes cannot affect them" in shell("compile", *AT).out
    pasted(shell)
    shell("compile", *AT)
    assert codes(shell) == dict.fromkeys(VERBS, 0)
    found = state(shell)
    assert (found["results"]["state"], found["to_measure"], found["waivers"]) == ("fresh", 0, [])
    assert any("waived: " in text and "it only prints more" in text for text in found["results"]["notes"])
    carried = YAML(typ="safe", pure=True).load(shell.read(MANIFEST))["evidence"]["carried"]
    assert [len(one["samples"]) for one in carried] == [4]
    assert carried[0]["waivers"][0]["reason"] == "it only prints more"
    if what != "several":
        return
    for words in (("menu", "demo"), ("explain", "demo"), ("diff", "--since", "HEAD", "--markdown")):
        assert "4 of 4 samples measured before changes that the spec waives: " in " ".join(shell(*words).out.split())
    shell("report", "demo")
    assert "changes that the spec waives" in shell.read("compiled/demo/report.html")


def test_a_waiver_covers_no_later_change_and_none_beside_it(measured: Shell) -> None:
    change(measured, "LOG: info", "LOG: debug")
    pasted(measured)
    measured("compile", *AT)
    assert state(measured)["results"]["state"] == "fresh"
    change(measured, "{LOG: debug", "{LOG: trace")
    found = state(measured)
    assert found["results"]["state"] == "stale"
    assert found["results"]["reasons"] == ["spec.cloud[0].env.LOG: info -> trace"]
    change(measured, "{LOG: trace", "{LOG: debug")
    change(measured, "rate: 10", "rate: 11")
    found = state(measured)
    assert found["results"]["reasons"] == ["spec.cloud[1].parameters.rate: 10 -> 11"]
    assert [one["change"] for one in found["waivers"]] == ["spec.cloud[1].parameters.rate"]
    pasted(measured)
    measured("compile", *AT)
    assert codes(measured) == dict.fromkeys(VERBS, 0), "two waivers, one after the other"
    measured("lock", *AT)
    measured.write("specs/work.py", "print('other')\n")
    assert all(codes(measured).values())


def test_waivers_follow_one_another(measured: Shell) -> None:
    for old, new in (("info", "debug"), ("debug", "trace")):
        change(measured, f"{{LOG: {old}", f"{{LOG: {new}")
        waiver = json.dumps({"change": "spec.cloud[0].env.LOG", "old": old, "new": new, "reason": "log"})
        text = measured.read("specs/demo.yaml")
        measured.write(
            "specs/demo.yaml",
            text.replace("waivers: [", f"waivers: [{waiver}, ")
            if "waivers" in text
            else text.replace("sampler: grid}", f"sampler: grid, waivers: [{waiver}]}}"),
        )
    assert state(measured)["results"]["state"] == "fresh"
    change(measured, "{LOG: trace", "{LOG: info")
    found = state(measured)["results"]
    assert found["state"] == "fresh"
    assert [text for text in found["notes"] if "is not needed any more" in text]
    measured("compile", *AT)
    assert codes(measured) == dict.fromkeys(VERBS, 0), "a waiver that nothing needs is no difference"


@pytest.mark.parametrize(("old", "new"), [("callback: plan", "callback: other"), ("$5,", "$5, warmup: 3,")])
def test_what_defines_the_figures_is_not_waived(measured: Shell, old: str, new: str) -> None:
    change(measured, old, new)
    measured("compile", *AT)
    found = state(measured)
    assert (found["results"]["state"], found["waivers"]) == ("stale", [])
    assert "to keep the results" not in measured("status").out
    field = "spec.probe.callback" if "callback" in old else "spec.benchmark.warmup"
    change(measured, "sampler: grid}", f'sampler: grid, waivers: [{{change: {field}, old: 1, new: 2, reason: "no"}}]}}')
    said = measured("validate", code=1)
    assert "FS550" in said.err + said.out


def test_a_bench_after_a_waiver_records_it_and_measures_only_what_is_missing(shell: Shell) -> None:
    project(shell, cloud=NODE, ros="{distro: humble}")
    measure(shell, only=3)
    change(shell, "{LOG: info", "{LOG: debug")
    shell("compile", *AT)
    assert state(shell)["to_measure"] == 4
    pasted(shell)
    shell("compile", *AT, code=None)
    assert state(shell)["to_measure"] == 1
    before = measured_files.document(shell.folder / "results/demo")
    table = "instance_type,latency_s\n" + "".join(
        f"{name},1\n" for name in ("a.small", "a.large", "b.small", "b.large")
    )
    shell.write("sweep.csv", table)
    shell("replay", "demo", "--from", "sweep.csv", code=5, run=lab.main)  # results of another runner
    body = read_results_folder(shell.folder / "results/demo").spec
    measured_files.write(shell.folder / "results/demo", body.model_copy(update={"runner": "replay"}))
    shell("replay", "demo", "--from", "sweep.csv", run=lab.main)
    after = measured_files.document(shell.folder / "results/demo")
    assert len(after["samples"]) == 4
    assert [one["samples"] for one in after["carried"]] == [[one["id"] for one in before["samples"]]]
    assert after["carried"][0]["inputs"] == digest.of_value(before["inputs"])
    assert before["inputs"] != after["inputs"]
    shell("compile", *AT)
    assert "3 of 4 samples measured before" in shell("menu", "demo").out
    change(shell, re.search(r", waivers: \[.*\]", shell.read("specs/demo.yaml"))[0], "")  # type: ignore[index]
    shell("compile", *AT)
    assert state(shell)["results"]["state"] == "fresh", "it is in the results now"
    first = before["samples"][0]["id"]
    shell("replay", "demo", "--from", "sweep.csv", "--only", first, run=lab.main)
    after = measured_files.document(shell.folder / "results/demo")
    assert first not in after["carried"][0]["samples"], "it was measured again"
