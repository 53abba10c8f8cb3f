"""Bad input through the command line: a located error or a recorded failed sample, and nothing lost or half-written."""

import re
import shutil

import pytest

from tests.conftest import ROOT
from tests.support.results import document, first
from tests.support.scenes import SPEC, WORK, Scene, tree

FIRST = "local-1cpu-1gib"
SAMPLE = ("--only", FIRST)
# A short time only for what ends by it: what ends otherwise need not be faster than that.
SHORT = {"hang": ("ready_timeout: 1min", "ready_timeout: 2s"), "hang later": ("duration: 1min", "duration: 2s")}
SHORT["hang in warm-up"] = SHORT["hang later"]
SAY = "import json, os, sys, time\nout = open(os.environ['FOGSPEC_TIMINGS'], 'a', buffering=1)\n"


@pytest.fixture
def scene(tmp_path):
    return Scene.made(tmp_path / "scene")


@pytest.mark.parametrize(
    ("old", "new", "place", "words"),
    [
        ("constraints: {latency", "constraints: {latancy", ":8:17", "latency"),
        ("latency: 1s", "latency: 1", ":8:26", "1s"),
        ("infra: [aws/us-east-1]", "infra: [aws/us-east-1", "", ""),
        ("probe: {callback: work}", "probe: {callback: work", "", ""),
        ("requests: 10", "requests: -3", ":15:22", ""),
        ("local/1cpu-1gib", "local/1cpu", ":12:", ""),
    ],
    ids=["unknown field", "no unit", "truncated list", "truncated mapping", "negative", "machine"],
)
@pytest.mark.parametrize("verb", ["compile", "bench"])
def test_a_wrong_spec_is_an_error_at_its_place(scene, verb, old, new, place, words):
    scene.spec.write_text(SPEC.replace(old, new))
    before = tree(scene.folder)
    ended = scene.run(verb, *(["--runner", "local"] if verb == "bench" else []))
    assert ended.returncode == 1
    said = ended.stdout + ended.stderr
    assert f"specs/tiny.yaml{place}" in said
    assert words in said
    assert tree(scene.folder) == before


def test_a_file_that_the_spec_names_is_missed_before_a_machine_is_paid_to_miss_it(scene):
    node = "cloud:\n    - {package: arm, executable: plan, parameter_files: [p.yaml]}"
    scene.spec.write_text(
        SPEC.replace("infra:", "ros: {distro: humble, workspace: arm_ws}\n  infra:").replace("cloud:", node)
    )
    (scene.folder / "specs" / "work.py").unlink()
    before = tree(scene.folder)
    for ended in (scene.run("validate"), scene.run("compile"), scene.bench()):
        assert ended.returncode == 1
        for missing in (
            "spec.ros.workspace names arm_ws",
            "spec.cloud[0].parameter_files[0] names p.yaml",
            "spec.cloud[1].cmd[1] names work.py",
        ):
            located = rf"error\[FS545\]: {re.escape(missing)}, which is not there\n +--> specs/tiny.yaml:\d"
            assert re.search(located, ended.stderr), ended.stderr
    assert tree(scene.folder) == before


def test_a_spec_that_is_no_file(scene):
    scene.spec.unlink()
    assert scene.bench().returncode in (1, 2)
    scene.spec.mkdir()
    ended = scene.bench()
    assert ended.returncode in (1, 2)
    assert "specs/tiny.yaml" in ended.stderr


