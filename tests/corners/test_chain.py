"""check, its statement, and diff: the chain behind a manifest, where it breaks, and what would change."""

import dataclasses
import gzip
import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from fogspec.base import digest
from fogspec.base.text import markdown
from fogspec.results.io import read_results_folder
from fogspec_lab import cli as lab
from tests.support.results import write
from tests.support.running import Shell, chosen, measure, project, shell  # noqa: F401

AT = ("--catalog", "offers.csv")
MANIFEST = "compiled/demo/manifest.yaml"
CHAIN = ["spec", "catalog", "lock", "timings", "plan", "results", "models", "menu", "manifest"]


@pytest.fixture
def done(shell: Shell) -> Shell:
    chosen(shell)
    return shell


def broken(shell: Shell) -> tuple[set[str], list[str]]:
    """The stages that are not fresh, and what is wrong."""
    (said,) = json.loads(shell("check", "-o", "json", code=3).out)["applications"]
    return {stage["name"] for stage in said["stages"] if stage["state"] != "fresh"}, said["problems"]


def edit(shell: Shell, name: str, change: Callable[[str], str]) -> None:
    before = shell.read(name)
    assert change(before) != before
    shell.write(name, change(before))


def test_a_chain_that_holds(done: Shell) -> None:
    said = json.loads(done("check", "-o", "json").out)
    assert said["passed"]
    assert [stage["state"] for stage in said["applications"][0]["stages"]] == ["fresh"] * 5
    shown = done("check", "demo", "-v")
    assert [line.split()[0] for line in shown.out.splitlines() if line.startswith("      ")] == CHAIN
    for name in (MANIFEST, "compiled/demo/plan.yaml"):
        assert f"{name}  {digest.of_bytes((done.folder / name).read_bytes())}" in shown.out


@pytest.mark.parametrize(
    ("name", "change", "stages", "says"),
    [
        ("specs/demo.yaml", lambda t: t.replace("alpha: 0.5", "alpha: 0.9"), {"manifest"}, "spec.objective.alpha: 0.5 -> 0.9"),
        ("offers.csv", lambda t: t.replace("0.40", "0.41"), {"plan", "manifest"}, "catalog.digest changed"),
        ("compiled/demo/plan.yaml", lambda t: t.replace("requests: 20", "requests: 21"), {"plan"}, "requests: 21 -> 20"),
        ("compiled/demo/models.yaml", lambda t: t.replace("p: ", "p: 1"), {"models"}, "models are stale: "),
        ("compiled/demo/manifest.yaml", lambda t: t.replace("$0.4/h", "$0.2/h"), {"manifest"}, "spec.price: $0.2/h -> $0.4/h"),
        ("compiled/demo/menu.yaml", lambda t: t + "# mine\n", {"menu"}, "its text was edited"),
        ("compiled/demo/deploy.sky.yaml", lambda t: t.replace("a.large", "a.huge"), {"manifest"}, "is not what was compiled"),
        ("compiled/demo/tasks/aws-r1-a-small.sky.yaml", lambda t: t + "# mine\n", {"plan"}, "aws-r1-a-small"),
        ("specs/demo.yaml", lambda t: t.replace("work.py", "other.py"), {"results"}, "spec.cloud[0].cmd: "),
    ],
)  # fmt: skip
def test_which_stage_is_not_fresh_and_why(
    done: Shell, name: str, change: Callable[[str], str], stages: set[str], says: str
) -> None:
    edit(done, name, change)
    found, problems = broken(done)
    assert stages <= found
    assert sum(problem.count(says) for problem in problems) == 1, problems
    assert "fix: fogspec " in done("check", code=3).out


def test_results_that_were_edited(done: Shell) -> None:
    edit(done, "results/demo/aws-r1-a-small.yaml", lambda text: text.replace("requests: 20", "requests: 21"))
    assert "integrity check failed" in broken(done)[1][0]


def with_timings(shell: Shell, latencies_s: list[float], spec: str = "specs/demo.yaml", probe: str = "plan") -> Path:
    """Raw timings for the first sample, and its record as it follows from them; the rest is compiled anew."""
    name = Path(spec).stem
    path = shell.folder / f"results/{name}"
    results = read_results_folder(path)
    first, *others = results.spec.samples
    lines = [
        {"name": probe, "start_s": n, "latency_s": s, "ok": True, "metrics": {}}
        for n, s in enumerate([9.0, *latencies_s])
    ]
    raw = shell.folder / f"results/{name}/timings/{first.id}.jsonl.gz"
    raw.parent.mkdir(parents=True, exist_ok=True)
    raw.write_bytes(gzip.compress("".join(json.dumps(line) + "\n" for line in lines).encode(), mtime=0))
    mean = sum(latencies_s) / len(latencies_s)
    sd = (sum((s - mean) ** 2 for s in latencies_s) / (len(latencies_s) - 1)) ** 0.5
    latency = first.latency.model_copy(update={"mean": mean, "sd": sd, "p50": sorted(latencies_s)[1]})
    update = {"requests": len(latencies_s), "latency": latency,
              "timings": digest.of_bytes(raw.read_bytes())}  # fmt: skip
    body = results.spec.model_copy(update={"samples": [first.model_copy(update=update), *others]})
    write(path, body)
    shell("compile", spec, *AT)
    return raw


def test_records_are_recomputed_from_raw_timings(done: Shell) -> None:
    raw = with_timings(done, [2.0, 2.1, 2.2])
    done("check")
    raw.write_bytes(raw.read_bytes() + b"\0")
    assert "is not what was recorded" in broken(done)[1][0]
    raw.unlink()
    assert "is missing" in broken(done)[1][0]


def test_a_record_that_does_not_follow_from_its_timings(done: Shell) -> None:
    with_timings(done, [2.0, 2.1, 2.2])
    path = done.folder / "results/demo"
    results = read_results_folder(path)
    first, *others = results.spec.samples
    better = first.model_copy(update={"latency": first.latency.model_copy(update={"mean": 1.0})})
    body = results.spec.model_copy(update={"samples": [better, *others]})
    write(path, body)
    assert "so that check and apply refuse it" in done("compile", "specs/demo.yaml", *AT).err
    (line,) = broken(done)[1]
    assert line.startswith("results are stale: aws-r1-a-small: ")
    assert "latency" in line
    # By the rules of another spec nothing follows from them, and they are to be measured again anyway.
    edit(done, "specs/demo.yaml", lambda text: text.replace("[python3, work.py]", "[python3, work.py, again]"))
    assert "refuse it" not in done("compile", "specs/demo.yaml", *AT).err
    assert "is stale or was edited" in done("apply", MANIFEST, "--dry-run", code=3).err


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"no gzip", "it is not a complete gzip file"),
        (gzip.compress(b"{}\n" * 1000, mtime=0)[:-9], "it is not a complete gzip file"),
        (gzip.compress(b"", mtime=0)[:10] + b"\xff" * 20, "it is not a complete gzip file"),
    ],
)
def test_raw_timings_that_are_none(done: Shell, content: bytes, says: str) -> None:
    raw = with_timings(done, [2.0, 2.1, 2.2])
    raw.write_bytes(content)
    file = done.folder / "results/demo"
    results = read_results_folder(file)
    first, *others = results.spec.samples
    timings = digest.of_bytes(raw.read_bytes())
    body = results.spec.model_copy(update={"samples": [first.model_copy(update={"timings": timings}), *others]})
    write(file, body)
    done("compile", "specs/demo.yaml", *AT)
    assert says in broken(done)[1][0]
    said = done("check", code=3).out
    assert "fogspec bench specs/demo.yaml" in said, "compiling again would not mend it"
    (done.folder / "results").rename(done.folder / "old")
    replay = ("replay", "specs/demo.yaml", "--from", "old/demo", "--yes")
    assert says in done(*replay, code=1, run=lab.main).err