def test_bytes_that_are_no_text(scene):
    scene.spec.write_bytes(b"\xff\xfe\x00\x01" * 20)
    assert scene.bench().returncode == 1
    scene.spec.write_text(SPEC[: len(SPEC) // 2])
    assert scene.bench().returncode == 1


def test_a_price_that_is_missing_in_a_catalog(scene):
    assert scene.bench().returncode == 0
    head = "InstanceType,AcceleratorName,AcceleratorCount,vCPUs,MemoryGiB,Price,SpotPrice,Region\n"
    (scene.folder / "machines.csv").write_text(head + "c6i.large,,,2,4,,,us-east-1\nm6i.large,,,2,8,0.1,,us-east-1\n")
    ended = scene.run("compile", "--catalog", "machines.csv")
    assert ended.returncode == 0
    assert "1 row has no price: not a candidate, such as c6i.large at line 2" in ended.stderr
    assert "m6i.large" in (scene.folder / "compiled" / "tiny" / "manifest.yaml").read_text()
    (scene.folder / "machines.csv").write_text(head + "c6i.large,,,2,4,,,us-east-1\n")
    ended = scene.run("compile", "--catalog", "machines.csv")
    assert ended.returncode == 4
    assert "no price" in ended.stderr
    assert "no machine of the catalog is admissible" in ended.stderr
    assert "stale: it stays, and apply refuses it" in ended.stdout
    assert scene.run("check").returncode == 3


def test_results_that_were_edited_stay_as_they_are(scene):
    assert scene.bench(*SAMPLE).returncode == 0
    path = first(scene.results)
    path.write_text(path.read_text().replace("requests: 1", "requests: 2", 1))
    before = tree(scene.folder)
    for verb, words in (("bench", ("--runner", "local")), ("compile", ()), ("menu", ())):
        ended = scene.run(verb, *words)
        assert (verb, ended.returncode) == (verb, 1)
        assert "results/tiny/" in ended.stderr
        assert "FS701" in ended.stderr
    assert tree(scene.folder) == before
    path.write_text(path.read_text()[:400])
    assert scene.bench().returncode == 1


def test_what_is_reviewed_is_what_runs(scene):
    assert not (scene.folder / "compiled" / "tiny" / "tasks").exists(), "a sample on this host has no task"
    script = scene.folder / "compiled" / "tiny" / "scripts" / "measure.sh"
    script.write_text(script.read_text().replace("set -eu", "set -eu; curl evil"))
    ended = scene.bench()
    assert (ended.returncode, "fogspec compile specs/tiny.yaml" in ended.stderr) == (3, True)
    assert "measure.sh is not what specs/tiny.yaml compiles to: line 5\n" in ended.stderr
    script.unlink()
    assert scene.bench().returncode == 3
    assert scene.run("compile").returncode == 0
    scene.spec.write_text(SPEC.replace("requests: 10", "requests: 11"))
    ended = scene.bench()
    assert (ended.returncode, "compiles to: spec.benchmark.stop.requests" in ended.stderr) == (3, True)
    shutil.rmtree(scene.folder / "compiled")
    assert scene.bench().returncode == 3
    assert (scene.records(), scene.started()) == ({}, [])


@pytest.mark.parametrize(
    ("work", "state", "reason", "words"),
    [
        ("raise SystemExit('the map is missing')", "failed", "crash", "exit code 1: the map is missing"),
        ("import time; time.sleep(60)", "failed", "no_response", "no timed request within 2 s"),
        ("pass", "failed", "no_response", "without one timed request"),
        ("import os; os.kill(os.getpid(), 11)", "failed", "crash", "ended by"),
        (WORK.replace('stop("work")', 'stop("work", ok=False, reason="no path")'), "failed", "check", "no path"),
        (WORK.replace('"work"', '"other"').replace("while True", "for _ in range(20)"), "failed", "not_reported",
         "only 'other'"),
        (SAY + "out.write('garbage\\n' * 50 + '{\"latency_s\": -1, \"ok\": true}\\n')", "failed", "no_response", "timings: 51"),
        (SAY + "for _ in range(3):\n  print(json.dumps({'name': 'work', 'latency_s': 1e-2, 'ok': True}), file=out)\n"
         "time.sleep(60)", "ok", None, ""),
        ("import fogspec_probe as p, time\np.start('work'); p.stop('work'); p.start('work'); time.sleep(60)",
         "timeout", None, "warm-up"),
    ],
    ids=["crash", "hang", "silence", "signal", "check", "other", "garbage", "hang later", "hang in warm-up"],
)  # fmt: skip
def test_a_workload_that_goes_wrong_is_a_record_that_says_so(tmp_path, request, work, state, reason, words):
    short = SHORT.get(request.node.callspec.id)
    scene = Scene.made(tmp_path / "scene", work, SPEC.replace(*short) if short else SPEC)
    ended = scene.bench(*SAMPLE)
    record = scene.records()[FIRST]
    assert (record["state"], record.get("reason")) == (state, reason)
    assert words in record.get("detail", "")
    assert ended.returncode == (0 if state == "ok" else 1)
    assert scene.alive() == []


def test_a_program_that_is_not_there(tmp_path):
    scene = Scene.made(tmp_path / "scene", spec=SPEC.replace("[python3, work.py]", "[no-such-program]"))
    assert scene.bench(*SAMPLE).returncode == 1
    record = scene.records()[FIRST]
    assert (record["reason"], "no-such-program" in record["detail"]) == ("setup", True)


def test_a_failed_sample_leaves_the_others_measured(tmp_path):
    work = "import os, sys\nif len(os.sched_getaffinity(0)) == 2: sys.exit('too many CPUs')\n" + WORK
    scene = Scene.made(tmp_path / "scene", work)
    ended = scene.bench()
    assert ended.returncode == 0
    states = {name: record["state"] for name, record in scene.records().items()}
    assert states == {FIRST: "ok", "local-2cpu-1gib": "failed"}
    assert "too many CPUs" in ended.stdout


def test_a_workload_that_takes_all_memory_is_out_of_memory(tmp_path):
    work = "import fogspec_probe\nkept = []\nwhile True:\n" + (
        "    with fogspec_probe.request('work'):\n        kept.append(b'x' * (100 << 20))\n"
    )
    scene = Scene.made(tmp_path / "scene", work, SPEC.replace("requests: 10,", "requests: 1000,"))
    assert scene.bench(*SAMPLE).returncode == 1
    record = scene.records()[FIRST]
    assert (record["reason"], "1 GiB were not enough" in record["detail"]) == ("out_of_memory", True)
    assert int(record["requests"]) <= 10


def test_a_workload_that_floods_its_log_is_measured_and_the_log_is_cut(tmp_path):
    flood = WORK.replace("    time.sleep(0.01)\n", "    time.sleep(0.03)\n    print('x' * (3 << 20), flush=True)\n")
    scene = Scene.made(tmp_path / "scene", flood, SPEC.replace("requests: 10", "requests: 40"))
    assert scene.bench(*SAMPLE).returncode == 0
    assert scene.records()[FIRST]["state"] == "ok"
    written = sum(path.stat().st_size for path in scene.folder.rglob("*.log"))
    assert written < 100 << 20, "of at least 123 MiB"


@pytest.mark.parametrize("name", [".fogspec", "results"])
def test_a_folder_that_cannot_be_written_is_said(scene, name):
    (scene.folder / name).write_text("a file")
    ended = scene.bench(*SAMPLE)
    assert (ended.returncode, "Not a directory" in ended.stderr) == (1, True)
    assert name in ended.stderr
    assert "bug" not in ended.stderr
    assert scene.alive() == [] if name == "results" else True


def test_a_damaged_journal_is_said_and_left(scene):
    assert scene.bench(*SAMPLE).returncode == 0
    journal = scene.folder / ".fogspec" / "tiny" / "journal.jsonl"
    content = b"nonsense\n" + journal.read_bytes()
    journal.write_bytes(content)
    ended = scene.bench()
    assert (ended.returncode, "journal.jsonl:1" in ended.stderr) == (3, True)
    assert journal.read_bytes() == content


def test_a_torn_last_line_of_the_journal_is_no_damage(scene):
    assert scene.bench(*SAMPLE).returncode == 0
    with open(scene.folder / ".fogspec" / "tiny" / "journal.jsonl", "ab") as journal:
        journal.write(b'{"do": "sta')
    assert scene.bench().returncode == 0
    assert len(scene.records()) == 2


@pytest.fixture(scope="module")
def clouds(tmp_path_factory):
    """The paper's grasp planning, compiled, and without results."""
    scene = Scene(tmp_path_factory.mktemp("clouds"), "grasp-planning-recorded")
    (scene.folder / "specs").mkdir()
    shutil.copy(ROOT / "specs" / "grasp-planning-recorded.yaml", scene.spec)
    assert scene.run("compile").returncode == 0
    return scene


def test_a_clouds_machines_cannot_be_measured_here(clouds):
    ended = clouds.bench()
    assert (ended.returncode, clouds.results.exists()) == (5, False)
    assert "local/2cpu-4gib" in ended.stderr


def test_a_replay_of_what_is_no_recording(clouds, tmp_path):
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("a: 1\n")
    assert clouds.run("replay", "--from", str(wrong)).returncode == 1
    assert clouds.run("replay", "--from", str(tmp_path / "none.yaml")).returncode in (1, 2)
    assert not clouds.results.exists()


def test_a_replay_has_the_same_records_and_the_same_choice(clouds):
    recorded = ROOT / "results" / "grasp-planning-recorded"
    ended = clouds.run("replay", "--from", str(recorded))
    assert ended.returncode == 0, ended.stderr
    then, now = (document(path) for path in (recorded, clouds.results))
    by_id = {record["id"]: record for record in then["samples"]}
    planned = clouds.document(clouds.folder / "compiled" / clouds.name / "plan.yaml")["spec"]["samples"]
    assert {one["id"]: one for one in now["samples"]} == {one["id"]: by_id[one["id"]] for one in planned}
    assert now["spent"] == then["spent"]
    compiled = clouds.folder / "compiled" / clouds.name
    assert clouds.run("compile").returncode == 0
    fresh, reference = (
        clouds.document(folder / "manifest.yaml") for folder in (compiled, ROOT / "compiled" / clouds.name)
    )
    assert fresh["spec"]["instance"] == "g4dn.xlarge"
    assert (fresh["spec"], fresh["expected"]) == (reference["spec"], reference["expected"])