def test_a_manifest_elsewhere_and_none(done: Shell) -> None:
    done.write("copy.yaml", done.read(MANIFEST))
    assert "must stand at" in done("apply", "copy.yaml", "--dry-run", code=1).err
    for path in (str(done.folder / MANIFEST), f"./compiled/../{MANIFEST}"):
        done("apply", path, "--dry-run")
    edit(done, MANIFEST, lambda text: text[: len(text) // 2])
    assert f"{MANIFEST}:" in done("check", code=3).out


def test_diff_says_what_and_why_and_what_it_costs(done: Shell) -> None:
    assert "the manifest is what compile would write" in done("diff").out
    edit(done, "offers.csv", lambda text: text.replace("a.large,,,8,16,0.40", "a.large,,,8,16,0.44"))
    (said,) = json.loads(done("diff", "-o", "json").out)["applications"]
    assert said["changed"]
    assert (said["before"]["price_usd_per_hour"], said["after"]["price_usd_per_hour"]) == (0.4, 0.44)
    assert "catalog.digest" in [change["field"] for change in said["inputs"]]
    assert (said["to_measure"], said["running"]) == ([], None)
    assert "no benchmark needed" in done("diff").out


def test_diff_names_the_samples_to_measure(done: Shell) -> None:
    edit(done, "specs/demo.yaml", lambda text: text.replace("cpus: 2..8", "cpus: 2..32"))
    (said,) = json.loads(done("diff", "-o", "json").out)["applications"]
    assert said["to_measure"] == ["aws-r1-a-huge", "aws-r1-b-huge"]
    assert said["measuring_usd_at_most"] > 0
    assert "spec.hardware.cpus: 2..8 -> 2..32" in done("diff").out


@pytest.mark.parametrize("content", ["", "- 1\n", "a: [\n", "\0\n"])
def test_a_manifest_that_is_none_is_damage_not_a_bug(done: Shell, content: str) -> None:
    done.write(MANIFEST, content)
    for verb in ("status", "diff"):
        assert done(verb, "specs/demo.yaml").err == "", "compile mends it"
    assert f"{MANIFEST}:" in done("check", code=3).out
    assert "error[FS" in done("apply", MANIFEST, code=1).err


def test_diff_before_anything_and_when_nothing_meets(shell: Shell) -> None:
    project(shell)
    assert "there is no manifest" in shell("diff").out
    measure(shell)
    assert "a new manifest" in shell("diff").out
    shell("compile", "specs/demo.yaml", *AT)
    edit(shell, "specs/demo.yaml", lambda text: text.replace("latency: 10s", "latency: 1ms"))
    assert "no machine meets the limits" in shell("diff").out


def test_diff_shows_no_secrets(shell: Shell) -> None:
    shell.monkeypatch.setenv("MY_OWN", "hunter2-hunter2")
    nodes = "[{cmd: [python3, work.py, hunter2-hunter2], env: {API_TOKEN: abc-def-ghi}}]"
    project(shell, cloud=nodes, secrets="[MY_OWN]")
    measure(shell)
    for form in ((), ("-o", "json"), ("--markdown",)):
        said = shell("diff", *form).out
        assert "hunter2" not in said
        assert "abc-def-ghi" not in said


def test_markdown_cannot_be_broken_out_of(done: Shell) -> None:
    edit(done, "offers.csv", lambda text: text.replace("a.large,,,8,16,0.40", "a.large,,,8,16,0.44"))
    said = done("diff", "--markdown").out
    assert "| machine | $0.40/h | $0.44/h | +10% |" in said
    assert markdown("a|b`<img>\n") == "a\\|b\\`\\<img\\>\\\\n", "an end of line is shown, and ends no row"


def test_the_statement_is_in_toto_and_the_same_each_time(done: Shell) -> None:
    with_timings(done, [2.0, 2.1, 2.2])
    first, second = (done("check", "-o", "statement").out for _ in range(2))
    assert first == second
    said = json.loads(first)
    assert (said["_type"], said["predicateType"]) == (
        "https://in-toto.io/Statement/v1",
        "https://slsa.dev/provenance/v1",
    )
    subjects = {one["name"]: one["digest"]["sha256"] for one in said["subject"]}
    for name, value in subjects.items():
        path = (done.folder / "compiled/demo" / name) if name.startswith("..") else done.folder / name
        assert digest.of_bytes(path.read_bytes()) == f"sha256:{value}"
    assert {MANIFEST, "compiled/demo/deploy.sky.yaml", "compiled/agent.pyz"} <= subjects.keys()
    definition = said["predicate"]["buildDefinition"]
    materials = definition["resolvedDependencies"]
    assert [one["name"] for one in materials] == ["spec", "plan", *4 * ["results"], "timings", "models", "catalog"]
    for one in materials[:-1]:
        content = (done.folder / one["uri"]).read_bytes()
        assert hashlib.sha256(content).hexdigest() == one["digest"]["sha256"], "as any tool would check it"
    assert {"buildType", "externalParameters", "resolvedDependencies"} <= definition.keys()
    assert said["predicate"]["runDetails"]["builder"]["id"]


def test_a_pinned_image_is_a_material(done: Shell) -> None:
    from fogspec.compile.bundle import open_bundle
    from fogspec.review.statement import materials

    opened = open_bundle(done.folder / MANIFEST)
    image = "ghcr.io/team/robot@sha256:" + "ab" * 32
    spec = opened.manifest.spec.model_copy(update={"image": image})
    pinned = dataclasses.replace(opened, manifest=opened.manifest.model_copy(update={"spec": spec}))
    assert materials(pinned)[-1] == {
        "name": "image",
        "uri": "oci://ghcr.io/team/robot",
        "digest": {"sha256": "ab" * 32},
    }


def test_there_is_no_statement_of_what_fails(done: Shell) -> None:
    edit(done, MANIFEST, lambda text: text.replace("$0.4/h", "$0.2/h"))
    ended = done("check", "-o", "statement", code=3)
    assert ended.out == ""
    assert "FAIL  demo" in ended.err


def test_a_statement_is_compared_with_the_files(done: Shell) -> None:
    done.write("statement.json", done("check", "-o", "statement").out)
    check = ("check", "--statement")
    done(*check, "statement.json")
    done(*check, "missing.json", code=1)
    for other in ("{", "[]", "[" * 100_000, json.dumps({"payloadType": "application/vnd.in-toto+json"})):
        done.write("other.json", other)
        assert "it is not an in-toto Statement v1" in done(*check, "other.json", code=3).err
    more = json.loads(done.read("statement.json"))
    more["subject"].append({"name": "README.md", "digest": {"sha256": "1" * 64}})
    done.write("other.json", json.dumps(more))
    assert "it states README.md too" in done(*check, "other.json", code=3).err
    edit(done, "specs/demo.yaml", lambda text: text.replace("alpha: 0.5", "alpha: 0.9"))
    done("compile", "specs/demo.yaml", *AT)
    assert f"{MANIFEST} is not what statement.json states" in done(*check, "statement.json", code=3).err
